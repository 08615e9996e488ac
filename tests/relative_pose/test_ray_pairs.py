"""Correspondences as pairs of rays."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.geometry.devices import Intrinsics, project
from sl_nerfstudio.relative_pose.epipolar import (
    PatternBlocks,
    blocks_of,
    correspondences_of,
    directions,
    lattice_step,
    ray_pairs,
    subsample,
)
from tests.relative_pose.two_views import CAMERA, PROJECTORS, view


def test_correspondences_are_the_decoded_pixels():
    coords = np.full((3, 4, 2), np.nan, dtype=np.float32)
    coords[1, 2] = 5.0, 7.0
    coords[2, 0, 0] = 1.0  # half a coordinate is none
    uv_camera, uv_projector = correspondences_of(coords)
    assert uv_camera.tolist() == [[2.5, 1.5]]
    assert uv_projector.tolist() == [[5.0, 7.0]]
    nothing = correspondences_of(np.full((3, 4, 2), np.nan, dtype=np.float32))
    assert [uv.shape for uv in nothing] == [(0, 2), (0, 2)]


@pytest.mark.parametrize(
    "size, step", [((600, 600), 1), ((640, 480), 1), ((1200, 1200), 2), ((3000, 4000), 5), ((4000, 6000), 7)]
)
def test_large_images_are_used_on_a_lattice_of_at_most_600000_pixels(size, step):
    h, w = size
    assert lattice_step(h, w) == step
    assert (h // step) * (w // step) <= 600_000 < (h / step) * (w / step) * 4


@pytest.mark.parametrize("projector", PROJECTORS)
def test_rays_are_unit_directions_to_the_points(projector):
    frame = view(projector, count=200)
    rays, usable = ray_pairs(*frame.arguments)
    assert usable.tolist() == list(range(200))
    assert len(rays) == 200
    T = frame.T_camera_projector
    p_projector = (frame.p_camera - T[:3, 3]) @ T[:3, :3]
    for d, p in ((rays.d_camera, frame.p_camera), (rays.d_projector, p_projector)):
        np.testing.assert_allclose(d, p / np.linalg.norm(p, axis=1, keepdims=True), atol=1e-9)


@pytest.mark.parametrize("projector", PROJECTORS)
def test_the_derivative_by_the_pixel_is_that_of_differences(projector):
    frame = view(projector, count=50)
    rays, _ = ray_pairs(*frame.arguments)
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
    np.testing.assert_array_equal(rays.d_camera, whole.d_camera[usable])
    np.testing.assert_array_equal(rays.block, whole.block[usable])


def test_a_choice_of_pairs_keeps_all_their_parts():
    rays, _ = ray_pairs(*view(count=30).arguments)
    index = np.array([4, 2, 2])
    for some, expected in ((rays.chosen(index), index), (rays.chosen(np.arange(30) < 3), np.arange(3))):
        for key in ("d_camera", "d_projector", "d_projector_by_uv", "block"):
            np.testing.assert_array_equal(getattr(some, key), getattr(rays, key)[expected])


def test_rays_of_no_pixels_are_none():
    assert directions(CAMERA, np.zeros((0, 2))).shape == (0, 3)


@given(st.integers(0, 10**6), st.integers(1, 60))
def test_sums_over_squares_keep_the_total(seed, along):
    rng = np.random.default_rng(seed)
    frame = view(count=40, seed=seed)
    rays, _ = ray_pairs(*frame.arguments, PatternBlocks(along_longer_side=along))
    values = rng.standard_normal((40, 3))
    sums = rays.block_sums(values)
    assert len(sums) == len(np.unique(rays.block))
    np.testing.assert_allclose(sums.sum(0), values.sum(0), atol=1e-12)
    np.testing.assert_allclose(rays.block_sums(values[:, 0]), sums[:, 0])
    each = replace(rays, block=np.arange(40))
    np.testing.assert_array_equal(each.block_sums(values), values)


@given(st.integers(1, 50), st.floats(-300, 1100), st.floats(-300, 1100))
def test_the_square_of_a_coordinate(along, x, y):
    """Points are in the same square if and only if both coordinates are, in whole sides."""
    projector = PROJECTORS["pinhole"]
    side = 800 / along
    uv = np.array([[x, y], [x + side, y], [x, y + side]])
    inside = ((uv > -side) & (uv < 4 * 800)).all()
    a, right, below = blocks_of(uv, projector, PatternBlocks(along_longer_side=along))
    if inside and min(x % side, y % side, -x % side, -y % side) > 1e-6:
        assert len({int(a), int(right), int(below)}) == 3
        corner = np.floor(uv[:1] / side) * side
        near = corner + side * np.array([[1e-3, 1e-3], [0.999, 0.999]])
        assert (blocks_of(near, projector, PatternBlocks(along_longer_side=along)) == a).all()


@given(st.integers(0, 100), st.integers(1, 100), st.integers(0, 10**6))
def test_a_subsample_has_no_index_twice(count, most, seed):
    index = 3 * np.arange(count)
    found = subsample(index, most, np.random.default_rng(seed))
    assert len(found) == min(count, most)
    assert len(set(found.tolist())) == len(found)
    assert set(found.tolist()) <= set(index.tolist())
    np.testing.assert_array_equal(found, subsample(index, most, np.random.default_rng(seed)))


def test_projection_of_rays_gives_the_pixels():
    for device in PROJECTORS.values():
        uv = np.random.default_rng(0).uniform(100, 700, (50, 2))
        again, front = project(Intrinsics.of(device, torch.float64), torch.from_numpy(directions(device, uv)))
        assert front.all()
        np.testing.assert_allclose(again.numpy(), uv, atol=1e-8)
