"""Period and roll of the grid, and the image rectified by them."""

import cv2
import numpy as np
import pytest

from sl_nerfstudio.decoding.grid_phases import (
    MULTIPLE,
    RECTIFIED_PERIOD,
    GridAppearance,
    guess_appearances,
    network_channels,
    rectify,
)
from sl_nerfstudio.pattern.grid import GridPattern

GRID = GridPattern(codes=np.random.default_rng(1).integers(0, 5, (40, 40)).astype(np.int8))


def capture(pixels_a_period, roll_deg, size=300):
    """The plain pattern turned clockwise by `roll_deg`."""
    x, y = np.meshgrid(*[np.arange(size) + 0.5 - size / 2] * 2)
    a, scale = np.radians(roll_deg), 20 / pixels_a_period
    uv = np.stack([np.cos(a) * x + np.sin(a) * y, -np.sin(a) * x + np.cos(a) * y], -1) * scale + 400
    return cv2.GaussianBlur((0.05 + 0.7 * GRID.intensity(uv)).astype(np.float32), (0, 0), 0.7)


@pytest.mark.parametrize("pixels", [8, 12, 20, 30])
@pytest.mark.parametrize("roll", [0, 20, -33, 70])
def test_period_and_roll_are_found(pixels, roll):
    found = guess_appearances(capture(pixels, roll))[0]
    off = (np.degrees(found.roll) - roll + 45) % 90 - 45  # up to quarter turns
    assert abs(off) < 4
    assert abs(np.log(found.period / pixels)) < 0.12
    assert abs(found.roll) <= np.pi / 4


def test_a_blank_image_has_no_grid():
    assert guess_appearances(np.full((200, 300), 0.3, np.float32)) == []


@pytest.mark.parametrize("shape", [(90, 130), (40, 500), (128, 128)])
def test_small_images_are_searched_too(shape):
    found = guess_appearances(capture(12, 0, 500)[: shape[0], : shape[1]])[0]
    assert abs(np.log(found.period / 12)) < 0.2 and abs(np.degrees(found.roll)) < 6


def test_the_rectified_image_agrees_with_its_map():
    image = np.zeros((200, 260), np.float32)
    image[150, 70] = 1
    soft = cv2.GaussianBlur(image, (0, 0), 3)
    for appearance in (GridAppearance(10.0, 0.3), GridAppearance(28.0, -0.6), GridAppearance(14.0, 0.0)):
        rectified = rectify(soft, appearance)
        assert rectified.image.shape[0] % MULTIPLE == 0 and rectified.image.shape[1] % MULTIPLE == 0
        y, x = np.mgrid[: rectified.image.shape[0], : rectified.image.shape[1]] + 0.5
        found = np.array([(rectified.image * x).sum(), (rectified.image * y).sum()]) / rectified.image.sum()
        assert np.allclose(found, rectified.from_image @ (70.5, 150.5, 1), atol=0.1)
        assert np.isclose(np.sqrt(np.linalg.det(rectified.from_image[:, :2])), RECTIFIED_PERIOD / appearance.period)


def test_a_turned_grid_is_upright_afterwards():
    rectified = rectify(capture(20, 30), GridAppearance(20.0, np.radians(30)))
    found = guess_appearances(rectified.image)[0]
    assert abs(np.degrees(found.roll)) < 4 and abs(found.period / RECTIFIED_PERIOD - 1) < 0.1


def test_channels_do_not_change_with_exposure():
    image = capture(14, 5)
    assert np.allclose(network_channels(image), network_channels(0.3 * image), atol=1e-4)
