"""Curves of a run of any length stay small, complete and in order, also across a checkpoint."""

import math
from itertools import pairwise

import pytest
import torch

from sl_nerfstudio.model.outputs import History


def row(loss: float, rmse: float) -> dict[str, torch.Tensor]:
    return {"loss": torch.tensor(loss, dtype=torch.float64), "rmse": torch.tensor(rmse)}


def filled(count: int) -> History:
    history = History(["loss", "rmse"])
    for step in range(count):
        history.add(step, row(1.0 / (1 + step), step))
    return history


@pytest.mark.parametrize("count", [0, 1, 511, 512, 513, 10_000])
def test_the_table_stays_within_bounds_and_in_order(count):
    history = filled(count)
    curves = history.curves()
    assert list(curves) == ["step", "loss", "rmse"]
    steps = curves["step"]
    assert len(steps) < 512 and len(steps) >= min(count, 256)
    assert steps == sorted(set(steps))
    assert steps[:1] == [0.0][:count] and (count == 0 or steps[-1] >= count - 2)
    assert curves["rmse"] == steps and curves["loss"] == [1.0 / (1 + s) for s in steps]


def test_entries_get_sparser_as_a_run_gets_longer():
    history, added = History(["loss"]), 0
    for step in range(10_000):
        if step % history.every == 0:
            history.add(step, {"loss": torch.tensor(0.0)})
            added += 1
    steps = history.curves()["step"]
    assert added < 1200 and history.every == 20
    assert {b - a for a, b in pairwise(steps)} == {20.0}  # evenly spaced throughout
    assert steps[0] == 0 and steps[-1] >= 10_000 - 20


def test_a_checkpoint_continues_without_a_difference():
    whole, first = filled(1000), filled(600)
    second = History(["loss", "rmse"])
    second.load_state_dict(first.state_dict())
    assert second.every == first.every and second.curves() == first.curves()
    for step in range(600, 1000):
        second.add(step, row(1.0 / (1 + step), step))
    assert second.curves() == whole.curves() and second.every == whole.every


def test_missing_values_are_nan_and_unknown_names_are_ignored():
    history = History(["loss", "rmse"])
    history.add(3, {"loss": torch.tensor(2.0), "other": torch.tensor(1.0)})
    curves = history.curves()
    assert curves["step"] == [3.0] and curves["loss"] == [2.0] and math.isnan(curves["rmse"][0])
