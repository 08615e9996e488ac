"""A projector whose focal length is wrong: it is found, and every frame starts again from all of its coordinates."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing import frame_worker
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.frame_worker import FrameWorker
from sl_nerfstudio.processing.process import process
from sl_nerfstudio.processing.refined_focal import refine_focal
from sl_nerfstudio.relative_pose.estimation import RelativePoseError
from sl_nerfstudio.scan import read_scan
from tests.processing.ramp_scan import NAMES


def _stage(scan, work, factor):
    """Frames calibrated with `factor` times the true focal length."""
    true = scan.projector
    job = replace(scan.job(work), projector=replace(true, fl_x=factor * true.fl_x, fl_y=factor * true.fl_y))
    return job, [FrameWorker(job)(frame) for frame in find_captures(scan.root / "images", True).frames]


def _counts(results):
    return [int(np.isfinite(r.cloud.coords).all(-1).sum()) for r in results]


def _fail_second_calibration(monkeypatch, names):
    """`estimate_relative_pose` fails for frames (by the number of their coordinates) from the fifth call on."""
    real, calls = frame_worker.estimate_relative_pose, []

    def estimate(uv_camera, *rest):
        calls.append(len(uv_camera))
        first = calls[: len(NAMES)]
        if len(calls) > len(NAMES) and NAMES[first.index(len(uv_camera))] in names:
            raise RelativePoseError("no pose\n    cause:  a test\n    remedy: none")
        return real(uv_camera, *rest)

    monkeypatch.setattr(frame_worker, "estimate_relative_pose", estimate)


def test_the_second_calibration_uses_coordinates_that_the_first_one_rejected(ramp_scan, tmp_path):
    job, results = _stage(ramp_scan, tmp_path, 1.04)
    decoded = [int(FrameWorker(job).load(r).decoded.sum()) for r in results]
    assert min(a / b for a, b in zip(_counts(results), decoded, strict=True)) < 0.95  # a wrong projector rejects some
    log = []
    refined, again = refine_focal(job, results, log.append)
    assert refined.projector.fl_x == pytest.approx(ramp_scan.projector.fl_x, rel=1e-4)
    assert refined.projector.fl_y == pytest.approx(ramp_scan.projector.fl_y, rel=1e-4)
    assert _counts(again) == decoded
    assert all(r.cloud.projector == refined.projector and r.cloud.pose.residual_px < 0.01 for r in again)
    assert log[0].startswith("projector's focal length: 0.961") and len(log) == 1


def test_a_right_focal_length_is_kept_and_nothing_is_calibrated_again(monkeypatch, ramp_scan, tmp_path):
    job, results = _stage(ramp_scan, tmp_path, 1.0)
    found = type("Found", (), {"factor": 1.0, "sigma": 0.01, "significant": False})()
    monkeypatch.setattr("sl_nerfstudio.processing.refined_focal.refine_projector_focal", lambda *_: found)
    log = []
    same, again = refine_focal(job, results, log.append)
    assert same is job and all(a is b for a, b in zip(again, results, strict=True))
    assert "the stated one is kept" in log[1]


def test_a_frame_that_fails_the_second_calibration_is_left_out_by_name(
    monkeypatch, ramps_registered, ramp_scan, tmp_path
):
    wrong = tmp_path / "wrong.json"
    _write_wrong_intrinsics(ramp_scan, wrong)
    _fail_second_calibration(monkeypatch, {NAMES[0]})
    config = replace(ramp_scan.config(tmp_path / "s"), intrinsics=wrong, refine_projector_focal=True)
    result = process(config, lambda *_: "report", lambda _: None)
    assert [f.name for f in result.frames if not f.in_scan] == [NAMES[0]]
    lost = result.frames[0]
    assert lost.stage == "calibrating" and lost.decode_rate == 1
    assert lost.reason.startswith(f"{ramp_scan.root / 'images' / NAMES[0]}: no pose\n    cause:  a test")
    scan = read_scan(tmp_path / "s")
    assert [frame.name for frame in scan.frames] == list(NAMES[1:])
    assert scan.projector.fl_x == pytest.approx(ramp_scan.projector.fl_x, rel=1e-4)


def test_too_few_frames_after_the_second_calibration_are_an_error(monkeypatch, ramps_registered, ramp_scan, tmp_path):
    wrong = tmp_path / "wrong.json"
    _write_wrong_intrinsics(ramp_scan, wrong)
    _fail_second_calibration(monkeypatch, set(NAMES[:3]))
    config = replace(ramp_scan.config(tmp_path / "s"), intrinsics=wrong, refine_projector_focal=True)
    with pytest.raises(UserError, match="1 of 4 frames can be used, a scan needs at least 2") as caught:
        process(config, lambda *_: "report", lambda _: None)
    assert all(f"{name}: {ramp_scan.root / 'images' / name}: no pose" in str(caught.value) for name in NAMES[:3])
    assert not config.output.exists() and (config.work_folder / "processing.html").read_text() == "report"


def _write_wrong_intrinsics(scan, path):
    document = json.loads((scan.root / "intrinsics.json").read_text())
    for key in ("fl_x", "fl_y"):
        document["projector"][key] *= 1.04
    path.write_text(json.dumps(document))
