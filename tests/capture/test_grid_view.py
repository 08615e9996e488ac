"""Views of the coded grid: nodes lie where the truth says, and differences tell moved from resting devices."""

import cv2
import numpy as np
import pytest

from sl_nerfstudio.capture.selection import Exposure, GridReader, GridView, PlainReader, measure_light
from tests.capture.photographs import PATTERN, SIZE, homography, photograph


@pytest.fixture(scope="module")
def reader():
    return GridReader(PATTERN)


@pytest.fixture(scope="module")
def picture():
    return PATTERN.render(2)


@pytest.fixture(scope="module")
def view(reader, picture):
    return reader.read(photograph(picture, homography()))


@pytest.mark.parametrize("roll", [10, 100, 185, 260])
def test_nodes_are_where_they_are(reader, picture, roll):
    matrix = homography(roll=roll, scale=0.85)
    found = reader.read(photograph(picture, matrix))
    true = cv2.perspectiveTransform(PATTERN.nodes().reshape(-1, 1, 2), matrix).reshape(found.uv.shape)
    inside = (true > 8).all(-1) & (true < np.array(SIZE) - 8).all(-1)
    assert found.seen[inside].mean() > 0.8
    assert np.linalg.norm(found.uv - true, axis=-1)[found.seen].max() < 2.5
    assert found.period == pytest.approx(17, rel=0.15)


def test_large_images_are_read_at_a_smaller_size_but_in_their_own_pixels(reader, picture, view):
    large = cv2.resize(photograph(picture, homography()), None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    found = reader.read(large)
    both = found.seen & view.seen
    assert both.sum() > 0.9 * view.seen.sum()
    assert np.linalg.norm(found.uv - 3 * view.uv, axis=-1)[both].max() < 6
    assert found.period == pytest.approx(3 * view.period, rel=0.1)


def test_an_image_without_the_pattern_shows_no_nodes(reader):
    found = reader.read(np.full((300, 400, 3), 90, dtype=np.uint8))
    assert not found.seen.any() and found.blur is None and found.light == Exposure(0.0, 0.0)


def test_defocus_is_measured_in_periods(reader, picture, view):
    soft = reader.read(photograph(picture, homography(), blur=2.3))
    assert view.blur < 0.12 < soft.blur
    assert soft.blur == pytest.approx(np.hypot(2.3, 0.5) / view.period, abs=0.04)


def test_the_difference_is_nothing_for_resting_devices_and_large_for_moved_ones(reader, picture, view):
    again = reader.read(photograph(picture, homography(), seed=1, light=140))
    moved = reader.read(photograph(picture, homography(shift=(9.0, 0.0))))
    assert view.difference(again) < 0.1 and again.difference(view) == view.difference(again)
    assert view.difference(moved) > 0.95


def _view(uv, period=10.0):
    return GridView(np.array(uv, dtype=np.float32).reshape(1, -1, 2), period, 0.1, Exposure(0.0, 0.0))


def test_the_difference_counts_nodes():
    nan = [np.nan, np.nan]
    a = _view([[10, 10], [20, 10], [30, 10], nan])
    b = _view([[12, 10], [23, 10], nan, [40, 10]])  # a fifth of a period, more than a quarter, gone, new
    assert a.difference(b) == b.difference(a) == pytest.approx(3 / 4)
    assert a.difference(a) == 0 and _view([nan]).difference(_view([nan])) == 1


def test_light_is_measured_where_the_pattern_is():
    grey = np.full((60, 60), 0.5, dtype=np.float32)
    grey[:, 40:] = 1.0
    grey[:30, :20] = 0.02
    whole = measure_light(grey)
    assert whole.saturated == pytest.approx(1 / 3) and whole.dark == pytest.approx(17 * 27 / 3600)
    dark, bright, good = [5.0, 5.0], [55.0, 30.0], [30.0, 50.0]
    for places, shares in (([dark], (0, 1)), ([bright], (1, 0)), ([good], (0, 0)), ([dark, good], (0, 0.5))):
        light = measure_light(grey, np.array(places, dtype=np.float32), 8.0)
        assert (light.saturated, light.dark) == shares


def test_without_a_pattern_light_and_edges_are_measured():
    image = np.zeros((100, 100), dtype=np.uint8)
    image[:, 50:] = 200
    view = PlainReader().read(cv2.GaussianBlur(image, (0, 0), 3.0))
    assert view.uv.size == 0 and view.edge == pytest.approx(3.0, abs=0.3) and view.light.saturated == 0
