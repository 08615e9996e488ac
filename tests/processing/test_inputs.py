"""Rough poses and cameras: read, refined and checked before the long work."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.api import write_devices
from sl_nerfstudio.calibration.stated import CameraStart
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.frames import FrameWorker
from sl_nerfstudio.processing.inputs import (
    GivenPoses,
    align_to,
    read_cameras,
    read_given_poses,
    read_inputs,
    refine_camera,
    require_intrinsics,
)
from tests.processing.ramp_scan import NAMES, write_poses

HERE, TURNED = np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])


def _poses(n=3, seed=0):
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (n, 1, 1))
    for k in range(n):
        Q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        T[k, :3, :3] = Q * np.sign(np.linalg.det(Q))
        T[k, :3, 3] = rng.uniform(-100, 100, 3)
    return T


def test_frames_are_matched_by_name(tmp_path):
    T = _poses()
    path = write_poses(tmp_path / "t.json", {"c": T[2], "a": T[0], "x": "not read"}, units="mm")
    given = read_given_poses(path, ["a", "b", "c"])
    np.testing.assert_array_equal(given.T_world_camera[[0, 2]], T[[0, 2]])
    assert np.isnan(given.T_world_camera[1]).all() and given.units == "mm"
    assert given.chosen([True, False, True]).T_world_camera.shape == (2, 4, 4)


@pytest.mark.parametrize("count", [2, 5])
def test_alignment_recovers_axes_and_scale(count):
    T = _poses(count)
    registered = np.ones(count, dtype=bool)
    given = GivenPoses(T.copy(), "mm")
    if count > 2:
        given.T_world_camera[1] = np.nan
        registered[2] = False
    turned = np.linalg.inv(T[0]) @ T
    turned[:, :3, 3] *= 0.01
    turned[~registered] = np.nan
    S = align_to(given, turned, registered)
    both = registered & np.isfinite(given.T_world_camera).all((1, 2))
    np.testing.assert_allclose(S.poses(turned[both]), T[both], atol=1e-8)
    assert S.scale == pytest.approx(100)


@pytest.mark.parametrize(
    ("frames", "extra", "message"),
    [
        ({"a": HERE}, {}, "has poses for fewer than two of the captures"),
        ({"a": 2 * HERE, "b": HERE}, {}, "a: transform_matrix"),
        ({"a": HERE, "b": TURNED}, {}, "has all captures at the same place\n.*cause:  the file holds rotations only"),
        *(({"a": HERE, "b": HERE}, {"units": u}, "units is") for u in ("furlong", ["mm"], {}, 1, True)),
    ],
)
def test_faulty_poses(tmp_path, frames, extra, message):
    path = write_poses(tmp_path / "t.json", frames, **extra)
    with pytest.raises(UserError, match=message) as caught:
        read_given_poses(path, ["a", "b", "c"])
    assert "cause:" in str(caught.value) and "remedy:" in str(caught.value)


@pytest.mark.slow
def test_the_camera_is_refined_and_its_uncertainty_stated(ramp_scan, tmp_path):
    true = ramp_scan.camera
    rough = replace(true, fl_x=1.04 * true.fl_x, fl_y=1.04 * true.fl_y, cx=true.w / 2, cy=true.h / 2)
    job = replace(ramp_scan.job(tmp_path / "w"), camera=rough)
    captures = find_captures(ramp_scan.root / "images", True)
    results = [FrameWorker(job)(frame) for frame in captures.frames[:2]]
    log = []
    refined, again, notes = refine_camera(job, results, CameraStart(rough, 0.04, "26 mm"), log.append)
    assert refined.camera.fl_x == pytest.approx(true.fl_x, rel=2e-3)
    assert all(result.cloud.camera == refined.camera for result in again)
    figures = notes.document()
    assert figures["px"] == refined.camera.fl_x and 0 < figures["sigma_px"] < 0.01 * true.fl_x
    assert figures["start_sigma_px"] == pytest.approx(0.04 * rough.fl_x) and json.dumps(figures)
    assert log == [notes.sentence()] and "± 4 % from EXIF (26 mm); with all frames" in log[0]


def test_a_file_with_the_projector_alone_needs_photographs_that_state_the_focal_length(ramp_scan, tmp_path):
    path = tmp_path / "projector.json"
    write_devices(path, None, ramp_scan.projector)
    captures = find_captures(ramp_scan.root / "images", True)
    config = ramp_scan.config(tmp_path / "s")
    assert read_cameras(config, captures).first == ramp_scan.camera and not read_cameras(config, captures).several
    with pytest.raises(UserError, match="does not say with which focal length it was taken, and no file gives"):
        read_cameras(replace(config, intrinsics=path), captures)
    with pytest.raises(UserError, match=r"--intrinsics: no file is given(.*\n)*.*sl-calibrate.*--estimate-projector"):
        require_intrinsics(replace(config, intrinsics=None), projector_needed=True)
    require_intrinsics(replace(config, intrinsics=None), projector_needed=False)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"no_adjust": True, "rig": "rigid"}, "--no-adjust and --rig rigid"),
        ({"no_adjust": True, "rig": "static-projector"}, "--no-adjust and --rig static-projector"),
        ({"no_adjust": True, "estimate_projector": True}, "--no-adjust and --estimate-projector"),
        ({"jobs": 0}, "--jobs 0: give at least 1"),
        ({"seed": -1}, "--seed -1"),
        ({"work": "s"}, r"--work .*: is in the output(.|\n)*such as .*scan.work"),
        ({"work": "s/inside"}, "--work .*: is in the output"),
        ({"work": "s/../s"}, "--work .*: is in the output"),
        ({"output": "captures"}, r"--output .*: is in the captures(.|\n)*such as .*/scan$"),
        ({"output": "captures/scan"}, "--output .*: is in the captures"),
        ({"work": "captures/work"}, "--work .*: is in the captures"),
    ],
)
def test_flags_that_cannot_be_meant_together(ramp_scan, tmp_path, changes, words):
    paths = {key: tmp_path / changes[key] for key in ("work", "output") if key in changes}
    config = replace(ramp_scan.config(tmp_path / "s"), images=tmp_path / "captures", **(changes | paths))
    with pytest.raises(UserError, match=words):
        config.check()


def test_inputs_are_read_before_anything_is_written(ramps_registered, ramp_scan, tmp_path):
    inputs = read_inputs(ramp_scan.config(tmp_path / "s", known_length="baseline of frame 3 = 1 m"))
    assert [frame.name for frame in inputs.captures.frames] == list(NAMES)
    assert inputs.known.frames == (NAMES[3],) and inputs.given is None
    assert inputs.job.decoder.name == "ramps" and inputs.job.work == tmp_path / "s.work"
    assert (inputs.job.camera, inputs.job.projector) == (ramp_scan.camera, ramp_scan.projector)
    assert list(tmp_path.iterdir()) == []
