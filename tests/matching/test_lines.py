"""Epipolar lines against the projection of points in space, and the inverse distances that are tried along them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.geometry.lie import exp_se3, inverse, transform
from sl_nerfstudio.matching.lines import EpipolarLines, hypotheses, pixels_a_period, places_on_lines, with_offset
from tests.matching.scene import PERIOD, across, step_scene

CAMERA = Device(w=40, h=30, fl_x=90.0, fl_y=92.0, cx=19.0, cy=16.0, k1=-0.1, k2=0.02, p1=0.002, p2=-0.001)
PROJECTORS = {
    "pinhole": Device(w=200, h=150, fl_x=300.0, fl_y=310.0, cx=90.0, cy=160.0),
    "distorting": Device(w=200, h=150, fl_x=300.0, fl_y=310.0, cx=90.0, cy=80.0, k1=0.05, k2=-0.01, p1=0.001),
    "diffractive": Device(w=200, h=150, fl_x=320.0, fl_y=320.0, cx=100.0, cy=75.0, model="DOE"),
}
T_CAMERA_PROJECTOR = exp_se3(torch.tensor([0.9, 0.1, 0.2, 0.05, 0.3, -0.02], dtype=torch.float64)).numpy()
DISTANCE = 2.0 + np.linspace(0, 1.5, 30 * 40).reshape(30, 40)


@pytest.fixture(params=PROJECTORS)
def projector(request):
    return PROJECTORS[request.param]


@pytest.fixture(scope="module")
def scene():
    return step_scene()


def seen(projector, distance):
    """Coordinates of the points at a distance along the camera's rays, by projection."""
    row, column = np.mgrid[: CAMERA.h, : CAMERA.w] + 0.5
    rays = unproject(Intrinsics.of(CAMERA, torch.float64), torch.from_numpy(np.stack([column, row], -1)))
    p = transform(inverse(torch.from_numpy(T_CAMERA_PROJECTOR)), rays * torch.from_numpy(distance)[..., None])
    uv, in_front = project(Intrinsics.of(projector, torch.float64), p)
    assert in_front.all()
    return uv.numpy()


def places(lines, w):
    code, parameters, centre, planes = lines.for_tiles
    x, y = np.empty(30 * 40, np.float32), np.empty(30 * 40, np.float32)
    places_on_lines(code, parameters, planes.reshape(5, -1), centre, w, x, y)
    return x.reshape(30, 40), y.reshape(30, 40)


def test_coordinates_slopes_and_nearest_places_are_those_of_the_points_in_space(projector):
    lines, w, step = EpipolarLines.of(CAMERA, projector, T_CAMERA_PROJECTOR), 1 / DISTANCE, 1e-5
    np.testing.assert_allclose(lines.at(w), seen(projector, DISTANCE), rtol=2e-6)
    slope = lines.slopes(w)
    numeric = (seen(projector, 1 / (w + step)) - seen(projector, 1 / (w - step))) / (2 * step)
    np.testing.assert_allclose(slope, numeric, rtol=1e-4, atol=1e-3)
    box = (slice(3, 20), slice(10, 31))
    np.testing.assert_array_equal(lines.part(box).at(w[box]), lines.at(w)[box])
    np.testing.assert_allclose(lines.nearest(lines.at(w)), w, rtol=1e-4)
    beside = (lines.at(w) + 3 * across(lines, w)).astype(np.float32)
    apart = beside - lines.at(lines.nearest(beside))
    assert abs((apart * slope).sum(-1)).max() < 0.02 * np.linalg.norm(slope, axis=-1).max()
    assert np.linalg.norm(apart, axis=-1).max() < 3.01
    offset = np.random.default_rng(0).normal(size=(30, 40, 2)).astype(np.float32)
    lines = replace(lines, offset=offset)
    x, y = places(lines, 0.3)  # one distance for all pixels
    np.testing.assert_allclose(np.stack([x, y], -1) + 0.5, lines.at(np.full((30, 40), 0.3)), atol=1e-3)


def test_what_the_projector_does_not_see_has_no_coordinates():
    turned = T_CAMERA_PROJECTOR.copy()
    turned[:3, :3] = turned[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    lines = EpipolarLines.of(CAMERA, PROJECTORS["pinhole"], turned)
    assert np.isnan(lines.at(1 / DISTANCE)).all() and max(place.max() for place in places(lines, 0.3)) < -1000
    assert np.isnan(lines.nearest(np.full((30, 40, 2), 100.0, np.float32))).all()


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_the_range_holds_all_distances_and_steps_are_a_tenth_of_a_period(scene, share):
    coords, everywhere = scene.coords.copy(), np.ones(scene.image.shape, bool)
    coords[:, round(200 * share) :] = np.nan
    w = hypotheses(scene.lines, coords, scene.lines.nearest(coords), everywhere, PERIOD)
    assert w[0] < scene.inverse_distance.min() and w[-1] > scene.inverse_distance.max()
    step = np.linalg.norm(scene.lines.slopes(scene.inverse_distance), axis=-1) * (w[1] - w[0])
    assert np.median(step) == pytest.approx(0.1 * PERIOD, rel=0.1)
    coords[:] = np.nan  # without anything near its line there is no range
    assert hypotheses(scene.lines, coords, scene.lines.nearest(coords), everywhere, PERIOD) is None


def test_lines_are_moved_to_what_was_decoded_and_wrong_coordinates_do_not_count(scene):
    beside = across(scene.lines, scene.inverse_distance)
    coords = (scene.coords + 0.8 * beside).astype(np.float32)
    wild = np.random.default_rng(0).random(coords.shape[:2]) < 0.1
    coords[wild] += (40 * beside[wild]).astype(np.float32)
    moved = with_offset(scene.lines, coords, PERIOD, 15.0)
    assert abs(np.median(((moved.offset - scene.lines.offset) * beside).sum(-1)) - 0.8) < 0.08  # held back by 1 / 20
    again = with_offset(moved, scene.coords, PERIOD, 15.0)
    assert abs(np.median(((again.offset - scene.lines.offset) * beside).sum(-1))) < 0.08


@pytest.mark.parametrize("pixels", [8.0, 15.0, 40.0])
def test_the_size_of_a_period_is_measured(pixels):
    y, x = np.mgrid[:120, :130] * PERIOD / pixels
    coords = np.stack([0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y], -1).astype(np.float32)
    coords[30:50] = np.nan
    assert pixels_a_period(coords, PERIOD) == pytest.approx(pixels, rel=1e-3)
    assert pixels_a_period(np.full_like(coords, np.nan), PERIOD) is None
