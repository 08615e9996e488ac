"""A camera that no file describes: from EXIF, refined with all frames; flags and files that leave it unknown."""

import json
from dataclasses import replace

import pytest

from sl_nerfstudio.calibration.stated import CameraStart
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.frames import FrameWorker
from sl_nerfstudio.processing.inputs import read_cameras, refine_camera, require_intrinsics


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
    document = json.loads((ramp_scan.root / "intrinsics.json").read_text())
    path = tmp_path / "projector.json"
    path.write_text(json.dumps({"projector": document["projector"]}))
    captures = find_captures(ramp_scan.root / "images", True)
    config = ramp_scan.config(tmp_path / "s")
    assert read_cameras(config, captures).first == ramp_scan.camera and not read_cameras(config, captures).several
    with pytest.raises(UserError, match="does not say with which focal length it was taken, and no file gives"):
        read_cameras(replace(config, intrinsics=path), captures)
    with pytest.raises(UserError, match=r"--intrinsics: no file is given(.*\n)*.*sl-calibrate makes one"):
        require_intrinsics(replace(config, intrinsics=None), projector_needed=True)
    require_intrinsics(replace(config, intrinsics=None), projector_needed=False)
