"""Which views are kept, and the first reason against the others."""

import cv2
import numpy as np
import pytest

from sl_nerfstudio.capture.selection import (
    Exposure,
    GridReader,
    GridView,
    PlainReader,
    Selection,
    SelectionVerdict,
    measure_light,
)
from tests.capture.photographs import PATTERN, SIZE, homography, photograph

GOOD = Exposure(0.0, 0.0)
PICTURE = PATTERN.render(2)


def view(shift=0.0, nodes=100, blur=0.1, light=GOOD, edge=None):
    uv = np.full((10, 10, 2), np.nan, dtype=np.float32)
    x, y = np.meshgrid(np.arange(10) * 10.0, np.arange(10) * 10.0)
    uv.reshape(-1, 2)[:nodes] = np.stack([x.ravel() + shift, y.ravel()], -1)[:nodes]
    return GridView(uv, 10.0, blur, light, edge)


@pytest.mark.parametrize(
    ("seen", "verdict"),
    [
        (view(), SelectionVerdict.KEEP),
        (view(nodes=47), SelectionVerdict.NO_PATTERN),
        (view(nodes=0, light=Exposure(0.6, 0.0)), SelectionVerdict.SATURATED),
        (view(nodes=0, light=Exposure(0.0, 0.95)), SelectionVerdict.DARK),
        (view(nodes=0, edge=2.5), SelectionVerdict.BLURRED),
        (view(nodes=0, edge=0.9), SelectionVerdict.NO_PATTERN),
        (view(blur=0.16), SelectionVerdict.BLURRED),
        (view(blur=None), SelectionVerdict.BLURRED),
        (view(light=Exposure(0.2, 0.0)), SelectionVerdict.SATURATED),
        (view(light=Exposure(0.0, 0.4)), SelectionVerdict.DARK),
        (GridView(np.zeros((0, 0, 2), dtype=np.float32), 1.0, None, GOOD), SelectionVerdict.BY_KEY),
    ],
)
def test_the_first_view(seen, verdict):
    assert Selection((10, 10)).judge(seen, 0.0) is verdict


def test_views_that_are_known_are_not_kept_again_and_there_is_a_pause_after_a_frame():
    selection = Selection((10, 10))
    for shift in (0.0, 50.0):
        selection.add(view(shift))
    assert selection.judge(view(1.0), 60.0) is SelectionVerdict.KNOWN  # like the first, not the last
    assert selection.judge(view(25.0), 0.0) is SelectionVerdict.KEEP  # no pause after frames of an earlier run
    selection.add(view(80.0), 5.0)
    assert selection.judge(view(25.0), 5.9) is SelectionVerdict.WAIT
    assert selection.judge(view(25.0), 6.0) is SelectionVerdict.KEEP


def test_how_often_each_node_was_seen():
    selection = Selection((10, 10))
    assert selection.times_seen.tolist() == np.zeros((10, 10)).tolist()
    for nodes in (100, 20, 10):
        selection.add(view(nodes=nodes))
    assert selection.times_seen[:4].sum(1).tolist() == [30, 20, 10, 10]


# Views of the coded grid: nodes lie where the truth says, and differences tell moved from resting devices.


@pytest.fixture(scope="module")
def reader():
    return GridReader(PATTERN)


@pytest.fixture(scope="module")
def seen_view(reader):
    return reader.read(photograph(PICTURE, homography()))


@pytest.mark.parametrize("roll", [10, 100, 185, 260])
def test_nodes_are_where_they_are(reader, roll):
    matrix = homography(roll=roll, scale=0.85)
    found = reader.read(photograph(PICTURE, matrix))
    true = cv2.perspectiveTransform(PATTERN.nodes().reshape(-1, 1, 2), matrix).reshape(found.uv.shape)
    inside = (true > 8).all(-1) & (true < np.array(SIZE) - 8).all(-1)
    assert found.seen[inside].mean() > 0.8
    assert np.linalg.norm(found.uv - true, axis=-1)[found.seen].max() < 2.5
    assert found.period == pytest.approx(17, rel=0.15)


def test_large_images_are_read_at_a_smaller_size_but_in_their_own_pixels(reader, seen_view):
    large = cv2.resize(photograph(PICTURE, homography()), None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    found = reader.read(large)
    both = found.seen & seen_view.seen
    assert both.sum() > 0.9 * seen_view.seen.sum()
    assert np.linalg.norm(found.uv - 3 * seen_view.uv, axis=-1)[both].max() < 6
    assert found.period == pytest.approx(3 * seen_view.period, rel=0.1)


def test_the_difference_is_nothing_for_resting_devices_and_large_for_moved_ones(reader, seen_view):
    again = reader.read(photograph(PICTURE, homography(), seed=1, light=140))
    moved = reader.read(photograph(PICTURE, homography(shift=(9.0, 0.0))))
    assert seen_view.difference(again) < 0.1 and again.difference(seen_view) == seen_view.difference(again)
    assert seen_view.difference(moved) > 0.95
    some = [GridView(view().uv.copy(), 10.0, 0.1, GOOD) for _ in range(2)]
    some[0].uv[0, :6] = np.nan  # new, or gone
    some[1].uv[1, :4] += 3.0  # more than a quarter of a period
    some[1].uv[2:] += 1.0
    assert some[0].difference(some[1]) == some[1].difference(some[0]) == pytest.approx(0.1)
    assert some[0].difference(some[0]) == 0 and view(nodes=0).difference(view(nodes=0)) == 1


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


def test_defocus_is_measured_in_periods_or_without_a_pattern_in_pixels(reader, seen_view):
    soft = reader.read(photograph(PICTURE, homography(), blur=2.3))
    assert seen_view.blur < 0.12 < soft.blur
    assert soft.blur == pytest.approx(np.hypot(2.3, 0.5) / seen_view.period, abs=0.04)
    nothing = reader.read(np.full((300, 400, 3), 90, dtype=np.uint8))
    assert not nothing.seen.any() and nothing.blur is None and nothing.light == GOOD
    image = np.zeros((100, 100), dtype=np.uint8)
    image[:, 50:] = 200
    plain = PlainReader().read(cv2.GaussianBlur(image, (0, 0), 3.0))
    assert plain.uv.size == 0 and plain.edge == pytest.approx(3.0, abs=0.3) and plain.light.saturated == 0
