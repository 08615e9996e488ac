"""The coded grid: nodes where they should be, gaps as the symbols say, and nothing else."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.pattern.codes import rotate_codes
from sl_nerfstudio.pattern.grid import GridPattern, gaussian_window, normalise_locally, projected_light, sample_bilinear

_PERIOD, _GAP, _WIDTH = 20.0, 6.0, 4.0


def _grid(symbol):
    """A 7 x 7 grid of plain crossings but for `symbol` in the middle."""
    codes = np.zeros((7, 7), dtype=np.int8)
    codes[3, 3] = symbol
    return GridPattern(w=140, h=140, period=_PERIOD, line_width=_WIDTH, gap=_GAP, codes=codes)


def _place_of_line(grid, node, along, axis):
    """Centre of light across a line, `along` it from a node: of the horizontal line for axis 1."""
    across = np.linspace(-8, 8, 321)
    uv = np.stack([across, np.full_like(across, along)], -1)[:, :: -1 if axis == 1 else 1]
    light = grid.intensity(node + uv)
    return (light * across).sum() / light.sum()


@pytest.mark.parametrize(
    ("symbol", "offsets"), list(enumerate([(0, 0, 0, 0), (-1, 1, 0, 0), (1, -1, 0, 0), (0, 0, 1, -1), (0, 0, -1, 1)]))
)
def test_each_symbol_shifts_its_segments_by_half_a_gap(symbol, offsets):
    grid, at = _grid(symbol), 9.0  # places off the crossing, where only one line is seen
    shrink = 1 - at / _PERIOD  # a segment returns to the next node, which has no gap
    sides = ((-at, 1), (at, 1), (-at, 0), (at, 0))  # left, right, above, below
    measured = [_place_of_line(grid, grid.nodes()[3, 3], *side) for side in sides]
    np.testing.assert_allclose(measured, np.array(offsets) * _GAP / 2 * shrink, atol=0.02)


def test_lines_have_their_width_and_nodes_their_places():
    grid = GridPattern(dark=0.25)
    x = np.linspace(20.0, 40.0, 4001)[:-1]  # one period, away from crossings
    light = _grid(0).intensity(np.stack([x, np.full_like(x, 60.0)], -1))
    assert light.mean() * _PERIOD == pytest.approx(_WIDTH, abs=0.01) and light.max() == 1 and light.min() == 0
    assert grid.render().min() == pytest.approx(0.25) and grid.render().max() == 1
    np.testing.assert_allclose(grid.nodes()[[0, 2, -1], [0, 5, -1]], [(10, 10), (110, 50), (790, 790)])
    assert (grid.intensity(grid.nodes()[grid.codes == 0]) == 1).all()


def test_turning_the_picture_is_turning_the_codes():
    grid = GridPattern(w=200, h=200, seed=2)
    turned = GridPattern(w=200, h=200, codes=rotate_codes(grid.codes, 1))
    np.testing.assert_allclose(np.rot90(grid.render(), -1), turned.render(), atol=1e-6)


# Bilinear look-up: exact for what bilinear functions are, by the scan's pixel convention.


@given(st.integers(0, 10_000))
def test_a_bilinear_image_is_reproduced_between_its_pixels(seed):
    rng = np.random.default_rng(seed)
    h, w = rng.integers(2, 12, 2)
    a, b, c, d = rng.uniform(-1, 1, 4)

    def value(x, y):
        return a + b * x + c * y + d * x * y

    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    uv = rng.uniform((0.5, 0.5), (w - 0.5, h - 0.5), (50, 2))
    image = value(x, y).astype(np.float32)
    np.testing.assert_allclose(sample_bilinear(image, uv), value(*uv.T), atol=2e-4)
    beyond = uv + rng.uniform(-9, 9, uv.shape)  # values at the border continue
    expected = value(*np.clip(beyond, 0.5, (w - 0.5, h - 0.5)).T)
    expected[7], beyond[7, 1] = np.nan, np.nan
    np.testing.assert_allclose(sample_bilinear(image, beyond.reshape(5, 10, 2)), expected.reshape(5, 10), atol=2e-4)


# The projector's light that a surface returns, measured in an image under the pattern.


GRID = GridPattern(w=800, h=800)
PICTURE = GRID.render()
SIZE, PIXELS = 240, 12.0  # of the image; of a period in it
SIGMA = 0.5 * PIXELS


def upright() -> np.ndarray:
    """Coordinates of an image that shows the pattern enlarged, a little turned."""
    x, y = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    scale = GRID.period / PIXELS
    return (np.stack([0.98 * x + 0.2 * y, -0.2 * x + 0.98 * y + 60], -1) * scale).astype(np.float32)


def seen(coords: np.ndarray, picture: np.ndarray) -> np.ndarray:
    return cv2.remap(picture, coords[..., 0] - 0.5, coords[..., 1] - 0.5, cv2.INTER_LINEAR)


def inner(values: np.ndarray) -> np.ndarray:
    return values[20:-20, 20:-20]


def waves(length: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    return np.cos(2 * np.pi * x / length) * np.cos(2 * np.pi * y / length)


def test_light_is_found_whatever_the_room_adds():
    coords = upright()
    albedo, room = 0.5 + 0.2 * waves(90), 0.2 + 0.15 * waves(140)
    image = albedo * seen(coords, PICTURE) + room
    found = projected_light(image, coords, [PICTURE], SIGMA)
    assert np.abs(inner(found) / inner(albedo) - 1).mean() < 0.03
    assert np.corrcoef(inner(found).ravel(), inner(albedo).ravel())[0, 1] > 0.98


def test_a_soft_image_is_compared_with_the_pattern_as_soft():
    """With a sharp one, thin lines would seem darker than wide ones, and the code would be taken for the surface."""
    coords = upright()
    sharp, soft = PICTURE, cv2.GaussianBlur(PICTURE, (0, 0), 0.15 * GRID.period)
    image = 0.6 * seen(coords, soft)
    wrong, right = (projected_light(image, coords, some, SIGMA) for some in ([sharp], [sharp, soft]))
    assert np.abs(inner(right) - 0.6).max() < 0.01
    assert inner(wrong).std() > 10 * inner(right).std()


def test_nothing_is_said_where_nothing_was_decoded():
    coords = upright()
    coords[:, 100:] = np.nan
    found = projected_light(0.5 * np.nan_to_num(seen(upright(), PICTURE)), coords, [PICTURE], SIGMA)
    assert np.isnan(found[:, 100:]).all()
    np.testing.assert_allclose(found[20:-20, 20:99], 0.5, atol=0.02)
    assert np.isnan(projected_light(np.ones((SIZE, SIZE)), np.full_like(coords, np.nan), [PICTURE], SIGMA)).all()


# Local normalisation: the pattern is recovered under any light, albedo and exposure.


@pytest.fixture(scope="module")
def pattern():
    return GridPattern(w=240, h=240, seed=1).render()


def _disc(pattern):
    y, x = np.mgrid[: pattern.shape[0], : pattern.shape[1]]
    return (x - 120) ** 2 + (y - 110) ** 2 < 90**2


def test_albedo_shading_and_room_light_are_taken_out(pattern):
    y, x = np.mgrid[:240, :240] / 240
    shading = 0.15 + 0.8 * x * (0.6 + 0.4 * np.cos(9 * y))
    mask = _disc(pattern)
    out = normalise_locally(0.03 + shading * pattern, mask, 16.0, float(pattern.mean()), float(pattern.std()))
    inner = mask & np.roll(mask, 8, 0) & np.roll(mask, -8, 0) & np.roll(mask, 8, 1) & np.roll(mask, -8, 1)
    a, b = out[inner], pattern[inner]
    assert np.corrcoef(a, b)[0, 1] > 0.97
    assert (a @ b) / np.linalg.norm(a) / np.linalg.norm(b) > 0.985
    assert np.corrcoef(shading[inner] * b, b)[0, 1] < 0.93  # what there was to be taken out


def test_light_and_what_is_outside_change_nothing(pattern):
    mask, noise = _disc(pattern), np.random.default_rng(0).uniform(0, 100, pattern.shape)
    once = normalise_locally(np.where(mask, pattern, noise), mask, 12.0)
    assert np.array_equal(once, normalise_locally(np.where(mask, pattern, 0), mask, 12.0))
    np.testing.assert_allclose(normalise_locally(0.2 * pattern + 0.1, mask, 12.0), once, atol=2e-3)
    assert (once[~mask] == 0).all() and once.min() >= 0 and once.max() <= 1
    assert (normalise_locally(pattern, np.zeros_like(mask), 3.0) == 0).all()
    flat = normalise_locally(np.full((20, 20), 0.4), np.ones((20, 20), bool), 3.0, mean=0.3)
    np.testing.assert_allclose(flat, 0.3, atol=1e-3)


# Means in wide windows are those of the window itself, written as a sum.


def direct(values, sigma):
    """By the definition, one axis after the other, in float64."""
    for axis, size in enumerate(values.shape[:2]):
        at = np.arange(size)
        weight = np.exp(-((at[:, None] - at) ** 2) / (2 * sigma**2)) / (np.sqrt(2 * np.pi) * sigma)
        values = np.moveaxis(np.tensordot(weight, values, (1, axis)), 0, axis)
    return values


@pytest.mark.parametrize("sigma", [2.0, 5.9, 6.0, 11.3, 28.0])
@pytest.mark.parametrize("shape", [(97, 130), (131, 96, 3)])
def test_means_are_those_of_the_definition(sigma, shape):
    """A step, a corner and noise: also across the border of the image, where it continues with zeros."""
    rng = np.random.default_rng(0)
    values = rng.normal(0.5, 0.3, shape).astype(np.float32)
    values[:40, 60:] += 1
    found, expected = gaussian_window(values, sigma), direct(values.astype(float), sigma)
    assert found.shape == shape and found.dtype == np.float32
    assert np.abs(found - expected).max() < 0.03 * np.ptp(expected)
    assert np.abs(found - expected).mean() < 0.004 * np.ptp(expected)


@pytest.mark.parametrize("sigma", [4.0, 19.0])
def test_a_linear_image_keeps_its_values_and_quotients_are_means_over_a_part(sigma):
    y, x = np.mgrid[:300, :300].astype(np.float32)
    part = (y > 150).astype(np.float32)
    means = gaussian_window(np.dstack([2 * x + y, np.ones_like(x), part, 7 * part]), sigma)[100:200, 100:200]
    np.testing.assert_allclose(means[..., 0], (2 * x + y)[100:200, 100:200], rtol=1e-3)
    np.testing.assert_allclose(means[..., 1], 1, rtol=1e-3)
    np.testing.assert_allclose(means[55:, :, 3] / means[55:, :, 2], 7, rtol=1e-5)
