"""Workers end with their parent, at once, and print nothing."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sl_nerfstudio.processing import frames

_PARENT = """
import os, time
from concurrent.futures import as_completed
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.processing.frames import no_interrupts, worker_pool

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


def test_workers_end_when_their_parent_is_killed(busy):
    parent, workers = busy
    parent.kill()
    assert _all_end(workers)
    assert "Traceback" not in "".join(parent.communicate())  # Python's own tracker may warn of what it released


@pytest.mark.parametrize(
    ("number", "to_all", "status", "said"),
    [(signal.SIGINT, True, 130, "interrupted\n"), (signal.SIGTERM, False, 143, "terminated\n")],
)
def test_a_signal_ends_the_workers_and_only_the_parent_speaks(busy, number, to_all, status, said):
    """Control-C in a terminal reaches the workers, too."""
    parent, workers = busy
    (os.killpg if to_all else os.kill)(parent.pid, number)
    assert parent.communicate(timeout=100) == ("", said) and parent.returncode == status
    assert _all_end(workers)


@pytest.mark.parametrize(
    "megapixels, gigabytes, expected",
    [(0.36, 64, 16), (0.36, 8, 3), (12.2, 16, 3), (12.2, 64, 13), (24, 32, 4), (0.36, 2, 1), (50, 4, 1)],
)
def test_no_more_processes_are_started_than_there_is_memory_for(monkeypatch, megapixels, gigabytes, expected):
    monkeypatch.setattr(frames, "cores", lambda: 16)
    found = frames.default_processes(int(megapixels * 1e6), gigabytes * 10**9)
    assert found == expected
    assert found == 1 or found * (1.4 + 0.2 * megapixels) + 1 < gigabytes
