"""Rays, residuals, and the fit of the relative pose with its covariance."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.triangulation import epipolar_residual
from sl_nerfstudio.relative_pose.epipolar import (
    block_count,
    blocks_of,
    correspondences_of,
    covariance,
    direction_basis,
    directions,
    fit_epipolar,
    lattice_step,
    moved,
    ray_pairs,
    sampson,
    sampson_jacobian,
)
from tests.relative_pose.two_views import PROJECTORS, true_pose, view


def test_correspondences_are_the_decoded_pixels():
    coords = np.full((3, 4, 2), np.nan, dtype=np.float32)
    coords[1, 2] = 5.0, 7.0
    coords[2, 0, 0] = 1.0  # half a coordinate is none
    uv_camera, uv_projector = correspondences_of(coords)
    assert uv_camera.tolist() == [[2.5, 1.5]] and uv_projector.tolist() == [[5.0, 7.0]]
    assert [uv.shape for uv in correspondences_of(np.full((3, 4, 2), np.nan, dtype=np.float32))] == [(0, 2), (0, 2)]


@pytest.mark.parametrize(
    "size, step", [((600, 600), 1), ((640, 480), 1), ((1200, 1200), 2), ((3000, 4000), 5), ((4000, 6000), 7)]
)
def test_large_images_are_used_on_a_lattice_of_at_most_600000_pixels(size, step):
    h, w = size
    assert lattice_step(h, w) == step
    assert (h // step) * (w // step) <= 600_000


@pytest.mark.parametrize("projector", PROJECTORS)
def test_rays_are_unit_directions_to_the_points_with_derivatives_by_the_pixel(projector):
    frame = view(projector, count=200)
    rays, usable = ray_pairs(*frame.arguments)
    assert usable.tolist() == list(range(200))
    T = frame.T_camera_projector
    p_projector = (frame.p_camera - T[:3, 3]) @ T[:3, :3]
    for d, p in ((rays.d_camera, frame.p_camera), (rays.d_projector, p_projector)):
        np.testing.assert_allclose(d, p / np.linalg.norm(p, axis=1, keepdims=True), atol=1e-9)
    h = 1e-4
    for k, step in enumerate(h * np.eye(2)):
        ahead, behind = (directions(frame.projector, frame.uv_projector + s * step) for s in (1, -1))
        np.testing.assert_allclose(rays.d_projector_by_uv[:, :, k], (ahead - behind) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(np.einsum("ni,nik->nk", rays.d_projector, rays.d_projector_by_uv), 0, atol=1e-12)


def test_pairs_without_a_ray_are_left_out_and_the_others_keep_their_numbers():
    frame = view("DOE", count=30)
    uv_camera, uv = frame.uv_camera.copy(), frame.uv_projector.copy()
    uv[3] = 1e4  # beyond 90 degrees
    uv[7, 1] = np.nan
    uv_camera[11] = np.nan
    rays, usable = ray_pairs(uv_camera, uv, frame.camera, frame.projector)
    assert usable.tolist() == [k for k in range(30) if k not in (3, 7, 11)]
    whole, _ = ray_pairs(*frame.arguments)
    for some, index in ((rays, usable), (whole.chosen(np.arange(30) < 3), np.arange(3))):
        for key in ("d_camera", "d_projector", "d_projector_by_uv", "block"):
            np.testing.assert_array_equal(getattr(some, key), getattr(whole, key)[index])


@given(st.integers(0, 98), st.integers(0, 98), st.floats(0.001, 0.999), st.floats(0.001, 0.999))
def test_coordinates_are_in_the_same_square_of_32_pixels_if_both_are_in_whole_sides(x, y, dx, dy):
    uv = 32 * np.array([[x, y], [x + 1, y], [x, y + 1], [x, y]]) + 32 * np.array([dx, dy])
    uv[3] = 32 * np.array([x + 0.5, y + 0.5])
    here, right, below, same = blocks_of(uv, PROJECTORS["pinhole"])
    assert here == same and len({int(here), int(right), int(below)}) == 3


@pytest.mark.parametrize(
    ("w", "h", "count"), [(800, 800, 625), (1280, 720, 375), (1920, 1080, 375), (1080, 1920, 375), (1000, 400, 250)]
)
def test_squares_are_those_that_the_pattern_has(w, h, count):
    projector = Device(w, h, 1000.0, 1000.0, w / 2, h / 2)
    row, column = np.mgrid[0:h:2, 0:w:2]
    uv = np.stack([column, row], -1).reshape(-1, 2) + 0.5
    assert block_count(projector) == count == len(np.unique(blocks_of(uv, projector)))


@pytest.mark.parametrize("projector", PROJECTORS)
def test_the_residual_is_the_distance_from_the_epipolar_curve(projector):
    """Against the independent formula of geometry.triangulation, which projects the curve and measures in the image."""
    frame = view(projector, count=200).noisy(0.05, seed=2)
    ours = sampson(*true_pose(frame), ray_pairs(*frame.arguments)[0])
    theirs = epipolar_residual(
        Intrinsics.of(frame.camera, torch.float64),
        torch.eye(4, dtype=torch.float64),
        torch.from_numpy(frame.uv_camera),
        Intrinsics.of(frame.projector, torch.float64),
        torch.from_numpy(frame.T_camera_projector),
        torch.from_numpy(frame.uv_projector),
    ).numpy()
    np.testing.assert_allclose(np.abs(ours), np.abs(theirs), atol=2e-5)


@pytest.mark.parametrize("projector", PROJECTORS)
def test_derivatives_are_those_of_differences(projector):
    frame = view(projector, count=30).noisy(1.0, seed=4)
    rays, pose = ray_pairs(*frame.arguments)[0], true_pose(frame)
    r, J = sampson_jacobian(*pose, rays)
    np.testing.assert_allclose(r, sampson(*pose, rays), atol=1e-10)
    h = 1e-6
    for k, step in enumerate(h * np.eye(5)):
        difference = (sampson(*moved(*pose, step), rays) - sampson(*moved(*pose, -step), rays)) / (2 * h)
        np.testing.assert_allclose(J[:, k], difference, rtol=1e-6, atol=1e-4)


@given(st.integers(0, 10**6), st.floats(-14, 0.5))
def test_an_increment_rotates_the_projector_and_the_baseline(seed, exponent):
    rng = np.random.default_rng(seed)
    R, t, step = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3), rng.normal(size=5) * 10.0**exponent
    t = t / np.linalg.norm(t)
    B = direction_basis(t)
    np.testing.assert_allclose(np.c_[B, t].T @ np.c_[B, t], np.eye(3), atol=1e-12)
    R_moved, t_moved = moved(R, t, step)
    np.testing.assert_allclose(R_moved, Rotation.from_rotvec(step[:3]).as_matrix() @ R, atol=1e-14)
    np.testing.assert_allclose(t_moved, Rotation.from_rotvec(B @ step[3:]).apply(t), atol=1e-14)


@pytest.mark.parametrize("correlated", [False, True], ids=["independent errors", "errors shared by each cell"])
def test_the_stated_covariance_is_that_of_the_errors(correlated):
    """Fifty noisy copies of one frame: squared errors, in units of the covariance, average to 5."""
    clean = view(count=1500)
    R, t = true_pose(clean)
    distances, inside = [], []
    for k in range(50):
        frame = clean.noisy(0.25, seed=100 + k, wrong=0.02)
        if correlated:
            cell = np.floor(frame.uv_projector / 16).astype(int)
            shared = np.random.default_rng(k).standard_normal((80, 80, 2)) * 0.4
            frame = replace(frame, uv_projector=frame.uv_projector + shared[cell[:, 1] % 80, cell[:, 0] % 80])
        rays, _ = ray_pairs(*frame.arguments)
        found = fit_epipolar(R, t, rays)
        C = covariance(found, rays)
        w = Rotation.from_matrix(R @ found.R.T).as_rotvec()
        b = direction_basis(found.t).T @ np.cross(found.t, t)
        e = np.concatenate([w, b])
        distances.append(e @ np.linalg.solve(C, e))
        inside += [w @ w < np.trace(C[:3, :3]), b @ b < np.trace(C[3:, 3:])]
    assert 3.5 < np.mean(distances) < 7.0  # 5 +- 0.45 for errors that are exactly normal
    assert 0.55 < np.mean(inside) < 0.8
