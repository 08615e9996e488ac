"""The kernels for GPUs, interpreted on the CPU: against the plain field; besides, few launches and no waits."""

import gc
import re
import weakref
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.field import device_kernels
from sl_nerfstudio.field.device_kernels import launches
from sl_nerfstudio.field.optimiser import _corrections, _step_any, _step_device
from tests.field.fields import make_field, points_around, relative


def gradients_of(field: Any, p: Tensor, q: Tensor) -> tuple[list[Tensor], list[Any]]:
    """Values, and gradients by points and parameters, of a loss on values at `p` and values and gradients at `q`."""
    p = torch.cat([p, q]).to(field.encoding.table.dtype).requires_grad_()
    first = len(p) - len(q)
    f, n = field.sdf_and_last_gradients(p, first)
    f_q = f[first:]
    loss = f[:first].square().sum() + (3 * f_q + (n.norm(dim=-1) - 1).square()).sum() + (n[:, 0] * f_q).sum()
    loss.backward()
    return [f.detach(), n.detach()], [p.grad, *(x.grad.clone() for x in field.parameters())]


@pytest.mark.parametrize(
    "counts", [(150, 100), (0, 0), *(pytest.param(n, marks=pytest.mark.slow) for n in ((0, 50), (50, 0), (1, 1)))]
)
def test_values_and_gradients_evaluated_together_are_those_of_the_plain_field(counts: tuple[int, int]) -> None:
    p, q = points_around(counts[0]), points_around(counts[1], seed=2)
    plain, ours = make_field("torch", torch.float64), make_field("triton")
    for got, wanted in zip(gradients_of(ours, p, q), gradients_of(plain, p, q), strict=True):
        for a, b in zip(got, wanted, strict=True):
            assert a.shape == b.shape
            assert b.numel() == 0 or float((a - b).abs().max()) <= 1e-5 * max(float(b.abs().max()), 1.0)


@pytest.mark.parametrize("last", [pytest.param(0, marks=pytest.mark.slow), 9])
def test_the_graph_of_a_step_goes_with_its_results(last: int) -> None:
    """A cycle would keep its memory, and tie gradients to the stream where it was made: no step could be recorded."""
    field, p = make_field("triton"), points_around(20).float()
    gc.collect()
    gc.disable()
    try:
        f, slopes = field.sdf_and_last_gradients(p, 20 - last)
        (f.sum() + slopes.sum()).backward()
        left = weakref.ref(f), weakref.ref(slopes)
        del f, slopes
        assert left[0]() is None and left[1]() is None
    finally:
        gc.enable()


def test_the_step_of_the_table_is_the_plain_one_and_clears_the_gradient() -> None:
    torch.manual_seed(0)
    ours, plain = nn.Parameter(torch.randn(500, 8)), nn.Parameter(torch.empty(500, 8))
    plain.data.copy_(ours.data)
    rate = torch.tensor(0.02)
    states = [{"moments": torch.zeros(500, 2, 8), "steps": torch.zeros(500)} for _ in range(2)]
    for step in range(12):
        gradient = torch.randn(500, 8) * (torch.rand(500, 1) < 0.6)
        ours.grad, plain.grad = gradient.clone(), gradient.clone()
        lr: float | Tensor = rate if step % 2 else 0.02  # a tensor is read by the kernel, not when it is queued
        _step_device(ours, states[0], lr, (0.9, 0.99), 1e-8)
        with torch.no_grad():
            _step_any(plain, states[1], torch.from_numpy(_corrections((0.9, 0.99))), 0.02, (0.9, 0.99), 1e-8)
        assert not bool(ours.grad.any())
    assert relative(ours, plain) < 1e-6
    assert torch.equal(states[0]["steps"], states[1]["steps"])


def test_long_runs_correct_the_moments_as_exactly_as_the_plain_step() -> None:
    """1 - beta^t in single precision, from the first step to the last that differs from 1."""
    for t in (1.0, 2.0, 30.0, 3000.0, 16000.0):
        ours, plain = nn.Parameter(torch.zeros(1, 8)), nn.Parameter(torch.zeros(1, 8))
        states = [{"moments": torch.rand(1, 2, 8), "steps": torch.full((1,), t - 1)}]
        states.append({name: x.clone() for name, x in states[0].items()})
        ours.grad, plain.grad = torch.ones(1, 8), torch.ones(1, 8)
        _step_device(ours, states[0], 1.0, (0.9, 0.999), 1e-8)
        with torch.no_grad():
            _step_any(plain, states[1], torch.from_numpy(_corrections((0.9, 0.999))), 1.0, (0.9, 0.999), 1e-8)
        torch.testing.assert_close(ours, plain, rtol=2e-6, atol=0)


class Operations(TorchDispatchMode):
    """Names of torch's operations other than views and allocations."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func._schema.name.split("::")[-1]
        if not (func.is_view or name.startswith(("empty", "new_empty", "detach", "_unsafe_view"))):
            self.names.append(name)
        return func(*args, **(kwargs or {}))


def test_a_step_takes_few_launches_and_reads_no_value_of_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    field, p = make_field("triton"), points_around(1300).float().requires_grad_()
    field.sdf(p.detach()).sum().backward()  # makes the buffer of the table's gradient
    field.zero_grad()
    monkeypatch.setattr(device_kernels, "run", lambda *_: None)  # the interpreter has operations of its own
    with Operations() as operations, launches() as kernels:
        f, n = field.sdf_and_last_gradients(p, 1000)
        forward, steps = len(kernels), len(operations.names)
        torch.autograd.backward((f, n), [torch.ones_like(f), torch.ones_like(n)])
    assert kernels[:forward] == ["encode", "activate", "top", "through", "to_points"]
    assert kernels[forward:] == ["encode", "through", "adjoint", "adjoint", "scatter", "to_points"]
    seen = [name for name in operations.names if name != "ones_like"]
    assert set(seen) == {"mm", "new_zeros", "fill_"}  # nothing whose size depends on values, nothing read by the host
    assert (steps, len(seen)) == (4, 12)  # the filling is that of the marks, which a GPU has none of


def test_what_the_backend_cannot_do_is_said_when_it_is_chosen_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    p = points_around(10)
    with pytest.raises(UserError, match=r"computes in float32, the field is torch\.float64"):
        make_field("triton", torch.float64).sdf(p)
    monkeypatch.setattr(device_kernels, "find_spec", lambda name: None)
    monkeypatch.setattr(device_kernels, "_tried", device_kernels._tried.__wrapped__)
    with pytest.raises(UserError, match="needs the package triton, which comes with torch on Linux; choose"):
        make_field("triton").sdf(p.float())
    monkeypatch.setattr(device_kernels, "INTERPRETED", False)
    with pytest.raises(UserError, match="runs on a GPU; on the CPU only with TRITON_INTERPRET=1"):
        make_field("triton").sdf(p.float())


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(13, "Permission denied", "/root/.triton"), "TRITON_CACHE_DIR may name a folder"),
        (RuntimeError("long trace\nPTX was compiled with an unsupported toolchain"), "unsupported toolchain.*driver"),
        (ImportError("libtriton.so: broken"), r"ImportError: libtriton\.so: broken"),
    ],
)
def test_a_triton_that_does_not_work_is_said_with_its_cause(error, said, monkeypatch):
    def fails(*_: Any) -> None:
        raise error

    field = make_field("triton")
    monkeypatch.setattr(device_kernels, "run", fails)
    monkeypatch.setattr(device_kernels, "_tried", device_kernels._tried.__wrapped__)
    assert re.search(said, field.obstacle("triton") or "")
    with pytest.raises(UserError, match="Triton cannot compile or run kernels here"):
        field.sdf(points_around(10).float())  # chosen by hand; chosen by itself, it is not used: tests/pretended
