"""The classical baselines must be fair ones."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.baselines.frame_to_model import fuse_frame_to_model
from benchmarks.baselines.poses import register
from benchmarks.baselines.tsdf import backprojected, fuse, triangulated_depth
from sl_nerfstudio.evaluation.evaluate import score_alignments
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import compare_poses, mesh_reference
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.scan import Scan, read_ground_truth, read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """Exact coordinates and exact relative poses; each frame as a whole is off by a degree and 3 mm."""
    root = tmp_path_factory.mktemp("tsdf") / "scan"
    config = SynthConfig(
        frames=6, resolution=120, supersampling=1, noise=0.0, missing=0.0, wrong=0.0,
        pose_error=(1.0, 3.0), autocalibration_error=(0.0, 0.0, 0.0),
    )  # fmt: skip
    synthesise(config, root)
    return read_scan(root)


def true_poses(scan: Scan) -> DevicePoses:
    poses = read_ground_truth(scan).poses
    assert poses is not None
    return poses


@pytest.mark.slow
def test_fusion_with_true_poses_is_as_good_as_its_voxels_and_registration_repairs_the_frames(disturbed: Scan) -> None:
    true, initial = true_poses(disturbed), disturbed.poses
    registered = register(disturbed, initial)
    mesh_path = read_ground_truth(disturbed).mesh_path
    assert mesh_path is not None
    reference = mesh_reference(read_mesh(mesh_path), disturbed, true, 20_000)
    rmse = {}
    for name, poses in (("initial", initial), ("registered", registered), ("true", true)):
        surface = IndexedMesh(fuse(disturbed, poses, 1 / 120))
        rmse[name] = score_alignments(surface, reference, poses, true, samples=20_000)["rigid"].accuracy.median
    assert rmse["true"] < 0.1
    assert rmse["registered"] < 3 * rmse["true"] < rmse["initial"]

    def errors(poses: DevicePoses) -> float:
        found = compare_poses(poses, true)
        assert found.relative.rotation_rmse_deg < 1e-5  # frames move as a whole
        return found.camera.rotation_rmse_deg

    assert errors(registered) < 0.3 * errors(initial)


@pytest.mark.slow
def test_frame_to_model_fusion_recovers_the_poses_of_frames_without_noise(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """A head without texture, frames 15 degrees apart that start a degree and 3 mm off; the first one is right."""
    root = tmp_path_factory.mktemp("tracked") / "scan"
    config = SynthConfig(
        scene="head", frames=24, resolution=160, supersampling=1, noise=0.0, missing=0.0, wrong=0.0,
        pose_error=(1.0, 3.0), autocalibration_error=(0.0, 0.0, 0.0),
    )  # fmt: skip
    synthesise(config, root)
    whole = read_scan(root)
    scan = replace(whole, frames=whole.frames[:4])
    true = DevicePoses(*(T[:4] for T in (true_poses(whole).T_world_camera, true_poses(whole).T_world_projector)))
    start = DevicePoses(
        np.concatenate([true.T_world_camera[:1], scan.poses.T_world_camera[1:]]),
        np.concatenate([true.T_world_projector[:1], scan.poses.T_world_projector[1:]]),
    )
    mesh, tracked = fuse_frame_to_model(scan, start, 1 / 160)
    np.testing.assert_array_equal(tracked.T_world_camera[0], true.T_world_camera[0])

    def errors(poses: DevicePoses) -> tuple[np.ndarray, np.ndarray]:
        """Degrees, and mm at the object, of every frame that was tracked."""
        motion = (poses.T_world_camera @ np.linalg.inv(true.T_world_camera))[1:]
        turned = np.degrees(np.arccos(np.clip((np.trace(motion[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
        return turned, np.linalg.norm(motion[:, :3, 3], axis=1)

    for least, most, before, after in zip((0.9, 2.5), (0.05, 0.06), errors(start), errors(tracked), strict=True):
        assert before.min() > least and after.max() < most
    surface = read_mesh(root / "ground_truth/mesh.ply")
    assert np.percentile(IndexedMesh(surface).distance(mesh.vertices), 95) < 1.0


# Depth maps.

LENS = (-0.12, 0.05, 1e-3, -2e-3)


@pytest.fixture(scope="module")
def distorted(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """Exact coordinates and poses, seen through a lens with distortion."""
    root = tmp_path_factory.mktemp("distorted") / "scan"
    synthesise(SynthConfig(frames=3, resolution=120, supersampling=1, clean=True, camera_distortion=LENS), root)
    return read_scan(root)


def test_depth_maps_are_those_of_an_ideal_pinhole(distorted: Scan) -> None:
    """Nearest pixels are taken, so points are off by up to half a pixel's footprint across, and far less in depth."""
    frame = distorted.frames[0]
    assert frame.camera.k1 == LENS[0]
    depth = triangulated_depth(frame, distorted, frame.T_world_camera, frame.T_world_projector)
    assert depth.camera == Device(120, 120, frame.camera.fl_x, frame.camera.fl_y, frame.camera.cx, frame.camera.cy)
    points = backprojected(depth)
    p_world = points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]
    surface = IndexedMesh(read_mesh(distorted.root / "ground_truth/mesh.ply"))
    footprint = np.median(-points[:, 2]) / frame.camera.fl_x
    assert np.percentile(surface.distance(p_world), 95) < footprint
    assert (depth.depth > 0).sum() == pytest.approx(frame.read_mask().sum(), rel=0.1)
