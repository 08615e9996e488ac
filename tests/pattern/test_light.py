"""The projector's light that a surface returns, measured in an image under the pattern."""

import cv2
import numpy as np
import pytest

from sl_nerfstudio.pattern.grid import GridPattern, projected_light

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


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_light_is_in_the_unit_of_the_image(factor):
    coords = upright()
    image = seen(coords, PICTURE) * (0.5 + 0.1 * waves(60))
    once, scaled = (projected_light(f * image, coords, [PICTURE], SIGMA) for f in (1.0, factor))
    np.testing.assert_allclose(scaled, factor * once, rtol=1e-4, atol=1e-5)


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
