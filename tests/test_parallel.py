"""What a process may use, pieces of work on several threads, and compiled loops cut into pieces."""

import mmap
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio import parallel as module
from sl_nerfstudio.parallel import (
    compiled_range,
    cores,
    keep_freed_memory,
    memory_of_process,
    one_library_thread,
    one_torch_thread,
    parallel,
    read_at_random,
    read_in_order,
    results,
    split,
    threads,
    torch_on_one_thread,
    tracked,
)
from sl_nerfstudio.storage import largest_in_memory


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@given(st.integers(0, 10_000), st.integers(1, 64), st.integers(1, 300))
def test_ranges_cover_everything_once_and_begin_at_multiples(n: int, parts: int, multiple: int) -> None:
    ranges = split(n, parts, multiple)
    assert 1 <= len(ranges) <= parts
    assert [i for first, last in ranges for i in range(first, last)] == list(range(n))
    assert all(first % multiple == 0 for first, _ in ranges)


def test_tasks_run_at_the_same_time() -> None:
    with torch_threads(2):
        meeting = threading.Barrier(2, timeout=20)
        parallel([lambda: meeting.wait(), lambda: meeting.wait()])  # one after the other they would never meet
    assert not meeting.broken


def test_what_a_task_raises_comes_out() -> None:
    def fail() -> None:
        raise KeyError("from a task")

    for tasks in ([fail], [fail, int], [int] * 20 + [fail]):
        with pytest.raises(KeyError, match="from a task"):
            parallel(tasks)


@pytest.mark.parametrize("alone", [one_library_thread, one_torch_thread])
def test_torch_has_one_thread_and_our_loops_all(alone) -> None:
    with torch_threads(3):
        with pytest.raises(ValueError, match="inside"), alone():
            assert (torch.get_num_threads(), threads()) == (1, 3)
            with alone():
                assert (torch.get_num_threads(), threads()) == (1, 3)
            assert (torch.get_num_threads(), threads()) == (1, 3)
            raise ValueError("inside")
        assert (torch.get_num_threads(), threads()) == (3, 3)


def test_torch_may_stay_on_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_ours", None)
    with torch_threads(3):
        torch_on_one_thread()
        assert (torch.get_num_threads(), threads()) == (1, 3)
        torch_on_one_thread()
        with one_torch_thread():
            assert (torch.get_num_threads(), threads()) == (1, 3)
        assert (torch.get_num_threads(), threads()) == (1, 3)


def _add_squares(first: int, last: int, values: np.ndarray, out: np.ndarray) -> None:
    for i in range(first, last):
        out[i] += values[i] * values[i]


@pytest.mark.parametrize("count", [0, 1, 3, 1000])
@pytest.mark.parametrize("used", [1, 3])
def test_a_compiled_loop_does_each_iteration_once(count: int, used: int) -> None:
    values, out = np.arange(1000, dtype=np.float64), np.ones(1000)
    with torch_threads(used):
        compiled_range(_add_squares)(count, values, out)
    assert np.array_equal(out[:count], 1 + values[:count] ** 2)
    assert (out[count:] == 1).all()


@pytest.mark.parametrize(("tasks", "left"), [(1, 3), (2, 3), (3, 1), (7, 1)])
def test_what_tasks_call_stays_on_their_thread_where_all_threads_have_one(tasks: int, left: int) -> None:
    with torch_threads(3):
        assert results([threads] * tasks) == [left] * tasks
        inner = results([lambda: results([threading.get_ident] * 20)] * tasks)
        assert left > 1 or all(len(set(idents)) == 1 for idents in inner)
        with pytest.raises(ZeroDivisionError):
            results([partial(divmod, 1, 0)] * tasks)
        assert threads() == 3


@pytest.mark.parametrize("used", [1, 3])
@pytest.mark.parametrize("count", [0, 1, 11, 12, 13, 100])
def test_tracked_results_are_in_order_and_their_progress_reaches_the_end(monkeypatch, used, count):
    seen = []

    def track(batches: list[list[object]], words: str) -> Iterator[list[object]]:
        for batch in batches:
            yield batch
            seen.append((words, len(batch)))

    monkeypatch.setattr(module, "track", track)
    with torch_threads(used):
        assert tracked([partial(pow, k, 2) for k in range(count)], "squares") == [k * k for k in range(count)]
    assert sum(n for _, n in seen) == count and {words for words, _ in seen} <= {"squares"}


def test_tasks_may_have_tasks_of_their_own() -> None:
    """More than there are workers, at two levels: a thread that waited for another's place would wait for ever."""
    many = 4 * (os.cpu_count() or 1)

    def inner(k: int) -> list[int]:
        return results([partial(lambda n: (time.sleep(0.001), n)[1], many * k + j) for j in range(many)])

    found: list[list[int]] = []
    with torch_threads(many + 1):
        thread = threading.Thread(target=lambda: found.extend(results([partial(inner, k) for k in range(many)])))
        thread.daemon = True
        thread.start()
        thread.join(20)
    assert found == [[many * k + j for j in range(many)] for k in range(many)]


# Control groups, laid out as Linux shows them.

MACHINE = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


@pytest.fixture
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, dict[str, str]], None]:
    """Eight cores, and the groups that are laid out."""

    def lay_out(own: str, files: dict[str, str]) -> None:
        for name, text in {**files, "own": own}.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "OWN", tmp_path / "own")
    return lay_out


def version_1(folder: str, quota: str) -> dict[str, str]:
    return {f"{folder}/cpu.cfs_quota_us": quota, f"{folder}/cpu.cfs_period_us": "100000\n"}


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {}, 8),
        ("0::/\n", {"cpu.max": "max 100000\n"}, 8),
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 2),  # a container
        ("0::/\n", {"cpu.max": "99000 1000\n"}, 8),
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000\n", "a/cpu.max": "150000 50000\n"}, 3),  # the group around it
        ("4:cpu,cpuacct:/x\n2:pids:/y\n", version_1("cpu/x", "400000\n"), 4),
        ("4:cpu:/\n", version_1("cpu", "-1\n"), 8),
        ("4:cpu:/gone\n", version_1("cpu", "50000\n"), 1),
        ("0::/\n", {"cpu.max": "nonsense\n"}, 8),
    ],
)
def test_cores_are_those_that_the_smallest_quota_of_all_groups_around_a_process_allows(groups, own, files, expected):
    groups(own, files)
    assert cores() == expected


@pytest.mark.parametrize(
    ("own", "group", "text", "expected"),
    [
        ("0::/\n", "memory.max", "8000000\n", 8000000),  # a container
        ("0::/a/b\n", "a/memory.max", "8000000\n", 8000000),  # the group around the process's own
        ("4:memory:/a\n0::/\n", "memory/a/memory.limit_in_bytes", "8000000\n", 8000000),
        ("0::/a\n", "b/memory.max", "8000000\n", MACHINE),  # another group
        ("0::/\n", "memory.max", "max\n", MACHINE),
        ("4:memory:/\n", "memory/memory.limit_in_bytes", "9223372036854771712\n", MACHINE),  # version 1 without a limit
        ("", "nothing", "", MACHINE),
    ],
)
def test_memory_is_as_much_as_control_groups_allow(groups, own, group, text, expected):
    groups(own, {group: text})
    assert memory_of_process() == expected and largest_in_memory() == expected // 8


# Freed memory stays with the process, where the C library lets it; how mapped memory is read.

MIB = 1 << 20


def resident_mib() -> float:
    """Memory of this process that lies in RAM (proc_pid_statm(5))."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / MIB


def test_freed_memory_stays_and_is_used_again():
    if keep_freed_memory():
        first = np.ones(96 * MIB, np.uint8)
        held = resident_mib()
        del first
        assert resident_mib() > held - 8  # returned: 96 less
        second = np.ones(64 * MIB, np.uint8)
        assert resident_mib() < held + 8  # mapped anew: 64 more
        del second


@pytest.mark.skipif(sys.platform != "linux", reason="other systems are told nothing")
def test_the_system_is_told_how_mapped_memory_is_read(tmp_path: Path) -> None:
    """Its own flags of the mapping: "rr" is random read (proc_pid_smaps(5))."""
    (tmp_path / "file").write_bytes(bytes(4 * mmap.PAGESIZE))
    array = np.memmap(tmp_path / "file", np.uint8, "r")

    def flags() -> list[str]:
        found = [line.split() for line in Path("/proc/self/smaps").read_text().splitlines()]
        starts = [k for k, words in enumerate(found) if words and words[-1] == str(tmp_path / "file")]
        assert len(starts) == 1
        return next(words[1:] for words in found[starts[0] :] if words[0] == "VmFlags:")

    assert "rr" not in flags()
    read_at_random(array.ctypes.data + 5, array.nbytes - 5)
    assert "rr" in flags()
    read_in_order(array.ctypes.data, array.nbytes)
    assert "rr" not in flags()
    read_at_random(array.ctypes.data, 0)
    assert "rr" not in flags()


def test_machine_code_is_read_or_made_by_one_process_at_a_time(tmp_path: Path) -> None:
    """Two objects stand for two processes: locks belong to open files. The first may be held again by its thread."""
    (tmp_path / "file").write_text("")
    one, other = (module._OneAtATime(tmp_path / "file" / "none", tmp_path / "code") for _ in range(2))
    order, entered = [], threading.Event()

    def second() -> None:
        entered.set()
        with other:
            order.append("second")

    thread = threading.Thread(target=second)
    with one, one:
        thread.start()
        assert entered.wait(20)
        thread.join(0.05)
        order.append("first")
    thread.join(20)
    assert order == ["first", "second"]


_MADE_ONCE = """
import made
print(made.twice(21), made.twice(1.5), sum(made.twice.stats.cache_misses.values()))
"""


@pytest.mark.slow
def test_of_processes_that_need_the_same_code_one_compiles_it(tmp_path: Path) -> None:
    lines = ["from sl_nerfstudio.parallel import compiled", "@compiled", "def twice(x): return 2 * x", ""]
    (tmp_path / "made.py").write_text("\n".join(lines))
    paths = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    command, environment = [sys.executable, "-c", _MADE_ONCE], {**os.environ, "PYTHONPATH": paths}
    started = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    said = [process.communicate(timeout=300)[0].split() for process in started]
    assert [words[:2] for words in said] == [["42", "3.0"]] * 3
    assert sum(int(words[2]) for words in said) == 2  # for whole numbers and for others
