"""The frame stage: decoding, resuming, frames that fail, and workers that end with their parent."""

import json
import mmap
import os
import signal
import subprocess
import sys
import time
import weakref
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing import frames, records
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.frames import (
    FrameWorker,
    capture_sentences,
    clouds_of,
    describe_frame_stage,
    run_frame_stage,
    run_frames,
)
from sl_nerfstudio.processing.records import digest
from sl_nerfstudio.scan.images import encode_png
from tests.decoding.ramps_decoder import RampsDecoder
from tests.processing.ramp_scan import LAYOUT, NAMES


class KilledDecoder(RampsDecoder):
    """As if the system had run out of memory."""

    def decode(self, images, names):
        os._exit(9)


def _found(scan):
    return find_captures(scan.root / "images", True)


def test_results_say_how_much_was_decoded_and_come_from_the_store_the_second_time(ramp_scan, tmp_path):
    config, job, captures = ramp_scan.config(tmp_path / "s"), ramp_scan.job(tmp_path / "w"), _found(ramp_scan)
    first = run_frame_stage(config, job, captures)
    second = run_frame_stage(config, job, captures)
    assert [r.name for r in first] == [r.name for r in second] == list(NAMES)
    for a, b, exact in zip(first, second, ramp_scan.coords, strict=True):
        assert not a.resumed and b.resumed and a.key == b.key and a.stage == b.stage == ""
        assert a.decode_rate == b.decode_rate == 1
        assert a.mask_share == pytest.approx(np.isfinite(exact).all(-1).mean(), abs=1e-3)
        np.testing.assert_array_equal(a.cloud.coords, b.cloud.coords)
        np.testing.assert_array_equal(a.cloud.pose.T_camera_projector, b.cloud.pose.T_camera_projector)
    assert describe_frame_stage(first).startswith("decoded and calibrated 4 of 4 frames: 100% of the pattern, epipolar")
    assert "4 of 4 frames (4 had been decoded before): 100%" in describe_frame_stage(second)
    frames = json.loads((tmp_path / "w" / "manifest.json").read_text())["frames"]
    assert {name: frame["status"] for name, frame in frames.items()} == dict.fromkeys(NAMES, "decoded before")


def test_frames_that_fail_are_named_with_their_file_and_the_others_go_on(copy, tmp_path):
    images = copy.root / "images"
    (images / NAMES[0] / "0.png").write_bytes(b"broken")
    (images / NAMES[1] / "1.png").unlink()
    (images / NAMES[2] / "0.png").write_bytes(encode_png(np.zeros((130, 130), np.uint16)))
    speckled = np.zeros((130, 130), np.uint16)
    speckled[60:63, 60:64] = 30000
    (images / NAMES[3] / "0.png").write_bytes(encode_png(speckled))
    job = copy.job(tmp_path / "w")
    results = run_frame_stage(copy.config(tmp_path / "s"), job, _found(copy))
    assert [r.stage for r in results] == ["reading", "decoding", "decoding", "calibrating"]
    assert clouds_of(results) == []
    assert f"{NAMES[0]}/0.png: is not an image that can be read" in results[0].reason
    assert results[1].reason.startswith(f"{images / NAMES[1]}: holds 1 images, not 2\n    cause:  some are missing")
    assert results[2].reason.startswith(f"{images / NAMES[2]}: is black")
    assert results[3].reason.startswith(f"{images / NAMES[3]}: 12 decoded pixels are too few")
    assert all("cause:" in r.reason and "remedy:" in r.reason for r in results)
    assert results[3].key and not results[1].key
    assert describe_frame_stage(results) == "decoded and calibrated 0 of 4 frames"
    frames = json.loads((tmp_path / "w" / "manifest.json").read_text())["frames"]
    assert {name: frame["status"] for name, frame in frames.items()} == {
        NAMES[1]: "failed in decoding", NAMES[2]: "failed in decoding", NAMES[3]: "failed in calibrating",
    }  # fmt: skip


def test_an_image_that_breaks_after_it_was_found_is_a_failure_of_its_frame(copy, tmp_path):
    frame = _found(copy).frames[0]
    frame.images[1].write_bytes(b"")
    result = FrameWorker(copy.job(tmp_path / "w"))(frame)
    assert result.stage == "reading" and "1.png: is empty" in result.reason and result.cloud is None


@pytest.mark.slow
def test_several_processes_give_the_same_and_one_that_is_killed_is_explained(ramp_scan, tmp_path):
    captures = _found(ramp_scan)
    results = {r.name: r for r in run_frames(ramp_scan.job(tmp_path / "two"), captures.frames, 2)}
    alone = FrameWorker(ramp_scan.job(tmp_path / "one"))
    for frame in captures.frames:
        expected = alone(frame)
        assert results[frame.name].key == expected.key
        assert digest(results[frame.name].cloud) == digest(expected.cloud)
    job = ramp_scan.job(tmp_path / "killed")
    killed = type(job)(job.work, KilledDecoder(LAYOUT), job.camera, job.projector, job.seed)
    with pytest.raises(UserError, match=r"was killed\n.*cause:  2 processes need more memory.*\n.*--jobs"):
        list(run_frames(killed, captures.frames, 2))


@pytest.mark.slow
def test_results_of_other_processes_do_not_stay_in_memory(ramp_scan, tmp_path):
    """The caller moves clouds to a file once they are many: then nobody else may hold them."""
    gone = []
    for result in run_frames(ramp_scan.job(tmp_path), _found(ramp_scan).frames, 2):
        assert all(earlier() is None for earlier in gone[:-1])  # the last one waits in its future for the next
        gone.append(weakref.ref(result.cloud))
        del result
    assert len(gone) == len(NAMES) and all(cloud() is None for cloud in gone)


def test_clouds_stay_in_memory_up_to_a_limit(results):
    clouds = clouds_of(results)
    size = sum(array.nbytes for array in (clouds[0].points, clouds[0].coords))
    kept = records.LargeClouds(6 * size)
    same = [kept.kept(cloud) for cloud in clouds]
    assert digest(tuple(same)) == digest(tuple(clouds))
    assert not _mapped(same[0].points) and _mapped(same[-1].points) and _mapped(same[-1].pose.noise_px)


def _mapped(array):
    while array is not None and not isinstance(array, mmap.mmap):
        array = getattr(array, "base", None)
    return array is not None


_PARENT = """
import os, time
from concurrent.futures import as_completed
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.parallel import no_interrupts
from sl_nerfstudio.processing.frames import worker_pool

def begin(word):
    print(word, os.getpid(), flush=True)

def work(_):
    time.sleep(120)

def main():
    with worker_pool(2, begin, "worker") as pool:
        with no_interrupts():
            futures = [pool.submit(work, k) for k in range(5)]
        for future in as_completed(futures):
            future.result()

if __name__ == "__main__":
    run(main)
"""


@pytest.fixture
def busy(tmp_path):
    """A parent with two workers at work, in a process group of their own, and the numbers of the workers."""
    script = tmp_path / "parent.py"
    script.write_text(_PARENT)
    process = subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )  # fmt: skip
    workers = [int(process.stdout.readline().split()[1]) for _ in range(2)]
    yield process, workers
    process.kill()
    process.communicate()


def _running(process):
    """Whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def _all_end(workers):
    end = time.monotonic() + 60
    while any(map(_running, workers)) and time.monotonic() < end:
        time.sleep(0.02)
    return not any(map(_running, workers))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "to_all", "status", "said"),
    [
        (signal.SIGINT, True, 130, "interrupted\n"),  # control-C in a terminal reaches the workers, too
        (signal.SIGTERM, False, 143, "terminated\n"),
        (signal.SIGKILL, False, -signal.SIGKILL, None),  # Python's own tracker may warn of what it released
    ],
)
def test_a_signal_ends_the_workers_and_only_the_parent_speaks(busy, number, to_all, status, said):
    parent, workers = busy
    (os.killpg if to_all else os.kill)(parent.pid, number)
    if said is None:
        assert _all_end(workers) and "Traceback" not in "".join(parent.communicate())
    else:
        assert parent.communicate(timeout=100) == ("", said)
    assert parent.wait() == status and _all_end(workers)


@pytest.mark.parametrize(
    "megapixels, gigabytes, expected",
    [(0.36, 64, 16), (0.36, 8, 3), (12.2, 16, 3), (12.2, 64, 13), (24, 32, 4), (0.36, 2, 1), (50, 4, 1)],
)
def test_no_more_processes_are_started_than_there_is_memory_for(monkeypatch, megapixels, gigabytes, expected):
    monkeypatch.setattr(frames, "cores", lambda: 16)
    found = frames.default_processes(int(megapixels * 1e6), gigabytes * 10**9)
    assert found == expected
    assert found == 1 or found * (1.4 + 0.2 * megapixels) + 1 < gigabytes
    assert frames.default_processes(24_000_000, 32 * 10**9, 6) == 14  # shrunk as they are read


def test_what_the_decoder_noted_is_said_once_with_its_frames():
    noted = [("f0", ()), ("f1", ("decoded to 4 px", "overexposed")), ("f2", ("decoded to 4 px",))]
    assert capture_sentences(noted) == ["f1, f2: decoded to 4 px", "f1: overexposed"]
    assert capture_sentences(noted[1:]) == ["all: decoded to 4 px", "f1: overexposed"]
