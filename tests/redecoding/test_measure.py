"""Correlation against numpy's own, where a pattern resembles itself, and limits that are learnt."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from sl_nerfstudio.redecoding.measure import (
    FALSE,
    Ambiguity,
    CorrelationWindow,
    Measured,
    PatternView,
    correlations,
    fit_shifts,
    learn,
)
from tests.redecoding.lit_ball import grid

RNG = np.random.default_rng(1)
DOTS = gaussian_filter(RNG.random((120, 140)).astype(np.float32), 2.0)


def flat_view(image: np.ndarray, depth: np.ndarray | None = None) -> PatternView:
    """A camera that looks at the pattern itself."""
    h, w = image.shape
    coords = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), -1).astype(np.float32)
    depth = np.ones_like(image) if depth is None else depth
    return PatternView(image, coords, depth, np.ones(image.shape, dtype=bool))


def test_a_grid_resembles_itself_at_whole_periods():
    found = Ambiguity.of(grid())
    assert found.pitch == pytest.approx(20, abs=1)
    offsets = {tuple(np.rint(d / 20).astype(int)) for d in found.rivals}
    assert {(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 2)} <= offsets
    assert np.abs(found.rivals - 20 * np.rint(found.rivals / 20)).max() <= 1
    assert np.linalg.norm(found.decoys, axis=1).min() > np.linalg.norm(found.rivals, axis=1).max()


def test_dots_resemble_themselves_nowhere_and_flat_or_striped_patterns_are_no_special_case():
    dots = Ambiguity.of(DOTS)
    assert len(dots.rivals) == 0 and len(dots.decoys) == 8 and dots.pitch > 8
    for pattern in (np.full((60, 80), 0.3), np.arange(80.0) // 8 % 2 + np.zeros((60, 1))):
        found = Ambiguity.of(pattern.astype(np.float32))
        assert 1 < found.pitch < 20 and len(found.rivals) <= 24 and 1 <= len(found.decoys) <= 8


def fit(image, *places, depth=None):
    start = np.zeros((len(places), 2), dtype=np.float32)
    return fit_shifts(flat_view(image, depth), DOTS, np.array(places), start, CorrelationWindow.gaussian(5.0))


def test_correlation_is_that_of_numpy_whatever_the_gain():
    image = (0.2 + 0.5 * shift(DOTS, (0.5, -1.0), order=1, mode="nearest")).astype(np.float32)
    window = CorrelationWindow.gaussian(4.0)
    candidates = np.dstack([DOTS, np.roll(DOTS, 3, 0)])
    found = correlations(flat_view(image), candidates, np.array([[50, 60], [2, 3]]), window)
    for n, (row, column) in enumerate([(50, 60), (2, 3)]):
        y, x = (window.offsets + (row, column)).T
        inside = (y >= 0) & (x >= 0)
        for k in range(2):
            C = np.cov(
                image[y[inside], x[inside]], candidates[y[inside], x[inside], k], aweights=window.weights[inside]
            )
            assert found[n, k] == pytest.approx(C[0, 1] / np.sqrt(C[0, 0] * C[1, 1]), abs=1e-3)


def test_a_displacement_is_found_to_a_hundredth_of_a_pixel_but_none_in_a_blank_image():
    image = 0.1 + 0.3 * shift(DOTS, (-0.37, 0.81), order=3)
    places = np.argwhere(np.pad(np.ones((60, 60), dtype=bool), 30)[:120, :140])[::37]
    found = fit(image, *places)
    np.testing.assert_allclose(np.median(found.shift, 0), [-0.81, 0.37], atol=0.02)
    assert np.abs(found.shift - [-0.81, 0.37]).max() < 0.15 and found.correlation.min() > 0.99
    assert found.covered.min() == pytest.approx(1, abs=1e-5) and found.step.max() < 0.05
    blank = np.full_like(DOTS, 0.4)
    nothing = fit(blank, (60, 60))
    assert nothing.correlation[0] == 0 and nothing.sigma[0] == np.inf
    places, window = np.array([[60, 60]]), CorrelationWindow.gaussian(5.0)
    assert correlations(flat_view(blank), DOTS[..., None], places, window).item() == 0


def test_a_window_stays_on_its_surface():
    """Beyond a step of depth the image shows something else, which must not count."""
    depth = np.ones_like(DOTS)
    depth[:, 70:] = 100.0
    image = DOTS.copy()
    image[:, 70:] = RNG.random((120, 70))
    found = fit(image, (60, 67), depth=depth)
    assert found.correlation[0] > 0.999 and np.abs(found.shift).max() < 0.01 and 0.5 < found.covered[0] < 0.9


LEARNT = np.random.default_rng(0)


def made_up(correlation: np.ndarray, margin: np.ndarray) -> Measured:
    n = len(correlation)
    zero = np.zeros(n, dtype=np.float32)
    return Measured(
        places=np.zeros((n, 2), dtype=np.int64), coords=np.zeros((n, 2), dtype=np.float32), across=zero,
        correlation=correlation.astype(np.float32), margin=margin.astype(np.float32), roughness=zero,
        covered=zero + 1, step=zero, sigma=zero + 0.01,
    )  # fmt: skip


def sampled(n: int, correlation: float, margin: float) -> Measured:
    return made_up(correlation + 0.05 * LEARNT.standard_normal(n), margin + 0.05 * LEARNT.standard_normal(n))


WRONG = sampled(4000, 0.7, 0.0)


def test_most_right_ones_are_accepted_and_hardly_a_wrong_one():
    limits = learn(sampled(2000, 0.95, 0.2), np.arange(2000) < 1000, np.arange(2000) >= 1000, 1000, WRONG, 20.0)
    assert limits is not None
    assert limits.accept(sampled(4000, 0.95, 0.2)).mean() > 0.85 and limits.accept(WRONG).mean() < 0.002
    assert not limits.accept(replace(sampled(9, 0.95, 0.3), sigma=np.full(9, 0.5, np.float32))).any()


def test_where_few_are_right_chance_is_bounded():
    """Of 20000 unknown pixels 200 show the pattern: limits that suit decoded pixels would let in as many by chance."""
    found = [sampled(1000, 0.85, 0.15), sampled(200, 0.85, 0.15), sampled(19800, 0.7, 0.0)]
    joined = made_up(*(np.concatenate([getattr(f, name) for f in found]) for name in ("correlation", "margin")))
    known = np.arange(len(joined.margin)) < 1000
    limits = learn(joined, known, ~known, 1000, WRONG, 20.0)
    assert limits is not None
    accepted = limits.accept(joined)
    assert accepted[1200:].sum() <= max(3 * FALSE * accepted[~known].sum(), 2)


@pytest.mark.parametrize(
    ("right", "decoded", "correlation", "margin"), [(150, 150, 0.95, 0.2), (400, 1000, 0.95, 0.2), (1000, 1000, 0.7, 0)]
)
def test_too_few_right_ones_or_an_image_that_shows_nothing_teach_nothing(right, decoded, correlation, margin):
    chosen = np.arange(1000) < right
    assert learn(sampled(1000, correlation, margin), chosen, ~chosen, decoded, WRONG, 20.0) is None
