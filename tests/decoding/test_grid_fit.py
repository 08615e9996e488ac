"""Coordinates refined on images whose coordinates are known."""

import cv2
import numpy as np
import pytest

from sl_nerfstudio.decoding.grid_fit import draw_sharpnesses, fit_densely
from sl_nerfstudio.pattern.grid import GridPattern

GRID = GridPattern(w=400, h=400, codes=np.random.default_rng(3).integers(0, 5, (20, 20)).astype(np.int8))


def surface(pixels_a_period, size=160):
    """A curved surface: pattern pixels at pixel centres."""
    x, y = (np.stack(np.meshgrid(*[np.arange(size) + 0.5] * 2), 0) - size / 2) * (20 / pixels_a_period)
    roll = 0.2
    u = np.cos(roll) * x - np.sin(roll) * y + 0.0004 * y * y + 190
    v = np.sin(roll) * x + np.cos(roll) * y + 4 * np.sin(x / 70) + 210
    return np.stack([u, v], -1).astype(np.float32)


def photograph(coords, blur, noise, rng):
    fine = cv2.resize(coords, None, fx=3, fy=3, interpolation=cv2.INTER_LINEAR)
    light = cv2.resize(GRID.intensity(fine).astype(np.float32), None, fx=1 / 3, fy=1 / 3, interpolation=cv2.INTER_AREA)
    y, x = np.mgrid[: len(coords), : len(coords)] / len(coords)
    shaded = cv2.GaussianBlur(0.1 + (0.3 + 0.5 * x) * light + 0.1 * y, (0, 0), blur)
    return (shaded + noise * rng.standard_normal(shaded.shape)).astype(np.float32)


def fit(image, start, pixels=14.0, trust=None):
    trust = np.ones(image.shape, np.float32) if trust is None else trust
    return fit_densely(image, start.astype(np.float32), trust, draw_sharpnesses(GRID.render(), 20.0), float(pixels))


@pytest.mark.parametrize(
    "pixels, blur, noise, bound", [(10, 0.6, 0.01, 0.10), (20, 1.0, 0.01, 0.05), (12, 1.6, 0.05, 0.4)]
)
def test_errors_of_the_network_are_removed(pixels, blur, noise, bound):
    rng = np.random.default_rng(0)
    truth = surface(pixels)
    image = photograph(truth, blur, noise, rng)
    wave = np.sin(np.mgrid[:160, :160] / (1.5 * pixels)).transpose(1, 2, 0)
    start = truth + 1.2 * wave + rng.normal(0, 0.7, truth.shape)
    out, agreement = fit(image, start, pixels)
    error = np.linalg.norm(out - truth, axis=-1)[8:-8, 8:-8]
    assert np.median(error) < bound < np.median(np.linalg.norm(start - truth, axis=-1))
    assert np.median(agreement) > (0.9 if noise < 0.02 else 0.6)


def test_waves_two_periods_long_are_recovered_from_their_mean():
    """A single fit averages over about a period, and finds less than half of them."""
    flat = surface(14)
    wave = 1.2 * np.sin(np.arange(160) * np.pi / 14).astype(np.float32)
    truth = flat + wave[:, None, None]
    image = photograph(truth, 0.8, 0.005, np.random.default_rng(0))
    out, _ = fit(image, flat)
    found = (out - flat)[20:-20, 20:-20].mean((1, 2)) @ wave[20:-20] / (wave[20:-20] @ wave[20:-20])
    assert 0.7 < found < 1.1


def test_a_dark_photograph_gives_the_same_as_a_bright_one():
    """Lit twice as much on one side as on the other, and exposed with a fifth of the light."""
    truth = surface(14)
    image = photograph(truth, 0.8, 0.002, np.random.default_rng(0))
    bright, dark = (fit(image / darker, truth + 0.4)[0] for darker in (1, 5))
    assert np.nanmax(np.abs(bright - dark)) < 0.02


def test_what_shows_another_part_of_the_pattern_does_not_agree():
    truth = surface(14)
    image = photograph(truth, 0.6, 0.01, np.random.default_rng(0))
    (right, agreement), (wrong, other) = (fit(image, truth + off) for off in (0, 20))
    assert np.isfinite(right).all() and np.isfinite(wrong).all()
    assert np.quantile(agreement, 0.05) > np.median(other) + 0.1


def test_unknown_stays_unknown_and_a_tear_is_not_smoothed():
    truth = surface(14)
    truth[:, 80:] += (31, 17)
    truth[100:104] = np.nan
    image = photograph(np.nan_to_num(truth), 0.4, 0.005, np.random.default_rng(0))
    out, _ = fit(image, truth)
    assert (np.isnan(out) == np.isnan(truth)).all()
    assert np.nanmax(np.linalg.norm(out - truth, axis=-1)[:95, 82:]) < 1.5


def test_what_is_not_trusted_does_not_pull_at_the_pattern():
    """A dark stripe, as a narrow gap in the surface shows it, across which the coordinates run on."""
    truth = surface(14)
    image = photograph(truth, 0.8, 0.005, np.random.default_rng(0))
    trust = np.ones(image.shape, np.float32)
    trust[:, 78:84] = 0.02
    image[:, 78:84] = 0.02
    found = [fit(image, truth, trust=weight)[0] for weight in (trust, None)]
    errors = [np.linalg.norm(coords - truth, axis=-1)[20:-20, 70:92].mean() for coords in found]
    assert errors[0] < 0.5 * errors[1]


def test_a_narrow_bar_keeps_its_own_coordinates():
    """As wide as a period, before a surface whose coordinates it runs into without a tear: windows hold both."""
    truth = surface(14)
    truth[:, 73:87] += (26, 17)
    image = photograph(truth, 0.4, 0.005, np.random.default_rng(0))
    start = cv2.blur(truth, (9, 1))  # 26 pattern pixels over 9 pixels are no tear
    start[:, 77:83] = truth[:, 77:83]
    rows, bar = slice(20, -20), slice(77, 83)
    out, _ = fit(image, start)
    error = np.linalg.norm(out - truth, axis=-1)
    assert np.quantile(error[rows, bar], 0.95) < 2.0  # a tenth of a period
    assert np.median(error[rows, 20:60]) < 0.1  # a plane through the large window, where it holds one surface
