"""The scan folder: the frames of the result, nothing else, and complete or not at all."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.bundle_adjustment.registered_frames import adjust_registered
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.frames import FrameWorker, clouds_of
from sl_nerfstudio.processing.process import write_scan
from sl_nerfstudio.processing.result import summarise
from sl_nerfstudio.processing.scan_poses import find_scan_poses
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.scan import check_scan, read_scan
from sl_nerfstudio.scan.images import read_image
from sl_nerfstudio.storage import NewFolder
from tests.processing.conftest import SHORT
from tests.processing.ramp_scan import LAYOUT, NAMES


@pytest.fixture(scope="module")
def made(ramp_scan, tmp_path_factory):
    """Job, results, poses and the result of a run that has not been written."""
    job = ramp_scan.job(tmp_path_factory.mktemp("w"))
    worker = FrameWorker(job)
    results = [worker(frame) for frame in find_captures(ramp_scan.root / "images", True).frames]
    clouds = clouds_of(results)
    registration = register(clouds)
    poses = find_scan_poses(clouds, registration, adjust_registered(clouds, registration, SHORT), None, None)
    config = ramp_scan.config(tmp_path_factory.mktemp("s"))
    return job, results, poses, summarise(config, "ramps", results, registration, poses)


def test_what_is_written_is_what_was_found(made, tmp_path):
    job, results, poses, _ = made
    previews = []
    with NewFolder(tmp_path / "s") as folder:
        write_scan(folder, *made, lambda _, shown: previews.extend(shown) or "page")
    assert check_scan(tmp_path / "s") == []
    scan = read_scan(tmp_path / "s")
    assert (scan.projector, scan.units, scan.scale) == (job.projector, "arbitrary", poses.scale)
    np.testing.assert_allclose(scan.poses.T_world_camera, poses.adjusted.poses.T_world_camera, atol=1e-12)
    np.testing.assert_allclose(scan.poses.T_world_projector, poses.adjusted.poses.T_world_projector, atol=1e-12)
    worker = FrameWorker(job)
    for frame, stage, sigma in zip(scan.frames, results, poses.adjusted.sigma, strict=True):
        decoded = worker.load(stage)
        assert frame.name == stage.name and frame.camera == job.camera and frame.pose_sigma == sigma
        np.testing.assert_array_equal(frame.read_image(), read_image(stage.frame.images[0]))
        np.testing.assert_array_equal(frame.read_coords(), stage.cloud.coords)
        np.testing.assert_array_equal(frame.read_mask(), decoded.mask)
        np.testing.assert_allclose(frame.read_pattern(), decoded.pattern, atol=0.51 / 255)
    assert (tmp_path / "s" / "pattern.json").read_bytes() == LAYOUT.encode()
    assert (tmp_path / "s" / "processing.html").read_text() == "page"
    assert len(previews) == 4 and all(p.image is not None and p.coords is not None for p in previews)


def test_frames_that_are_not_in_the_scan_are_only_shown(made, tmp_path):
    job, results, poses, result = made
    lost = replace(result.frames[1], in_scan=False, stage="registering", reason="alone")
    failed = replace(results[3], cloud=None, stage="calibrating", reason="flat")
    some = replace(result, frames=(result.frames[0], lost, result.frames[2], replace(lost, name=NAMES[3])))
    previews = []
    with NewFolder(tmp_path / "s") as folder:
        write_scan(folder, job, [*results[:3], failed], poses, some, lambda _, p: previews.extend(p) or "")
    scan = read_scan(tmp_path / "s")
    assert [frame.name for frame in scan.frames] == [NAMES[0], NAMES[2]]
    np.testing.assert_allclose(scan.poses.T_world_camera, poses.adjusted.poses.T_world_camera[[0, 2]], atol=1e-12)
    assert [preview.coords is None for preview in previews] == [False, False, False, True]
    assert all(preview.image is not None for preview in previews)


def test_nothing_is_left_if_writing_fails(made, tmp_path):
    job, results, poses, result = made
    away = replace(job, work=tmp_path / "other")
    with (
        pytest.raises(UserError, match=f"the decoded frame {NAMES[0]} is missing"),
        NewFolder(tmp_path / "s") as folder,
    ):
        write_scan(folder, away, results, poses, result, lambda *_: "")
    assert list(tmp_path.iterdir()) == []
