"""RowAdam: torch's Adam where rows have gradients, nothing where they have none."""

import pytest
import torch
from torch import nn

from sl_nerfstudio.field.optimiser import RowAdam
from tests.field.fields import make_field, points_around


def test_is_adam_for_rows_that_always_have_a_gradient() -> None:
    torch.manual_seed(0)
    ours, theirs = nn.Parameter(torch.randn(20, 8)), nn.Parameter(torch.empty(20, 8))
    theirs.data.copy_(ours)
    optimisers = RowAdam([ours], lr=0.1, eps=1e-8), torch.optim.Adam([theirs], lr=0.1, betas=(0.9, 0.99), eps=1e-8)
    for _ in range(30):
        gradient = torch.randn(20, 8)
        for parameter, optimiser in zip((ours, theirs), optimisers, strict=True):
            parameter.grad = gradient.clone()
            optimiser.step()
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-5)


def test_rows_without_gradient_keep_their_value_and_count_their_own_steps() -> None:
    torch.manual_seed(0)
    some, alone = nn.Parameter(torch.ones(2, 3)), nn.Parameter(torch.ones(1, 3))
    both = RowAdam([some], lr=0.1), RowAdam([alone], lr=0.1)
    for step in range(6):
        gradient = torch.randn(1, 3)
        some.grad = torch.cat([torch.zeros(1, 3), gradient if step % 2 else torch.zeros(1, 3)])
        both[0].step()
        if step % 2:
            alone.grad = gradient
            both[1].step()
    assert torch.equal(some[0], torch.ones(3))
    torch.testing.assert_close(some[1], alone[0])


@pytest.mark.parametrize("clip", [False, True])
def test_the_compiled_step_of_a_table_is_the_plain_one(clip: bool) -> None:
    compiled, plain, p = make_field("numba"), make_field("torch"), points_around(3000).float()
    optimisers = [RowAdam([field.encoding.table], lr=1e-2) for field in (compiled, plain)]
    for step in range(4):
        for field, optimiser in zip((compiled, plain), optimisers, strict=True):
            optimiser.zero_grad()
            f, g = field.sdf_and_gradient(p[step * 700 : (step + 1) * 700])
            (f.square().sum() + (g.norm(dim=-1) - 1).square().sum()).backward()
            if clip:  # torch writes to the gradient: the kernels' own marks no longer hold
                nn.utils.clip_grad_norm_(field.encoding.table, 0.1)
            optimiser.step()
            assert field is plain or not field.encoding.table.grad.any()  # cleared for the next step
    # Adam divides gradients as small as rounding errors by themselves, so single numbers may differ by a step
    error = (compiled.encoding.table - plain.encoding.table).detach().abs()
    assert float(error.mean()) < 1e-7
    assert float((error > 1e-5).float().mean()) < 1e-3


def test_a_checkpoint_holds_only_rows_that_were_touched() -> None:
    table = torch.nn.Parameter(torch.rand(1000, 4))
    optimiser = RowAdam([table])
    for touched in ([3, 4], [4, 900]):
        table.grad = torch.zeros_like(table)
        table.grad[touched] = torch.rand(2, 4)
        optimiser.step()
    (packed,) = optimiser.state_dict()["state"].values()
    assert packed["touched"].tolist() == [3, 4, 900] and packed["steps"].tolist() == [1, 2, 1]
    assert packed["moments"].shape == (3, 2, 4)
    whole = dict(optimiser.state[table])
    for stored in (packed, whole):  # earlier versions stored all rows
        resumed = RowAdam([table])
        resumed.load_state_dict({**optimiser.state_dict(), "state": {0: stored}})
        for name, value in whole.items():
            torch.testing.assert_close(resumed.state[table][name], value, rtol=0, atol=0)
    table.grad = None
    assert optimiser.step(lambda: 3.5) == 3.5
