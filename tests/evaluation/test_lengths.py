"""Distances between points: their errors against differences of triangulated points, and what is said of bad input."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import (
    PointPair,
    measure_lengths,
    parse_pair,
    read_pairs,
    typical_sigma,
)
from sl_nerfstudio.geometry.lie import exp_se3
from sl_nerfstudio.meshing.mesh import VertexQuality
from sl_nerfstudio.meshing.uncertainty import collect_views, point_changes
from sl_nerfstudio.scan import Scan, read_scan

from .faceted_scan import FacetedScan

FRAMES = 3


@pytest.fixture(scope="module")
def scan(clean_scan: Path) -> Scan:
    return read_scan(clean_scan)


@pytest.fixture(scope="module")
def rows(scan: Scan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices that frames confirm, the derivatives of those points, and the frames that confirm each."""
    mesh = FacetedScan().truth()
    every = collect_views(mesh, scan, scan.poses)
    chosen = np.unique(every.vertex)
    seen = np.zeros((len(chosen), FRAMES), dtype=bool)
    seen[np.searchsorted(chosen, every.vertex), every.frame] = True
    return chosen, point_changes(mesh, scan, scan.poses, every, chosen, np.eye(12 * FRAMES + 6)), seen


def quality() -> VertexQuality:
    count = len(FacetedScan().truth().vertices)
    views = np.full(count, 2)
    return VertexQuality(np.full(count, 0.05), np.full(count, 0.03), views, np.zeros(count), np.zeros(count))


def test_points_move_with_all_poses_and_lengths_grow_with_them(scan, rows):
    chosen, found, _ = rows
    p = FacetedScan().truth().vertices[chosen]
    v, w = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.2])
    motion = np.r_[np.tile(np.r_[v, w], FRAMES), np.zeros(6 * FRAMES + 6)]
    np.testing.assert_allclose(found @ motion, v + np.cross(w, p), rtol=1e-7, atol=1e-7)
    growth = np.zeros((2, FRAMES, 6))
    growth[0, :, :3] = scan.poses.T_world_camera[:, :3, 3]
    growth[1, :, :3] = scan.poses.T_camera_projector[:, :3, 3]
    np.testing.assert_allclose(found @ np.r_[growth.ravel(), np.zeros(6)], p, rtol=1e-6, atol=1e-6)


def test_a_point_is_where_the_rays_of_all_its_pixels_meet_best(scan, rows):
    """With disturbed poses, least squares on the plain pinhole formulas, from the pixels under the true ones."""
    from .faceted_scan import CAMERA, PROJECTOR, project_plainly

    chosen, found, seen = rows
    row = int(seen.sum(1).argmax())
    p, frames = FacetedScan().truth().vertices[chosen[row]], np.flatnonzero(seen[row])
    step = np.random.default_rng(0).normal(size=(2, FRAMES, 6)) * ([1e-3] * 3 + [1e-5] * 3)

    def pixels(at: np.ndarray, sign: float) -> np.ndarray:
        out = []
        delta, rho = (exp_se3(sign * torch.from_numpy(part)).numpy() for part in step)
        for k in frames:
            camera = delta[k] @ scan.poses.T_world_camera[k]
            light = camera @ rho[k] @ scan.poses.T_camera_projector[k]
            for device, T in ((CAMERA, camera), (PROJECTOR, light)):
                out.append(project_plainly(device, ((at - T[:3, 3]) @ T[:3, :3])[None])[0])
        return np.concatenate(out)

    decoded, ends = pixels(p, 0.0), []
    for sign in (1.0, -1.0):
        at = p.copy()
        for _ in range(4):
            J = np.stack([(pixels(at + h, sign) - pixels(at - h, sign)) / 2e-4 for h in 1e-4 * np.eye(3)], 1)
            at = at - np.linalg.lstsq(J, pixels(at, sign) - decoded, rcond=None)[0]
        ends.append(at)
    expected = (ends[0] - ends[1]) / 2
    np.testing.assert_allclose(found[row, :, : 12 * FRAMES] @ step.ravel(), expected, rtol=1e-3, atol=1e-6)


def test_a_length_has_the_uncertainty_of_its_ends(scan, rows):
    chosen, found, _ = rows
    mesh = FacetedScan().truth()
    a, b = int(chosen[0]), int(chosen[-1])
    pair = PointPair("edge", tuple(mesh.vertices[a].tolist()), tuple(mesh.vertices[b].tolist()))
    factor = np.random.default_rng(1).normal(size=(12 * FRAMES + 6,) * 2) * 1e-3
    joint = JointCovariance(factor)
    (length,) = measure_lengths([pair], mesh, quality(), scan, scan.poses, joint)
    u = mesh.vertices[b] - mesh.vertices[a]
    assert length.length == pytest.approx(np.linalg.norm(u), rel=1e-6)
    u = u / np.linalg.norm(u)
    row = u @ (found[-1] - found[0])
    assert length.sigma_shared == pytest.approx(np.sqrt(row @ joint.matrix @ row), rel=1e-9)
    independent = 0.03 * np.hypot(*(mesh.vertex_normals()[[a, b]] @ u))
    assert length.sigma_independent == pytest.approx(independent, rel=1e-9)
    assert length.sigma == pytest.approx(np.hypot(length.sigma_shared, independent)) and length.views == (2, 2)
    rigid = np.r_[np.tile([1.0, 2, 3, 0.1, 0.2, 0.3], FRAMES), np.zeros(6 * FRAMES + 6)]
    (still,) = measure_lengths([pair], mesh, quality(), scan, scan.poses, JointCovariance(rigid[:, None]))
    assert still.sigma_shared == pytest.approx(0, abs=1e-5)
    for known in ((None, joint), (quality(), None)):
        (unknown,) = measure_lengths([pair], mesh, known[0], scan, scan.poses, known[1])
        assert unknown.sigma is None and unknown.length == length.length


def test_what_is_typical_of_lengths_is_their_growth(scan):
    """If all poses grow by a common, unknown factor, every length is as uncertain as the factor."""
    mesh, known = FacetedScan().truth(), quality()
    growth = np.zeros((2, FRAMES, 6))
    growth[0, :, :3] = scan.poses.T_world_camera[:, :3, 3]
    growth[1, :, :3] = scan.poses.T_camera_projector[:, :3, 3]
    step = 0.01 * np.r_[growth.ravel(), np.zeros(6)]
    exact = replace(known, sigma_independent=np.zeros(len(mesh.vertices)))
    joint = JointCovariance(step[:, None])
    assert typical_sigma(mesh, exact, scan, scan.poses, joint) == pytest.approx(0.01, rel=1e-6)
    unseen = replace(known, views=np.zeros_like(known.views))
    for quality_, joint_ in ((None, joint), (known, None), (unseen, joint)):
        assert typical_sigma(mesh, quality_, scan, scan.poses, joint_) is None


def test_pairs_are_read_as_they_are_written(tmp_path):
    pair = parse_pair("1,2,3 -4,.5,6e1", "--distance")
    assert pair == PointPair("1,2,3 to -4,.5,6e1", (1.0, 2.0, 3.0), (-4.0, 0.5, 60.0))
    file = tmp_path / "features.txt"
    file.write_text("# what matters\n\nhandle: -1,0,0 1,0,0\n  a: b: 0,0,0  0,0,2.5 \n")
    assert [pair.name for pair in read_pairs(file)] == ["handle", "a: b"]
    for bad in ("1,2,3", "1,2,3 4,5", "1 2 3 4 5 6", ": 1,2,3 4,5,6", "1,2,3 4,5,nan"):
        with pytest.raises(UserError, match=r"is not two points\n    remedy: give x,y,z of both"):
            parse_pair(bad, "--distance")
    file.write_text("ok: 0,0,0 1,1,1\nbad: 0,0,0\n")
    with pytest.raises(UserError, match=r"features.txt, line 2: 'bad: 0,0,0' is not two points"):
        read_pairs(file)
    file.write_text("# nothing\n")
    with pytest.raises(UserError, match="holds no distances"):
        read_pairs(file)
    with pytest.raises(UserError, match="cannot be read"):
        read_pairs(tmp_path / "missing.txt")


def test_points_beside_the_mesh_are_refused(scan):
    mesh = FacetedScan().truth()
    a = tuple(mesh.vertices[0].tolist())
    with pytest.raises(UserError, match=r"500,0,0 is .* away from the surface \(unit: mm\)\n    cause:"):
        measure_lengths([PointPair("far", a, (500.0, 0.0, 0.0))], mesh, None, scan, scan.poses, None)
    with pytest.raises(UserError, match="both points are the same"):
        measure_lengths([PointPair("none", a, a)], mesh, None, scan, scan.poses, None)
