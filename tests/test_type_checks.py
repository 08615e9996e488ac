"""What is checked once for calls alike is still checked wherever it may be otherwise."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import open3d
import pytest
import torch
from jaxtyping import Float, Int, TypeCheckError
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.geometry.lie import Similarity, hat
from tests.kinds import NotComparable, kinds_for
from tests.type_checks import EVERY, checked


@checked
def doubled(x: Float[ndarray, "n 3"], rows: int = 0, whole: bool = True) -> Float[ndarray, "n 3"]:
    return 2 * x if whole else 2 * x[:rows].astype(int)


@checked
@dataclass
class Pair:
    a: Float[ndarray, " n"]
    b: Float[ndarray, " n"]


@checked
def total(parts: list[Float[ndarray, " n"]]) -> float:
    return float(np.sum([part.sum() for part in parts]))


@checked
def said(word: Literal["yes", "no"]) -> int:
    return len(word)


@checked
def length(of: tuple[int, ...] | Sequence[int], names: tuple[str, int] = ("", 0)) -> int:
    return len(of)


@checked
def of_size(n: int, x: Float[ndarray, "{n} 2"]) -> None: ...


def test_the_package_is_checked(monkeypatch):
    T = np.eye(4)
    for function in (Similarity.__init__, hat):  # other tests of this process may have called them often
        monkeypatch.setattr(function.checks, "calls", 0)
    for _ in range(2):
        assert Similarity(1.0, T[:3, :3], T[:3, 3]).scale == 1
        np.testing.assert_array_equal(hat(torch.zeros(2, 3)), torch.zeros(2, 3, 3))
        with pytest.raises(TypeCheckError):
            Similarity(1.0, T, T[:3, 3])
        with pytest.raises(TypeCheckError):
            hat(torch.zeros(2, 4))


def test_what_was_right_stays_right_and_is_returned():
    for _ in range(3):
        np.testing.assert_array_equal(doubled(np.ones((2, 3))), np.full((2, 3), 2.0))
        assert total([np.ones(2), np.ones(2)]) == 4
        assert said("yes") == 3 and said(word="no") == 2
        assert length((1, 5)) == 2 and length(range(7), names=("a", 1)) == 7
        of_size(2, np.ones((2, 2)))
        assert Pair(np.ones(3), b=np.zeros(3)).b.sum() == 0


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: doubled(np.ones((2, 4))),
        lambda: doubled(np.ones((2, 3), dtype=int)),
        lambda: doubled(np.ones((2, 3)), 1.0),
        lambda: doubled(np.ones((2, 3)), rows="1"),
        lambda: doubled(torch.ones(2, 3)),
        lambda: doubled([[1.0, 2.0, 3.0]]),
        lambda: Pair(np.ones(3), np.zeros(2)),
        lambda: Pair(np.ones(3), b=None),
        lambda: total([np.ones(2, dtype=int)] * 2),
        lambda: total((np.ones(2), np.ones(2))),
        lambda: said("perhaps"),
        lambda: length(("a", "b")),
        lambda: length((1, 2), ("a", "b")),
        lambda: of_size(3, np.ones((2, 2))),
    ],
)
def test_calls_that_differ_from_right_ones_are_checked(wrong):
    test_what_was_right_stays_right_and_is_returned()
    for _ in range(2):
        with pytest.raises(TypeCheckError):
            wrong()


def test_results_are_checked_whatever_was_returned_before():
    """By arguments of the same types: those of a dtype and of a size that were not returned before."""
    x = np.ones((4, 3))
    doubled(x, 4, True)
    with pytest.raises(TypeCheckError, match=r"return value of tests.test_type_checks.doubled"):
        doubled(x, 4, False)
    with pytest.raises(TypeCheckError, match=r"return value of tests.test_type_checks.doubled"):
        doubled(x, 2, False)
    doubled(x, 4, True)


def test_a_list_of_different_things_is_checked_every_time():
    """Of a list, a check looks at one item by chance: sooner or later at the wrong one."""
    with pytest.raises(TypeCheckError):
        for _ in range(200):
            total([np.ones(2), np.ones(2, dtype=int)])
    with pytest.raises(TypeCheckError):
        for _ in range(200):
            length((1, True, None))


def test_closures_are_checked_each_with_its_own_values():
    def made(value):
        @checked
        def give(x: Float[ndarray, " n"]) -> Int[ndarray, " n"]:
            return value

        return give

    assert made(np.arange(2))(np.ones(2)).sum() == 1
    assert made(np.arange(2) + 5)(np.ones(2)).sum() == 11
    with pytest.raises(TypeCheckError):
        made(np.arange(3))(np.ones(2))
    with pytest.raises(TypeCheckError):
        made(np.ones(2))(np.ones(2))


def test_of_many_calls_some_are_checked():
    @checked
    def give(x: int) -> int:
        return x

    for _ in range(1000):
        give(1)
    with pytest.raises(TypeCheckError):
        for _ in range(EVERY):
            give("1")


def test_errors_of_the_function_are_its_own():
    @checked
    def fails(x: int) -> int:
        if x < 0:
            raise ValueError("negative")
        return x

    for x in (1, -1, -2, 3):
        if x > 0:
            assert fails(x) == x
        else:
            with pytest.raises(ValueError, match="negative"):
                fails(x)


def test_kinds_tell_what_checks_ask_for():
    records, sequences = kinds_for("tuple[int, str]"), kinds_for("tuple[int, ...]")
    words, sized = kinds_for("Literal['a']"), kinds_for("Float[ndarray, '{n}']")
    assert records.of_all([(1, "a")]) == records.of_all([(2, "b")]) != records.of_all([("b", 2)])
    assert words.of_all(["a"]) != words.of_all(["b"])
    x: Tensor = torch.ones(2)
    assert records.of_all([x]) != records.of_all([torch.nn.Parameter(x)]) != records.of_all([x.double()])
    assert records.of_all([int]) != records.of_all([float])
    for call in (
        partial(sequences.of_all, [(1, "a")]),
        partial(sequences.of_all, [{1: "a", 2: 3}]),
        partial(records.of_all, [list(range(100))]),
        partial(records.of_all, [{}.keys()]),
        partial(records.of_all, [open3d.core.Tensor([1])]),
        partial(sized.of_all, [1]),
    ):
        with pytest.raises(NotComparable):
            call()
