import itertools
from pathlib import Path

import pytest
import torch

from sl_nerfstudio.model.optimisers import (
    DecaySchedulerConfig,
    FusedAdamOptimizerConfig,
    LearningRate,
    RowAdamOptimizerConfig,
)


@pytest.mark.parametrize("shape", ["cosine", "exponential"])
def test_ends_and_middle(shape: str) -> None:
    rate = LearningRate(shape, final=0.01, max_steps=100)  # type: ignore[arg-type]
    values = [rate(step) for step in range(300)]
    assert values[0] == 1 and values[50] == pytest.approx(0.505 if shape == "cosine" else 0.1)
    assert values[100:] == pytest.approx([0.01] * 200)
    assert all(a >= b for a, b in itertools.pairwise(values)) and {type(v) for v in values} == {float}


def run(steps: int, state: dict | None, max_steps: int) -> tuple[list[float], dict]:
    parameter = torch.nn.Parameter(torch.zeros(3))
    optimizer = FusedAdamOptimizerConfig(lr=0.02).setup([parameter])
    assert optimizer.defaults["fused"]
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


def test_row_adam_uses_the_rates_of_the_config() -> None:
    table = torch.nn.Parameter(torch.zeros(4, 2))
    optimizer = RowAdamOptimizerConfig(lr=0.5).setup([table])
    table.grad = torch.tensor([[0.0, 0], [1, -2], [0, 0], [3, 0]])
    optimizer.step()
    torch.testing.assert_close(table.detach(), torch.tensor([[0, 0], [-0.5, 0.5], [0, 0], [-0.5, 0]]))
