"""Frames matched along their epipolar lines, in the frame stage and in the work folder."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.decoding.grid_networks import networks_for_all_processes
from sl_nerfstudio.matching.matcher import LineMatcher
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.processing import frames
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.frames import FrameJob, FrameWorker, run_frames
from sl_nerfstudio.processing.masks import find_masks
from sl_nerfstudio.processing.records import DecodedStore
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """Two photographs of a chair, whose slats are as narrow as a period of the pattern, and the truth."""
    root = tmp_path_factory.mktemp("chair") / "captures"
    synthesise(SynthConfig(scene="chair", frames=2, resolution=420, seed=8, images_only=True), root)
    return root


@pytest.fixture(scope="module")
def job(captures, tmp_path_factory):
    truth = read_scan(captures / "ground_truth")
    decoder = NetworkDecoder(read_layout(captures / "pattern.json"))
    return FrameJob(tmp_path_factory.mktemp("work"), decoder, truth.frames[0].camera, truth.projector, 0)


@pytest.fixture(scope="module")
def frame(captures):
    return find_captures(captures / "images", False).frames[0]


@pytest.fixture(scope="module")
def result(job, frame):
    return FrameWorker(job)(frame)


def test_networks_in_a_process_of_their_own_give_workers_the_same_frames(job, captures, tmp_path):
    """As those on a GPU do, which one process opens for all."""
    shared = NetworkDecoder(job.decoder.layout)
    shared.networks = networks_for_all_processes("cpu")
    todo = find_captures(captures / "images", False).frames
    found = {x.name: x for x in run_frames(replace(job, decoder=shared, work=tmp_path, last_step="decode"), todo, 2)}
    for frame in todo:
        wanted = job.decoder.decode([frame.read(0)], [frame.name])
        got = DecodedStore(tmp_path, shared.key).load(frame, found[frame.name].key)
        np.testing.assert_allclose(got.coords, wanted.coords, rtol=0, atol=1e-3)


def counted(monkeypatch):
    """Counts how often a frame is matched."""
    calls, match = [], LineMatcher.match
    monkeypatch.setattr(LineMatcher, "match", lambda self, *given: calls.append(1) or match(self, *given))
    return calls


def test_a_matched_frame_has_more_and_better_coordinates(captures, job, frame, result):
    true = read_scan(captures / "ground_truth").frames[0].read_coords()
    before = DecodedStore(job.work, job.decoder.key).load(frame, result.key)
    after = FrameWorker(job).load(result)
    assert result.matched and result.matched != result.key

    def shares(coords):
        error = np.linalg.norm(coords - true, axis=-1)
        known = np.isfinite(coords[..., 0])
        return (error < 2).sum(), (~(error[known] < 2)).mean(), np.median(error[error < 2])

    (right, wrong, off), (right_now, wrong_now, off_now) = shares(before.coords), shares(after.coords)
    assert right_now > right and wrong_now < wrong + 0.005 and off_now < off
    assert (after.mask | ~after.decoded).all() and after.light is not None
    assert result.decode_rate == pytest.approx(after.rate) and result.cloud is not None
    np.testing.assert_array_equal(np.isfinite(result.cloud.coords[..., 0]) & ~after.decoded, False)


def test_a_later_run_takes_up_what_was_matched(job, frame, result, monkeypatch):
    calls = counted(monkeypatch)
    again = FrameWorker(job)(frame)
    assert again.resumed and again.matched == result.matched and not calls
    np.testing.assert_array_equal(again.cloud.points, result.cloud.points)


def test_other_devices_match_again(job, frame, result, monkeypatch):
    calls = counted(monkeypatch)
    longer = replace(job.projector, fl_x=job.projector.fl_x * 1.002, fl_y=job.projector.fl_y * 1.002)
    other = FrameWorker(replace(job, projector=longer))(frame)
    assert len(calls) == 1 and other.key == result.key and other.matched not in ("", result.matched)


def test_nothing_is_matched_before_the_camera_is_known(job, frame, result, monkeypatch):
    calls = counted(monkeypatch)
    unknown = FrameWorker(replace(job, last_step="calibrate"))(frame)
    assert unknown.matched == "" and not calls and unknown.key == result.key and unknown.cloud is not None
    assert FrameWorker(job).calibrate(unknown).matched == result.matched


def test_a_frame_that_several_poses_explain_is_left_as_it_was_decoded(job, frame, result, monkeypatch):
    calls, estimate = counted(monkeypatch), frames.estimate_relative_pose

    def two(*given):
        pose = estimate(*given)
        return replace(pose, alternatives=(pose,))

    monkeypatch.setattr(frames, "estimate_relative_pose", two)
    left = FrameWorker(replace(job, seed=5))(frame)
    assert left.matched == "" and not calls and len(left.cloud.alternatives) == 1


def test_the_users_masks_hold_after_matching(job, frame, result, tmp_path):
    whole = FrameWorker(job).load(result)
    half = np.zeros(whole.mask.shape, np.uint8)
    half[:, : half.shape[1] // 2] = 255
    (tmp_path / f"{frame.images[0].stem}.png").write_bytes(encode_png(half))
    masks = find_masks(tmp_path, {frame.name: (half.shape[1], half.shape[0])})
    masked_job = replace(job, masks=masks)
    masked = FrameWorker(masked_job)(frame)
    seen = FrameWorker(masked_job).load(masked)
    assert masked.matched and not seen.decoded[:, half.shape[1] // 2 :].any() and not seen.mask[half == 0].any()
    assert seen.decoded[half > 0].mean() > 0.9 * whole.decoded[half > 0].mean()
