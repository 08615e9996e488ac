"""Epipolar lines against the projection of points in space."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sl_nerfstudio.geometry.devices import (
    Device,
    Intrinsics,
    project,
    unproject,
)
from sl_nerfstudio.geometry.lie import exp_se3, inverse, transform
from sl_nerfstudio.matching.lines import EpipolarLines

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


def seen(projector, distance):
    """Coordinates of the points at a distance along the camera's rays, by projection."""
    row, column = np.mgrid[: CAMERA.h, : CAMERA.w] + 0.5
    rays = unproject(Intrinsics.of(CAMERA, torch.float64), torch.from_numpy(np.stack([column, row], -1)))
    p = transform(inverse(torch.from_numpy(T_CAMERA_PROJECTOR)), rays * torch.from_numpy(distance)[..., None])
    uv, in_front = project(Intrinsics.of(projector, torch.float64), p)
    assert in_front.all()
    return uv.numpy()


def test_coordinates_are_those_of_the_points_in_space(projector):
    lines = EpipolarLines.of(CAMERA, projector, T_CAMERA_PROJECTOR)
    np.testing.assert_allclose(lines.at(1 / DISTANCE), seen(projector, DISTANCE), rtol=2e-6)


def test_slopes_are_derivatives(projector):
    lines, w, step = EpipolarLines.of(CAMERA, projector, T_CAMERA_PROJECTOR), 1 / DISTANCE, 1e-5
    numeric = (seen(projector, 1 / (w + step)) - seen(projector, 1 / (w - step))) / (2 * step)
    np.testing.assert_allclose(lines.slopes(w), numeric, rtol=1e-4, atol=1e-3)


def test_the_nearest_place_on_a_line_is_found_also_from_beside_it(projector):
    lines, w = EpipolarLines.of(CAMERA, projector, T_CAMERA_PROJECTOR), 1 / DISTANCE
    np.testing.assert_allclose(lines.nearest(lines.at(w)), w, rtol=1e-4)
    slope = lines.slopes(w)
    across = np.stack([-slope[..., 1], slope[..., 0]], -1) / np.linalg.norm(slope, axis=-1, keepdims=True)
    beside = (lines.at(w) + 3 * across).astype(np.float32)
    apart = beside - lines.at(lines.nearest(beside))
    assert abs((apart * slope).sum(-1)).max() < 0.02 * np.linalg.norm(slope, axis=-1).max()
    assert np.linalg.norm(apart, axis=-1).max() < 3.01


def test_one_distance_for_all_pixels_is_the_same_with_and_without_distortion(projector):
    offset = np.random.default_rng(0).normal(size=(30, 40, 2)).astype(np.float32)
    lines = replace(EpipolarLines.of(CAMERA, projector, T_CAMERA_PROJECTOR), offset=offset)
    x, y = np.empty((30, 40), np.float32), np.empty((30, 40), np.float32)
    lines.pixels_at(0.3, x, y)
    np.testing.assert_allclose(np.stack([x, y], -1) + 0.5, lines.at(np.full((30, 40), 0.3)), atol=1e-3)


def test_what_the_projector_does_not_see_has_no_coordinates():
    turned = T_CAMERA_PROJECTOR.copy()
    turned[:3, :3] = turned[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    lines = EpipolarLines.of(CAMERA, PROJECTORS["pinhole"], turned)
    assert np.isnan(lines.at(1 / DISTANCE)).all()
    x, y = np.empty((30, 40), np.float32), np.empty((30, 40), np.float32)
    lines.pixels_at(0.3, x, y)
    assert (x < -1000).all() and (y < -1000).all()
    assert np.isnan(lines.nearest(np.full((30, 40, 2), 100.0, np.float32))).all()


def test_a_part_is_the_part_of_the_whole(projector):
    lines, box = EpipolarLines.of(CAMERA, projector, T_CAMERA_PROJECTOR), (slice(3, 20), slice(10, 31))
    np.testing.assert_array_equal(lines.part(box).at(1 / DISTANCE[box]), lines.at(1 / DISTANCE)[box])
