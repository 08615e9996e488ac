"""Limits that are learnt, on made-up measurements."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.redecoding.measure import FALSE, Measured, learn

RNG = np.random.default_rng(0)


def made_up(correlation: np.ndarray, margin: np.ndarray) -> Measured:
    n = len(correlation)
    zero = np.zeros(n, dtype=np.float32)
    return Measured(
        places=np.zeros((n, 2), dtype=np.int64), coords=np.zeros((n, 2), dtype=np.float32), along=zero, across=zero,
        correlation=correlation.astype(np.float32), margin=margin.astype(np.float32), roughness=zero,
        covered=zero + 1, step=zero, sigma=zero + 0.01,
    )  # fmt: skip


def drawn(n: int, correlation: float, margin: float) -> Measured:
    return made_up(correlation + 0.05 * RNG.standard_normal(n), margin + 0.05 * RNG.standard_normal(n))


WRONG = drawn(4000, 0.7, 0.0)


def test_most_right_ones_are_accepted_and_hardly_a_wrong_one():
    limits = learn(drawn(2000, 0.95, 0.2), np.arange(2000) < 1000, np.arange(2000) >= 1000, 1000, WRONG, 20.0)
    assert limits is not None
    assert limits.accept(drawn(4000, 0.95, 0.2)).mean() > 0.85 and limits.accept(WRONG).mean() < 0.002
    assert not limits.accept(replace(drawn(9, 0.95, 0.3), sigma=np.full(9, 0.5, np.float32))).any()


def test_where_few_are_right_chance_is_bounded():
    """Of 20000 unknown pixels 200 show the pattern: limits that suit decoded pixels would let in as many by chance."""
    found = [drawn(1000, 0.85, 0.15), drawn(200, 0.85, 0.15), drawn(19800, 0.7, 0.0)]
    joined = made_up(*(np.concatenate([getattr(f, name) for f in found]) for name in ("correlation", "margin")))
    known = np.arange(len(joined.margin)) < 1000
    limits = learn(joined, known, ~known, 1000, WRONG, 20.0)
    assert limits is not None
    accepted = limits.accept(joined)
    assert accepted[1200:].sum() <= max(3 * FALSE * accepted[~known].sum(), 2)


def test_an_image_that_shows_nothing_teaches_nothing():
    everywhere = np.ones(1000, dtype=bool)
    assert learn(drawn(1000, 0.7, 0.0), everywhere, ~everywhere, 1000, WRONG, 20.0) is None


@pytest.mark.parametrize(("right", "decoded"), [(150, 150), (400, 1000)])
def test_too_few_right_ones_teach_nothing(right, decoded):
    chosen = np.arange(1000) < right
    assert learn(drawn(1000, 0.95, 0.2), chosen, ~chosen, decoded, WRONG, 20.0) is None
