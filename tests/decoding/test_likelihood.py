"""Symbols decide between places: right coordinates are likely, those of another place are not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.decoding.grid_graph import symbol_log_likelihood, symbol_log_ratio

CODES = np.random.default_rng(0).integers(0, 5, (12, 14)).astype(np.int8)
PERIOD = 10
IDENTITY = np.array([[1.0, 0, 0], [0, 1.0, 0]])


def coords(shift=(0, 0)):
    """Periods (x, y) of the array, ten pixels each."""
    x, y = np.meshgrid(np.arange(14 * PERIOD) / PERIOD, np.arange(12 * PERIOD) / PERIOD)
    return (np.stack([x, y], -1) + shift).astype(np.float32)


def logits(certainty=6.0):
    """What a network says that reads every symbol rightly."""
    cell = np.clip(np.rint(coords()).astype(int), 0, (13, 11))
    symbol = CODES[cell[..., 1], cell[..., 0]]
    return (certainty * (np.arange(5)[:, None, None] == symbol)).astype(np.float32)


@given(st.lists(st.floats(0, 1), min_size=5, max_size=5).filter(lambda p: sum(p) > 0.1))
def test_likelihoods_stay_probabilities_and_never_exclude_a_symbol(share):
    score = (np.array([share]) / sum(share)).astype(np.float32)
    log = symbol_log_likelihood(score)
    assert np.exp(log).sum() == pytest.approx(1, abs=1e-5)
    assert log.min() >= np.log(0.03) - 1e-5
    assert (np.diff(log[0][np.argsort(score[0])]) >= 0).all()


def test_right_coordinates_are_likely_and_other_places_are_not():
    inner = np.s_[20:-30, 20:-30]
    right = symbol_log_ratio(coords(), CODES, logits(), IDENTITY, float(PERIOD))[inner]
    assert right.min() > 1.0 and right.max() < np.log(5) + 0.01
    for shift in ((1, 0), (0, 1), (-1, 2)):
        wrong = symbol_log_ratio(coords(shift), CODES, logits(), IDENTITY, float(PERIOD))[inner]
        assert wrong.mean() < -0.5 and (wrong > 1.0).mean() < 0.05


def test_symbols_that_say_nothing_decide_nothing():
    ratio = symbol_log_ratio(coords(), CODES, np.zeros_like(logits()), IDENTITY, float(PERIOD))
    assert np.abs(ratio).max() < 1e-5


def test_unknown_coordinates_have_no_ratio_far_from_known_ones():
    some = coords()
    some[:, 40:] = np.nan
    ratio = symbol_log_ratio(some, CODES, logits(), IDENTITY, float(PERIOD))
    assert ratio[20:-20, 20:35].min() > 1 and (ratio[:, 80:] == 0).all()


def test_the_map_leads_to_the_places_of_the_symbols():
    """The same symbols at half the resolution and shifted by three places."""
    half = np.pad(logits()[:, ::2, ::2], ((0, 0), (0, 0), (3, 0)))
    to_map = np.array([[0.5, 0, 3.0], [0, 0.5, 0]])
    ratio = symbol_log_ratio(coords(), CODES, half, to_map, float(PERIOD))
    assert ratio[20:-30, 20:-30].min() > 1.0
