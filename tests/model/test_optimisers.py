import itertools
import math
import warnings
from pathlib import Path

import pytest
import torch

with warnings.catch_warnings():  # warnings are errors, but these are nerfstudio's own
    warnings.simplefilter("ignore")
    import nerfstudio.engine.trainer  # noqa: F401

from sl_nerfstudio.model.optimisers import (
    DecaySchedulerConfig,
    FusedAdamOptimizerConfig,
    LearningRate,
    RowAdamOptimizerConfig,
)


@pytest.mark.parametrize("shape", ["cosine", "exponential"])
def test_ends_and_middle(shape: str) -> None:
    rate = LearningRate(shape, final=0.01, warm_up=10, max_steps=110)  # type: ignore[arg-type]
    assert rate(0) == pytest.approx(1 / 11) and rate(9) == pytest.approx(10 / 11)
    assert rate(10) == 1
    assert rate(60) == pytest.approx(0.505 if shape == "cosine" else 0.1)
    assert rate(110) == pytest.approx(0.01) and rate(10**6) == pytest.approx(0.01)


@pytest.mark.parametrize("shape", ["cosine", "exponential"])
def test_never_rises_after_the_warm_up(shape: str) -> None:
    rate = LearningRate(shape, final=0.05, warm_up=0, max_steps=300)  # type: ignore[arg-type]
    values = [rate(s) for s in range(1000)]
    assert all(a >= b for a, b in itertools.pairwise(values)) and values[0] == 1
    assert all(type(v) is float and math.isfinite(v) for v in values)


def run(steps: int, state: dict | None, max_steps: int) -> tuple[list[float], dict]:
    parameter = torch.nn.Parameter(torch.zeros(3))
    optimizer = FusedAdamOptimizerConfig(lr=0.02).setup([parameter])
    scheduler = DecaySchedulerConfig(max_steps=max_steps).setup().get_scheduler(optimizer, 0.02)
    if state is not None:
        scheduler.load_state_dict(state)
    rates = []
    for _ in range(steps):
        parameter.grad = torch.ones(3)
        optimizer.step()
        scheduler.step()
        rates.append(scheduler.get_last_lr()[0])
    return rates, scheduler.state_dict()


def test_a_resumed_run_continues_the_first_runs_schedule(tmp_path: Path) -> None:
    whole, _ = run(40, None, 40)
    first, state = run(15, None, 40)
    torch.save(state, tmp_path / "state.pt")
    state = torch.load(tmp_path / "state.pt", weights_only=True)  # nothing that torch refuses to load
    rest, _ = run(25, state, max_steps=25)
    assert first + rest == whole


def test_a_missing_length_is_an_error() -> None:
    optimizer = FusedAdamOptimizerConfig().setup([torch.nn.Parameter(torch.zeros(1))])
    with pytest.raises(ValueError, match="max_steps is not set"):
        DecaySchedulerConfig().setup().get_scheduler(optimizer, 0.1)


def test_fused_adam_steps_as_adam_does() -> None:
    values = []
    for fused in (True, False):
        torch.manual_seed(0)
        parameter = torch.nn.Parameter(torch.randn(50))
        optimizer = FusedAdamOptimizerConfig(lr=0.1, weight_decay=0.01, fused=fused).setup([parameter])
        for _ in range(20):
            parameter.grad = torch.sin(parameter.detach())
            optimizer.step()
        values.append(parameter.detach())
    torch.testing.assert_close(*values, rtol=1e-5, atol=1e-6)


def test_row_adam_uses_the_rates_of_the_config() -> None:
    table = torch.nn.Parameter(torch.zeros(4, 2))
    optimizer = RowAdamOptimizerConfig(lr=0.5).setup([table])
    table.grad = torch.tensor([[0.0, 0], [1, -2], [0, 0], [3, 0]])
    optimizer.step()
    torch.testing.assert_close(table.detach(), torch.tensor([[0, 0], [-0.5, 0.5], [0, 0], [-0.5, 0]]))
