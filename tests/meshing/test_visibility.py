"""Which frames see a vertex, and whether they confirm it: a plane by formula, and cases at the border of the mask."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.visibility import (
    ENOUGH,
    LEAST_PX,
    OFF_MASK_PX,
    FrameCounts,
    Occluder,
    count_frames,
    visible_vertices,
)
from sl_nerfstudio.scan import Scan

from .ray_cast_scan import CAMERA, PROJECTOR, look_at, scan_of

POSES = (look_at((60.0, 0.0, 290.0)), look_at((-40.0, 30.0, 290.0)))


def plate(half: float, cell: float, z: float = 0.0) -> Mesh:
    """A square at a height z, seen from above."""
    n = int(2 * half / cell) + 1
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n))
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1, 1)
    faces = np.concatenate([i + np.array([0, 1, n]), i + np.array([1, n + 1, n])])
    return Mesh(np.stack([x.ravel(), y.ravel(), np.full(n * n, z)], 1), faces)


def pixels(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    p = (points - T[:3, 3]) @ T[:3, :3]
    return np.stack([CAMERA.cx - CAMERA.fl_x * p[:, 0] / p[:, 2], CAMERA.cy + CAMERA.fl_y * p[:, 1] / p[:, 2]], 1)


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Scan:
    """One frame of a plate of 60 mm."""
    return scan_of(plate(30.0, 1.0), [POSES], tmp_path_factory.mktemp("plate") / "scan")


def seen(mesh: Mesh, scan: Scan):
    everything = np.arange(len(mesh.vertices))
    occluder, frame = Occluder(mesh), scan.frames[0]
    return visible_vertices(mesh.vertices, mesh.vertex_normals(), everything, occluder, frame, PROJECTOR, *POSES)


def test_every_vertex_of_the_true_plate_is_seen_and_predicted_exactly(scan):
    mesh = plate(27.0, 1.5)  # ends 3 mm, about 1.5 camera pixels, inside the border
    view = seen(mesh, scan)
    assert np.array_equal(view.vertex, np.arange(len(mesh.vertices)))
    assert not view.off_mask.any() and not view.near_mask.any()
    inner = np.abs(mesh.vertices).max(1) < 25
    assert np.nanmax(view.most[inner]) < 0.05  # between pixels, bilinear interpolation is not a homography


def test_a_surface_at_another_height_is_predicted_wrong_by_the_parallax(scan):
    lifted = plate(20.0, 2.0, z=6.0)
    view = seen(lifted, scan)
    u, _ = pixels(lifted.vertices, POSES[0]), None
    assert len(u) == len(view.vertex)
    # what is decoded there lies on z = 0, behind the vertex on its camera ray
    eye = POSES[0][:3, 3]
    behind = eye + (lifted.vertices - eye) * (eye[2] / (eye[2] - 6.0))
    both = []
    for points in (lifted.vertices, behind):
        p = (points - POSES[1][:3, 3]) @ POSES[1][:3, :3]
        both.append(PROJECTOR.fl_x * np.stack([-p[:, 0], p[:, 1]], 1) / p[:, 2:])
    expected = np.linalg.norm(both[0] - both[1], axis=1)
    np.testing.assert_allclose(view.most, expected, rtol=0.02)
    assert expected.min() > LEAST_PX and (view.least > LEAST_PX).all()


def test_vertices_that_face_away_or_are_hidden_are_not_seen(scan):
    flipped = plate(20.0, 2.0)
    flipped = Mesh(flipped.vertices, flipped.faces[:, ::-1].copy())
    assert len(seen(flipped, scan).vertex) == 0
    floor, roof = plate(20.0, 2.0), plate(25.0, 2.0, z=20.0)
    both = Mesh(
        np.concatenate([floor.vertices, roof.vertices]), np.concatenate([floor.faces, roof.faces + len(floor.vertices)])
    )
    below = np.abs(floor.vertices).max(1) < 10
    assert not np.isin(np.flatnonzero(below), seen(both, scan).vertex).any()


def test_outside_the_mask_the_distance_in_pixels_decides(scan):
    """The mesh goes on beyond the true plate."""
    mesh = plate(45.0, 1.0)
    view = seen(mesh, scan)
    corners = pixels(plate(30.0, 60.0).vertices, POSES[0])
    points = pixels(mesh.vertices[view.vertex], POSES[0])
    outside = distance_from_quadrilateral(points, corners[[0, 1, 3, 2]])
    assert view.off_mask[outside > 1.5 * OFF_MASK_PX + 1.5].all()  # a square of pixels grows to its corners
    assert not view.off_mask[outside < OFF_MASK_PX - 1.5].any()
    assert view.near_mask[(outside > 1.5) & (outside < OFF_MASK_PX - 1.5)].all()
    assert not view.near_mask[outside < -1.5].any()
    assert (np.isnan(view.least) | ~view.off_mask).all()


def distance_from_quadrilateral(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Signed distance (negative inside) from a convex polygon; exact near its edges."""
    centre = corners.mean(0)
    out = np.full(len(points), -np.inf)
    for a, b in zip(corners, np.roll(corners, -1, 0), strict=True):
        normal = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
        normal *= -np.sign((centre - a) @ normal)
        out = np.maximum(out, (points - a) @ normal)
    return out


def test_counts_add_up_over_the_frames_and_stop_once_decided(tmp_path):
    mesh, frames = plate(20.0, 2.0), 6
    scan = scan_of(plate(30.0, 1.0), [POSES] * frames, tmp_path / "scan")
    counts = count_frames(mesh, Occluder(mesh), scan, scan.poses)
    checked_in_all = np.arange(len(mesh.vertices)) % 8 == 0
    assert (counts.confirmed == np.where(checked_in_all, frames, ENOUGH)).all()
    assert counts.decided.all()
    assert not (counts.contradicted.any() or counts.near_mask.any() or counts.inconclusive.any())
    assert counts.residual_px.shape == (frames,) and (counts.residual_px < 0.05).all()


def test_undecoded_frames_are_inconclusive_and_wrong_ones_contradict(tmp_path):
    def change(number: int, coords: np.ndarray) -> np.ndarray:
        return coords * np.float32(np.nan) if number == 0 else coords + np.float32(40) * (number == 1)

    mesh = plate(20.0, 2.0)
    scan = scan_of(plate(30.0, 1.0), [POSES] * 3, tmp_path / "scan", change)
    counts = count_frames(mesh, Occluder(mesh), scan, scan.poses)
    assert (counts.inconclusive == 1).all() and (counts.contradicted == 1).all() and (counts.confirmed == 1).all()
    assert (counts.against == 1).all() and not counts.decided.any()
    assert np.isnan(counts.residual_px[0]) and counts.residual_px[1] == pytest.approx(40 * 2**0.5, rel=1e-3)


def test_decided_vertices_keep_their_counts_in_a_second_pass(scan):
    mesh = plate(20.0, 2.0)
    n = len(mesh.vertices)
    decided = np.arange(n) % 2 == 0
    before = FrameCounts(
        np.where(decided, 7, 1), np.full(n, 2), np.zeros(n, dtype=int), np.full(n, 2), residual_px=np.ones(1)
    )
    assert np.array_equal(before.decided, decided)  # 7 - 1 against, 1 - 1 against
    poses = DevicePoses(POSES[0][None], POSES[1][None])
    after = count_frames(mesh, Occluder(mesh), replace(scan, frames=scan.frames[:1]), poses, before)
    assert (after.confirmed == np.where(decided, 7, 1)).all()
    assert (after.inconclusive == np.where(decided, 2, 0)).all() and (after.near_mask == after.inconclusive).all()
