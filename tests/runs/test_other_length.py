"""A scan that gets a length, or pictures, after its training: the run follows as if it had been trained with them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sl_nerfstudio.geometry.lie import exp_se3, inverse
from sl_nerfstudio.model.pose_refinement import PriorConfig, known_length, pose_prior, scene_rig
from sl_nerfstudio.runs.other_length import follow_scan, training_key
from sl_nerfstudio.runs.run import check_run, load_run
from sl_nerfstudio.scan import measured_length, read_scan
from tests.dataparser.tiny_scan import TinyScan
from tests.test_ns_commands import train

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # nerfstudio warns freely

BASELINE, PICKED = {"baseline_of": "frame_00001"}, ((24.5, 20.5), (30.5, 16.5))
BAR = {"distance_between": [{"frame": f"frame_0000{k}", "pixel": uv} for k, uv in enumerate(PICKED)], "length": 50.0}


def rough(root: Path) -> Path:
    """A tiny scan whose starting poses are off, and whose unit is not known."""
    document = json.loads((TinyScan(undecoded=0.02).write(root) / "transforms.json").read_text())
    random = np.random.default_rng(5)
    for frame in document["frames"]:
        for key in ("transform_matrix", "projector_transform_matrix"):
            moved = exp_se3(torch.from_numpy(random.normal(0, [1, 1, 1, 0.01, 0.01, 0.01]))).numpy()
            frame[key] = (moved @ np.array(frame[key])).tolist()
    document |= {"units": "arbitrary", "scale": {"known": False}}
    (root / "transforms.json").write_text(json.dumps(document))
    return root


def with_length(root: Path, factor: float, scale: dict) -> None:
    """State a length, as sl-process does: poses and their uncertainty in another unit."""
    path = root / "transforms.json"
    document = json.loads(path.read_text())
    for frame in document["frames"]:
        for key in ("transform_matrix", "projector_transform_matrix"):
            T = np.array(frame[key])
            T[:3, 3] *= factor
            frame[key] = T.tolist()
    document |= {"units": "cm", "scale": {"known": True, "source": "measured", **scale}}
    path.write_text(json.dumps(document))
    scan = read_scan(root)
    if scan.scale.bar is not None:  # the poses obey it as they do after sl-process
        document["scale"]["length"] = 1.01 * measured_length(scan, scan.scale.bar, scan.poses)
        path.write_text(json.dumps(document))


def doubt_of_length(model, known) -> float:
    """How uncertain a run finds the logarithm of the length that the scan of another one states."""
    camera, projector = model.poses_scene()
    scan, S = known.scan, known.S_scene_world
    rig = replace(scene_rig(scan, S), T_world_camera=camera, T_camera_projector=inverse(camera) @ projector)
    derivative = known_length(scan, S, "free", rig, pose_prior(scan, S, PriorConfig()))
    return float((derivative @ model.device_poses.joint_factor[: len(derivative)]).norm())


@pytest.mark.parametrize("scale", [BASELINE, BAR], ids=["baseline", "bar"])
def test_a_run_that_follows_its_scan_equals_one_that_was_trained_with_the_length(scale, tmp_path, monkeypatch):
    root = rough(tmp_path / "scan")
    key = training_key(read_scan(root))
    config = train(monkeypatch, root, tmp_path / "first", 2)
    before = load_run(config).model
    camera = before.device_poses
    assert not torch.equal(camera.base_camera, camera.start_camera)  # the training had adjusted the poses
    with_length(root, 0.137, scale)
    assert training_key(read_scan(root)) == key
    follow_scan(config, root, tmp_path / "first")
    check_run(config)
    found, wanted = load_run(config).model, load_run(train(monkeypatch, root, tmp_path / "second", 2)).model
    assert found.scan.units == "cm"
    a, b = found.poses(), wanted.poses()
    np.testing.assert_allclose(a.baseline, b.baseline, rtol=1e-6)
    relative = [
        T.T_world_camera[0, :3, :3].T @ (T.T_world_camera[:, :3, 3] - T.T_world_camera[0, :3, 3]).T for T in (a, b)
    ]
    np.testing.assert_allclose(relative[0], relative[1], rtol=1e-5, atol=1e-5 * a.baseline[0])
    assert max(doubt_of_length(found, found), doubt_of_length(wanted, wanted)) < 1e-8
    assert doubt_of_length(before, found) > 1e-5
    if scale is BASELINE:
        assert a.baseline[1] == pytest.approx(read_scan(root).poses.baseline[1], rel=1e-9)
        first, second = (factor @ factor.T for factor in (m.joint_covariance().factor for m in (found, wanted)))
        np.testing.assert_allclose(first, second, rtol=0, atol=2e-2 * np.abs(second).max())
    follow_scan(config, root, tmp_path / "first")  # nothing to do
    with_length(root, 1 / 0.137, BASELINE)
    follow_scan(config, root, tmp_path / "first")
    assert load_run(config).model.poses().baseline[1] == pytest.approx(read_scan(root).poses.baseline[1], rel=1e-9)


def test_what_a_training_depends_on_changes_its_key(tmp_path):
    root = rough(tmp_path / "scan")
    key = training_key(read_scan(root))
    path = root / "transforms.json"
    document = json.loads(path.read_text())
    document["frames"][0]["sl_color_path"] = document["frames"][0]["file_path"]
    path.write_text(json.dumps(document))
    assert training_key(read_scan(root)) == key
    document["frames"][1]["transform_matrix"][0][3] += 1e-4
    path.write_text(json.dumps(document))
    moved = training_key(read_scan(root))
    mask = root / "masks/frame_00000.png"
    mask.write_bytes((root / "masks/frame_00001.png").read_bytes())
    assert len({key, moved, training_key(read_scan(root))}) == 3
