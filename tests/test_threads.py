"""Pieces of work on several threads, and compiled loops cut into pieces."""

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import sl_nerfstudio.parallel as sl_threads
from sl_nerfstudio.parallel import (
    compiled_range,
    one_library_thread,
    one_torch_thread,
    parallel,
    results,
    split,
    threads,
    torch_on_one_thread,
    tracked,
)


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


@pytest.mark.parametrize("count", [0, 1, 2, 500])
def test_every_task_runs_once(count: int) -> None:
    done: Counter[int] = Counter()
    lock = threading.Lock()

    def task(number: int) -> Callable[[], None]:
        def run() -> None:
            with lock:
                done[number] += 1

        return run

    parallel([task(number) for number in range(count)])
    assert done == Counter(range(count))


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
    monkeypatch.setattr(sl_threads, "_ours", None)
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


def test_results_are_in_the_order_of_the_tasks() -> None:
    with torch_threads(4):
        assert results([partial(pow, k, 2) for k in range(50)]) == [k * k for k in range(50)]
        assert results([]) == []


def test_tasks_may_have_tasks_of_their_own() -> None:
    """More than there are workers, at two levels: a thread that waited for another's place would wait for ever."""
    many = 4 * (os.cpu_count() or 1)
    found: list[list[int]] = []
    with torch_threads(many + 1):
        thread = threading.Thread(target=lambda: found.extend(results([partial(row, many, k) for k in range(many)])))
        thread.daemon = True
        thread.start()
        thread.join(20)
    assert found == [[many * k + j for j in range(many)] for k in range(many)]


@pytest.mark.parametrize(("tasks", "left"), [(2, 3), (3, 1), (7, 1)])
def test_what_tasks_call_stays_on_their_thread_where_all_threads_have_one(tasks: int, left: int) -> None:
    with torch_threads(3):
        assert results([threads] * tasks) == [left] * tasks
        inner = results([lambda: results([threading.get_ident] * 20)] * tasks)
        assert left > 1 or all(len(set(idents)) == 1 for idents in inner)
        with pytest.raises(ZeroDivisionError):
            results([partial(divmod, 1, 0)] * tasks)
        assert threads() == 3


def test_a_task_that_is_alone_has_all_threads() -> None:
    with torch_threads(3):
        assert results([threads]) == [3]
    with torch_threads(1):
        assert results([lambda: results([threads])[0]]) == [1]


@pytest.mark.parametrize("used", [1, 3])
@pytest.mark.parametrize("count", [0, 1, 11, 12, 13, 100])
def test_tracked_results_are_in_order_and_their_progress_reaches_the_end(
    monkeypatch: pytest.MonkeyPatch, used: int, count: int
) -> None:
    seen = []

    def track(batches: list[list[object]], words: str) -> Iterator[list[object]]:
        for batch in batches:
            yield batch
            seen.append((words, len(batch)))

    monkeypatch.setattr(sl_threads, "track", track)
    with torch_threads(used):
        assert tracked([partial(pow, k, 2) for k in range(count)], "squares") == [k * k for k in range(count)]
    assert sum(n for _, n in seen) == count and {words for words, _ in seen} <= {"squares"}


def test_an_error_of_a_piece_of_tracked_work_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        tracked([partial(divmod, 1, k) for k in range(3)], "quotients")


def row(many: int, k: int) -> list[int]:
    return results([partial(product, many * k + j) for j in range(many)])


def product(number: int) -> int:
    time.sleep(0.001)
    return number
