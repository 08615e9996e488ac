"""A turntable before a static background: what turns is registered, or the verdict says what the scan holds."""

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.evaluation.report.capture_reports import render_processing_report
from sl_nerfstudio.geometry.lie import angle_deg
from sl_nerfstudio.object_separation.separate import Part
from sl_nerfstudio.processing import process as processing
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.frames import FrameWorker, clouds_of
from sl_nerfstudio.processing.object_only import FrameShares, ObjectOnly
from sl_nerfstudio.processing.process import process
from sl_nerfstudio.processing.projector import contradiction_by_epipolar_geometry
from sl_nerfstudio.relative_pose.epipolar import correspondences_of
from sl_nerfstudio.relative_pose.intrinsics import check_intrinsics
from sl_nerfstudio.relative_pose.joint_fit import FrameMatches
from sl_nerfstudio.review.moving_part import moving_share
from sl_nerfstudio.scan import check_scan, read_scan
from tests.processing.conftest import register_ramps
from tests.processing.turntable import make_turntable_scan

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def turntable(tmp_path_factory):
    return make_turntable_scan(tmp_path_factory.mktemp("turntable"))


@pytest.fixture(scope="module")
def run(turntable, tmp_path_factory):
    root, log = tmp_path_factory.mktemp("run"), []
    with pytest.MonkeyPatch.context() as patch:
        register_ramps(patch)
        result = process(turntable.scan.config(root / "s"), render_processing_report, log.append)
    return result, read_scan(root / "s"), "\n".join(log)


def test_what_turns_is_registered_where_it_turned(turntable, run):
    result, scan, log = run
    assert result.registered == len(turntable.turns_deg) and check_scan(scan.root) == []
    T = scan.poses.T_world_camera
    for k, truth in enumerate(turntable.turns_deg):
        assert abs(angle_deg(T[0, :3, :3].T @ T[k, :3, :3]) - min(truth, 360 - truth)) < 1.0
    for frame, is_object in zip(scan.frames, turntable.is_object, strict=True):
        kept = np.isfinite(frame.read_coords()[..., 0])
        assert (kept & is_object).sum() > 0.9 * kept.sum() and (kept & is_object).sum() > 0.6 * is_object.sum()
        assert not (kept & ~frame.read_mask()).any()
    assert result.verdict.band == "acceptable" and "turntable with a static background" in result.verdict.reasons[0]
    assert "turntable with a static background" in log and "moving" in log


def test_what_cannot_be_registered_alone_is_never_good(turntable, tmp_path, ramps_registered, monkeypatch):
    monkeypatch.setattr(processing, "agrees_with_itself", lambda *_: False)
    result = process(turntable.scan.config(tmp_path / "s"), render_processing_report, lambda _: None)
    assert result.verdict.band == "poor"
    assert "turntable with a static background" in result.verdict.reasons[0]
    assert "sl-process --masks" in result.verdict.reasons[0]
    assert json.loads((tmp_path / "s" / "processing.json").read_text())["verdict"] == "poor"
    assert (moving_share(read_scan(tmp_path / "s")) or 0.0) > 0.02  # and so says sl-check


@pytest.mark.parametrize("moving_projector", [False, True])
def test_a_camera_that_stands_still_before_what_does_is_left_alone(tmp_path, ramps_registered, moving_projector):
    still = make_turntable_scan(tmp_path / "c", frames=4, step_deg=0.0, moving_projector=moving_projector).scan
    result = process(still.config(tmp_path / "s"), render_processing_report, lambda _: None)
    assert moving_share(read_scan(tmp_path / "s")) is None
    assert not any("turntable" in reason for reason in result.verdict.reasons)


def test_errors_that_repeat_in_every_frame_do_not_contradict_the_intrinsics(tmp_path, ramps_registered):
    """The same errors in ten frames of one place are those of one frame; the intrinsics are exact."""
    rng = np.random.default_rng(0)
    shared = 0.35 * np.stack([gaussian_filter(rng.normal(size=(240, 240)), 12) * 30 for _ in range(2)], -1)
    still = make_turntable_scan(tmp_path / "c", frames=8, step_deg=0.0, errors_px=shared).scan
    job = still.job(tmp_path / "work")
    results = [FrameWorker(job)(frame) for frame in find_captures(still.root / "images", True).frames]
    assert all(result.cloud is not None for result in results)
    assert contradiction_by_epipolar_geometry(job, results) == ""
    frames = [FrameMatches(c.name, *correspondences_of(c.coords), c.camera) for c in clouds_of(results)]
    poses = [(c.pose.T_camera_projector[:3, :3], c.pose.T_camera_projector[:3, 3]) for c in clouds_of(results)]
    assert check_intrinsics(frames, poses, job.projector).contradicts()  # where each frame counts by itself


def test_object_only_is_judged_by_what_it_keeps(turntable, tmp_path, ramps_registered, monkeypatch):
    """The wall agrees; the object, which turned before it, does not."""
    monkeypatch.setattr(processing, "moving_part", lambda *_: None)
    monkeypatch.setattr(processing, "find_object_only", lambda *_: objects(turntable))
    result = process(turntable.scan.config(tmp_path / "s", object_only=True), render_processing_report, lambda _: None)
    assert result.verdict.band == "poor"
    assert any("contradict" in reason or "agree" in reason for reason in result.verdict.reasons)
    assert result.cross_px[0] > 0.5


def objects(turntable):
    """Exactly the object, in every frame."""
    parts = {
        f"f{k}": np.where(is_object, Part.OBJECT, Part.PLANE).astype(np.uint8)
        for k, is_object in enumerate(turntable.is_object)
    }
    shares = tuple(FrameShares(name, 0.1, 0.9, 0.0) for name in parts)
    return ObjectOnly((), (), shares, parts)
