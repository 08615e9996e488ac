"""The solver: exact corners give the exact devices, and its equations are those of finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import approx_fprime

from sl_nerfstudio.calibration.board_adjustment import (
    BoardView,
    Corners,
    FreeIntrinsics,
    adjust,
    camera_start,
    covariance,
    kernel,
    moved,
    normal_equations,
    place_boards,
    projector_start,
    residuals,
    sightings,
)
from sl_nerfstudio.geometry.lie import exp_se3
from tests.calibration.board_scenes import CAMERA, DOE, PLAIN_CAMERA, PLAIN_PROJECTOR, POINTS, PROJECTOR, make_scene

TANGENTIAL = replace(CAMERA, fl_y=1490.0, p1=0.002, p2=-0.001)
ALL, PLAIN, ONE, TWO = FreeIntrinsics(True, 4), FreeIntrinsics(), FreeIntrinsics(False, 1), FreeIntrinsics(False, 2)


def solved(scene, free, model="OPENCV", points=POINTS):
    start = camera_start(scene.views, scene.sizes[0], points)
    if len(free) == 2:
        start = projector_start(start, scene.views, scene.sizes[1], points, model)
    return adjust(start.rig, free, sightings(scene.views, points)[: len(free)])


@pytest.mark.parametrize(
    ("camera", "projector", "free"),
    [
        pytest.param(CAMERA, PROJECTOR, (TWO, ONE), marks=pytest.mark.slow),
        pytest.param(TANGENTIAL, PLAIN_PROJECTOR, (ALL, PLAIN), marks=pytest.mark.slow),
        (CAMERA, None, (TWO,)),
        (TANGENTIAL, replace(DOE, k1=0.1), (ALL, ALL)),
    ],
    ids=["lens shift", "tangential", "camera alone", "all of DOE"],
)
def test_exact_corners_give_the_exact_devices_and_poses(camera, projector, free):
    scene = make_scene(1, count=4, camera=camera, projector=projector)
    found = solved(scene, free, "OPENCV" if projector is None else projector.model)
    for got, true in zip(found.rig.devices, scene.truth.devices, strict=True):
        assert (got.w, got.h, got.model) == (true.w, true.h, true.model)
        np.testing.assert_allclose(got.parameters, true.parameters, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(found.rig.T_camera_board, scene.truth.T_camera_board, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.rig.T_projector_camera, scene.truth.T_projector_camera, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("device", "aspect"),
    [
        pytest.param("camera", 0.7, marks=pytest.mark.slow),
        pytest.param("projector", 0.5, marks=pytest.mark.slow),
        ("projector", 2.0),
    ],
)
def test_pixels_need_not_be_square(device, aspect):
    """A projector of 912 x 1140 diamond pixels has fl_y = 2 fl_x; the field of view stays that of square ones."""

    def bent(one):
        return replace(one, h=round(aspect * one.h), fl_y=aspect * one.fl_y, cy=aspect * one.cy)

    devices = {"camera": PLAIN_CAMERA, "projector": PLAIN_PROJECTOR}
    scene = make_scene(1, 5, noise=0.05, **(devices | {device: bent(devices[device])}))
    start = camera_start(scene.views, scene.sizes[0], POINTS)
    start = projector_start(start, scene.views, scene.sizes[1], POINTS, "OPENCV")
    assert [one.aspect for one in start.free] == [device == "camera", device == "projector"]
    for got, true in zip(start.rig.devices, scene.truth.devices, strict=True):
        np.testing.assert_allclose(got.parameters[:2], true.parameters[:2], rtol=0.01)
    assert max(start.sigma_px) < 0.1


@pytest.mark.slow
def test_the_unit_of_the_board_changes_lengths_alone():
    scene = make_scene(2, count=4, noise=0.1)
    mm, m = (solved(scene, (ONE, ONE), points=POINTS * unit) for unit in (1.0, 1e-3))
    for one, other in zip(mm.rig.devices, m.rig.devices, strict=True):
        np.testing.assert_allclose(other.parameters, one.parameters, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(m.rig.T_camera_board[:, :3, 3] * 1e3, mm.rig.T_camera_board[:, :3, 3], rtol=1e-5)


@pytest.mark.slow
def test_corners_that_are_wrong_do_not_matter():
    scene, rng = make_scene(3, count=6, noise=0.1), np.random.default_rng(0)

    def damaged(corners):
        wrong = rng.random(len(corners.ids)) < 0.05
        away = rng.standard_normal(corners.uv.shape)
        away *= 20 / np.linalg.norm(away, axis=1, keepdims=True)
        return Corners(corners.ids, corners.uv + wrong[:, None] * away)

    views = [BoardView(view.name, damaged(view.camera), damaged(view.projector)) for view in scene.views]
    clean, other = solved(scene, (ONE, ONE)), solved(replace(scene, views=views), (ONE, ONE))
    for found in (clean, other):
        for got, true in zip(found.rig.devices, scene.truth.devices, strict=True):
            assert abs(got.fl_x / true.fl_x - 1) < 0.003 and abs(got.cy - true.cy) < 5
    np.testing.assert_allclose(other.sigma_px, clean.sigma_px, rtol=0.15)


def test_boards_are_placed_by_their_corners_in_the_camera():
    scene = make_scene(3, count=3)
    twists = torch.from_numpy(np.random.default_rng(0).normal(0, 1, (3, 6)) * [5, 5, 5, 0.02, 0.02, 0.02])
    start = replace(scene.truth, T_camera_board=exp_se3(twists).numpy() @ scene.truth.T_camera_board)
    found = place_boards(start, scene.seen[0], 0.1)
    np.testing.assert_allclose(found.T_camera_board, scene.truth.T_camera_board, atol=1e-3)


@pytest.fixture(scope="module", params=["OPENCV", "DOE"])
def near(request):
    """A rig close to the truth, so that residuals are not zero, its corners, and all intrinsics to fit."""
    projector = replace(PROJECTOR if request.param == "OPENCV" else DOE, k2=0.02, p1=0.001, p2=-0.002)
    scene = make_scene(4, count=3, noise=0.5, camera=TANGENTIAL, projector=projector)
    return scene.truth, scene.seen, (ALL, ALL)


def dense_jacobian(rig, free, seen, k):
    """Derivatives of the predictions by 8 + 8 intrinsics, the rig and the boards, by central differences."""
    columns = []
    for step in 1e-6 * np.eye(22 + 6 * len(rig.T_camera_board)):
        ahead, back = (moved(rig, free, s * step[:22], s * step[22:].reshape(-1, 6)) for s in (1, -1))
        columns.append((residuals(back, k, seen[k]) - residuals(ahead, k, seen[k])) / 2e-6)
    return np.stack(columns, -1)


def test_equations_are_those_of_the_dense_problem(near):
    rig, seen, free = near
    sigma, H, g = (0.5, 0.7), 0.0, 0.0
    for k in (0, 1):
        e = residuals(rig, k, seen[k]) / sigma[k]
        w = np.repeat(kernel(e)[1], 2)
        J = (dense_jacobian(rig, free, seen, k) / sigma[k]).reshape(len(w), -1)
        H, g = H + (J * w[:, None]).T @ J, g - (J * w[:, None]).T @ e.ravel()
    found = normal_equations(rig, free, seen, sigma)
    scale = 1 / np.sqrt(np.diag(H))
    whole, right = np.zeros_like(H), np.concatenate([found.g, found.g_block.ravel()])
    whole[:22, :22] = found.H
    for b in range(len(rig.T_camera_board)):
        own = slice(22 + 6 * b, 28 + 6 * b)
        whole[own, own], whole[:22, own], whole[own, :22] = found.H_block[b], found.coupling[b], found.coupling[b].T
    np.testing.assert_allclose(whole * scale[:, None] * scale, H * scale[:, None] * scale, atol=2e-5)
    np.testing.assert_allclose(right * scale, g * scale, atol=1e-4 * np.abs(g * scale).max())


def test_the_weights_are_the_derivative_of_the_cost():
    r = np.random.default_rng(0).normal(0, 4, (20, 2))
    slope = np.array([approx_fprime(one, lambda x: float(kernel(x[None])[0][0]), 1e-7) for one in r])
    np.testing.assert_allclose(slope, 2 * kernel(r)[1][:, None] * r, rtol=1e-4, atol=1e-5)


def test_covariance_is_the_inverse_and_huge_where_nothing_is_known():
    A = np.random.default_rng(0).standard_normal((9, 4)) * (1, 1e3, 1e-3, 1)
    np.testing.assert_allclose(covariance(A.T @ A), np.linalg.inv(A.T @ A), rtol=1e-6)
    A[:, 3] = A[:, 0]
    found = covariance(A.T @ A)
    assert found[3, 3] > 1e10 and found[1, 1] < 1e-4
