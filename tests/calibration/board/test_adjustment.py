"""The solver: exact corners give the exact devices, and its equations are those of finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import approx_fprime

from sl_nerfstudio.calibration.board_adjustment import (
    BoardRig,
    BoardView,
    Corners,
    FreeIntrinsics,
    adjust,
    camera_start,
    covariance,
    kernel,
    linearised,
    normal_equations,
    projector_start,
    residuals,
    sightings,
    with_numbers,
)
from sl_nerfstudio.geometry.lie import exp_se3
from tests.calibration.board.scenes import (
    CAMERA,
    DOE,
    PLAIN_CAMERA,
    PLAIN_PROJECTOR,
    POINTS,
    PROJECTOR,
    TERMS,
    make_scene,
)

TANGENTIAL = replace(CAMERA, fl_y=1490.0, p1=0.002, p2=-0.001)
ALL = FreeIntrinsics(True, 4)


def solved(scene, free, model="OPENCV", points=POINTS):
    start = camera_start(scene.views, scene.sizes[0], points)
    if len(free) == 2:
        start = projector_start(start, scene.views, scene.sizes[1], points, model)
    return adjust(start.rig, free, sightings(scene.views, points)[: len(free)])


@pytest.mark.parametrize(
    ("camera", "projector", "free"),
    [
        (CAMERA, PROJECTOR, (TERMS[2], TERMS[1])),
        (PLAIN_CAMERA, DOE, (TERMS[0], TERMS[0])),
        (TANGENTIAL, PLAIN_PROJECTOR, (ALL, TERMS[0])),
        (CAMERA, None, (TERMS[2],)),
        (TANGENTIAL, replace(DOE, k1=0.1), (ALL, FreeIntrinsics(True, 4))),
    ],
    ids=["lens shift", "DOE", "tangential", "camera alone", "all of DOE"],
)
def test_exact_corners_give_the_exact_devices_and_poses(camera, projector, free):
    scene = make_scene(1, count=4, camera=camera, projector=projector)
    model = "OPENCV" if projector is None else projector.model
    found = solved(scene, free, model)
    for got, true in zip(found.rig.devices, scene.truth.devices, strict=True):
        assert (got.w, got.h, got.model) == (true.w, true.h, true.model)
        np.testing.assert_allclose(got.parameters, true.parameters, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(found.rig.T_camera_board, scene.truth.T_camera_board, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.rig.T_projector_camera, scene.truth.T_projector_camera, rtol=1e-6, atol=1e-6)


def test_the_unit_of_the_board_changes_lengths_alone():
    scene = make_scene(2, count=4, noise=0.1)
    mm, m = (solved(scene, (TERMS[1], TERMS[1]), points=POINTS * unit) for unit in (1.0, 1e-3))
    for one, other in zip(mm.rig.devices, m.rig.devices, strict=True):
        np.testing.assert_allclose(other.parameters, one.parameters, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(m.rig.T_camera_board[:, :3, 3] * 1e3, mm.rig.T_camera_board[:, :3, 3], rtol=1e-5)
    np.testing.assert_allclose(
        m.rig.T_projector_camera[:3, 3] * 1e3, mm.rig.T_projector_camera[:3, 3], rtol=1e-4, atol=0.01
    )


def test_corners_that_are_wrong_do_not_matter():
    scene, rng = make_scene(3, count=6, noise=0.1), np.random.default_rng(0)

    def damaged(corners):
        wrong = rng.random(len(corners.ids)) < 0.05
        away = rng.standard_normal(corners.uv.shape)
        away *= 20 / np.linalg.norm(away, axis=1, keepdims=True)
        return Corners(corners.ids, corners.uv + wrong[:, None] * away)

    views = [BoardView(view.name, damaged(view.camera), damaged(view.projector)) for view in scene.views]
    clean, other = solved(scene, (TERMS[1],) * 2), solved(replace(scene, views=views), (TERMS[1],) * 2)
    for one, k in ((clean, 0), (other, 0), (clean, 1), (other, 1)):
        got, true = one.rig.devices[k], scene.truth.devices[k]
        assert abs(got.fl_x / true.fl_x - 1) < 0.003 and abs(got.cy - true.cy) < 5
    np.testing.assert_allclose(other.sigma_px, clean.sigma_px, rtol=0.15)


@pytest.fixture(scope="module", params=["OPENCV", "DOE"])
def near(request):
    """A rig close to the truth, so that residuals are not zero, its corners, and all intrinsics to fit."""
    projector = replace(PROJECTOR if request.param == "OPENCV" else DOE, k2=0.02, p1=0.001, p2=-0.002)
    scene = make_scene(4, count=3, noise=0.5, camera=TANGENTIAL, projector=projector)
    return scene.truth, scene.seen, (ALL, ALL)


def moved(rig: BoardRig, free, x):
    """The rig after a step x: intrinsics of both devices, twist of the rig, twists of all boards."""
    devices, place = [], 0
    for device, one in zip(rig.devices, free, strict=True):
        columns = one.columns()
        devices.append(with_numbers(device, device.parameters + columns @ x[place : place + columns.shape[1]]))
        place += columns.shape[1]
    T = exp_se3(torch.from_numpy(x[place : place + 6])).numpy() @ rig.T_projector_camera
    boards = exp_se3(torch.from_numpy(x[place + 6 :].reshape(-1, 6))).numpy() @ rig.T_camera_board
    return BoardRig(*devices, boards, T)


def dense_jacobian(rig, free, seen, k):
    """Of the predictions of device k, by central differences; columns as in `moved`."""
    size = sum(one.columns().shape[1] for one in free) + 6 + 6 * len(rig.T_camera_board)
    step = np.full(size, 1e-6)
    columns = []
    for i in range(size):
        ahead, back = (residuals(moved(rig, free, s * step * np.eye(size)[i]), k, seen[k]) for s in (1, -1))
        columns.append(-(ahead - back) / 2e-6)
    return np.stack(columns, -1)


def test_derivatives_are_those_of_finite_differences(near):
    rig, seen, free = near
    for k in (0, 1):
        expected = dense_jacobian(rig, free, seen, k)
        one = linearised(rig, k, free[k], seen[k])
        np.testing.assert_array_equal(one.residual, residuals(rig, k, seen[k]))
        got = np.zeros_like(expected)
        got[..., 6 * 0 + 8 * k : 8 * k + 8] = one.by_intrinsics
        got[..., 16:22] = one.by_rig
        for b in range(len(rig.T_camera_board)):
            own = seen[k].view == b
            got[own, :, 22 + 6 * b : 28 + 6 * b] = one.by_board[own]
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=2e-4)


def test_equations_without_boards_are_the_dense_ones_with_boards_eliminated(near):
    rig, seen, free = near
    sigma = (0.5, 0.7)
    H, g, cost = 0.0, 0.0, 0.0
    for k in (0, 1):
        J = dense_jacobian(rig, free, seen, k)
        e = residuals(rig, k, seen[k]) / sigma[k]
        costs, weights = kernel(e)
        J = (J / sigma[k]).reshape(-1, J.shape[-1])
        w = np.repeat(weights, 2)
        H, g, cost = H + (J * w[:, None]).T @ J, g + (J * w[:, None]).T @ e.ravel(), cost + costs.sum()
    normal = normal_equations(rig, free, seen, sigma)
    reduced, right = normal.reduced(0.0)
    assert normal.cost == pytest.approx(cost)
    s = len(reduced)
    schur = H[:s, :s] - H[:s, s:] @ np.linalg.solve(H[s:, s:], H[s:, :s])
    scale = 1 / np.sqrt(np.diag(H[:s, :s]))
    np.testing.assert_allclose(reduced * scale[:, None] * scale, schur * scale[:, None] * scale, rtol=1e-4, atol=2e-5)
    expected = g[:s] - H[:s, s:] @ np.linalg.solve(H[s:, s:], g[s:])
    np.testing.assert_allclose(right * scale, expected * scale, atol=1e-4 * np.abs(g[:s] * scale).max())
    shared, boards = normal.step(0.0)
    whole = np.linalg.solve(H, g)
    predicted = 2 * g @ whole - whole @ H @ whole
    step = np.concatenate([shared, boards.ravel()])
    assert 2 * g @ step - step @ H @ step == pytest.approx(predicted, rel=1e-4)


def test_the_weights_are_the_derivative_of_the_cost():
    r = np.random.default_rng(0).normal(0, 4, (20, 2))
    costs, weights = kernel(r)
    slope = np.array([approx_fprime(one, lambda x: float(kernel(x[None])[0][0]), 1e-7) for one in r])
    np.testing.assert_allclose(slope, 2 * weights[:, None] * r, rtol=1e-4, atol=1e-5)
    assert (np.diff(kernel(np.c_[np.linspace(0, 50, 30), np.zeros(30)])[0]) > 0).all() and costs.max() < 16


def test_covariance_is_the_inverse_and_huge_where_nothing_is_known():
    A = np.random.default_rng(0).standard_normal((9, 4)) * (1, 1e3, 1e-3, 1)
    np.testing.assert_allclose(covariance(A.T @ A), np.linalg.inv(A.T @ A), rtol=1e-6)
    A[:, 3] = A[:, 0]
    found = covariance(A.T @ A)
    assert found[3, 3] > 1e10 and found[1, 1] < 1e-4
