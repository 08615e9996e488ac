"""The field: all implementations against torch's own derivatives, its behaviour as a distance, its cached grid."""

import copy

import pytest
import torch
from torch import Tensor, nn

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.field.field import CachedGrid, FieldConfig, SDFField
from sl_nerfstudio.field.torch_backend import knee
from tests.field.fields import make_field, plain_sdf, points_around, relative

CASES = [("torch", torch.float64, 1e-12), ("torch", torch.float32, 1e-5), ("numba", torch.float32, 1e-5)]
CASES += [("triton", torch.float32, 1e-5)]
WEIGHTS = torch.tensor([1.0, 0.5, 0.0, 0.25])


def gradients(field: SDFField) -> list[Tensor]:
    return [torch.zeros_like(x) if x.grad is None else x.grad.clone() for x in field.parameters()]


def reference(p: Tensor, g: Tensor, v: Tensor | None, hidden: int) -> tuple[list[Tensor], list[Tensor]]:
    """Values (f, df/dp) and parameter gradients of `g f + v . grad f`, by torch's double backward in float64."""
    field = make_field("torch", torch.float64, hidden=hidden)
    field.encoding.set_level_weights(WEIGHTS.double())
    p = p.clone().requires_grad_()
    f = plain_sdf(field, p)
    (n,) = torch.autograd.grad(f.sum(), p, create_graph=True)
    loss = (g * f).sum() if v is None else (g * f).sum() + (v * n).sum()
    loss.backward()
    return [f.detach(), n.detach()], gradients(field)


@pytest.mark.parametrize(("backend", "dtype", "tolerance"), CASES)
@pytest.mark.parametrize("hidden", [24, 40])
@pytest.mark.parametrize("of_gradients", [False, True])
def test_values_and_derivatives_are_those_of_double_backward(backend, dtype, tolerance, hidden, of_gradients):
    """Of values by points and parameters, and of values and gradients by the parameters."""
    p, g = points_around(150), torch.randn(150).double()
    v = torch.randn(150, 3).double() if of_gradients else None
    (f_true, n_true), parameters_true = reference(p, g, v, hidden)
    field = make_field(backend, dtype, hidden=hidden)
    field.encoding.set_level_weights(WEIGHTS.to(dtype))
    q = p.to(dtype).requires_grad_()
    if v is None:
        f = field.sdf(q)
        (f * g.to(dtype)).sum().backward()
        assert relative(q.grad, g[:, None] * n_true) < tolerance
    else:
        f, n = field.sdf_and_gradient(q)
        ((f * g.to(dtype)).sum() + (n * v.to(dtype)).sum()).backward()
        assert relative(n, n_true) < tolerance
    assert relative(f, f_true) < tolerance
    for got, wanted in zip(gradients(field), parameters_true, strict=True):
        assert relative(got, wanted) < tolerance


def test_activation_is_a_relu_outside_its_corner_and_twice_differentiable_in_it() -> None:
    z = torch.linspace(-0.1, 0.1, 100, dtype=torch.float64)  # no value at the corner's ends, +-0.02
    outside = z.abs() >= 0.02
    torch.testing.assert_close(knee(z, 0.02)[outside], z.clamp_min(0)[outside])
    z.requires_grad_()
    assert torch.autograd.gradcheck(lambda z: knee(z, 0.02), z)
    assert torch.autograd.gradgradcheck(lambda z: knee(z, 0.02), z)


def test_starts_as_a_sphere() -> None:
    torch.manual_seed(3)
    field = SDFField(FieldConfig())
    p = torch.rand(5000, 3) * 2 - 1
    f, n = field.sdf_and_gradient(p)
    error = (f - (p.norm(dim=-1) - 0.5)).detach()[p.norm(dim=-1) > 0.1]
    assert float(error.abs().max()) < 0.05
    assert float(error.std()) < 0.01
    direction = torch.nn.functional.cosine_similarity(n.detach(), p, dim=-1)
    assert float(direction[p.norm(dim=-1) > 0.2].min()) > 0.9


@pytest.mark.parametrize("backend", ["torch", "numba", "triton"])
def test_nan_points_give_nan_values_and_do_not_affect_others(backend: str) -> None:
    field = make_field(backend)
    p = points_around(200).float()
    clean = field.sdf(p).detach()
    p[17, 1] = float("nan")
    f, n = field.sdf_and_gradient(p)
    assert bool(f[17].isnan()) and bool(n[17].isnan().any())
    others = torch.arange(200) != 17
    torch.testing.assert_close(f[others].detach(), clean[others])
    if backend == "numba":
        infinite = torch.tensor([[float("inf"), 0, 0], [0, float("-inf"), 1e30]])
        assert bool((field.sdf(infinite) > 1e20).all())


@pytest.mark.parametrize("n", [0, 1, 7, 129])
def test_any_number_of_points(n: int) -> None:
    p = points_around(n).float()
    compiled, plain = make_field("numba"), make_field("torch")
    torch.testing.assert_close(compiled.sdf(p), plain.sdf(p), atol=1e-6, rtol=1e-5)
    f, g = compiled.sdf_and_gradient(p)
    (f.sum() + g.sum()).backward()
    assert f.shape == (n,) and g.shape == (n, 3)


def test_more_points_than_a_batch_and_two_threads_give_the_same_gradients() -> None:
    p = points_around(20000).float()
    results = []
    try:
        for threads in (1, 2, 2):
            torch.set_num_threads(threads)
            field = make_field("numba")
            q = p.clone().requires_grad_()
            field.sdf(q).square().sum().backward()
            field.sdf_and_gradient(p)[1].square().sum().backward()
            results.append([q.grad, *gradients(field)])
    finally:
        torch.set_num_threads(1)
    for one, two, again in zip(*results, strict=True):
        assert relative(two, one) < 1e-5
        assert torch.equal(two, again)  # independent of the threads' timing


def test_negligible_points_are_left_out_and_no_others() -> None:
    p, g = points_around(1000).float(), torch.randn(1000)
    g[::2] *= 1e-14
    compiled, plain = make_field("numba"), make_field("torch")
    for field in (compiled, plain):
        field.sdf(p).backward(g)
    for got, wanted in zip(gradients(compiled), gradients(plain), strict=True):
        assert relative(got, wanted) < 1e-5
    g[4] = float("nan")
    compiled.zero_grad()
    compiled.sdf(p).backward(g)
    assert all(bool(x.isnan().any()) for x in gradients(compiled))


COMPILED = pytest.mark.parametrize("backend", ["numba", "triton"])


@COMPILED
def test_backward_accumulates_and_starts_from_zero_after_zero_grad(backend: str) -> None:
    field, p = make_field(backend), points_around(100).float()

    def gradient(times: int) -> Tensor:
        for _ in range(times):
            field.sdf(p).sum().backward()
        assert field.encoding.table.grad is not None
        return field.encoding.table.grad.clone()

    once = gradient(1)
    torch.testing.assert_close(gradient(1), 2 * once)
    field.zero_grad(set_to_none=False)
    torch.testing.assert_close(gradient(1), once)
    field.zero_grad(set_to_none=True)
    torch.testing.assert_close(gradient(2), 2 * once)


def test_what_others_write_to_the_tables_gradient_does_not_survive_zero_grad() -> None:
    field, p = make_field("numba"), points_around(100).float()
    field.sdf(p).sum().backward()
    assert field.encoding.table.grad is not None
    once = field.encoding.table.grad.clone()
    (field.encoding.table.square().sum()).backward()  # a penalty on the whole table, by torch
    field.zero_grad()
    field.sdf(p).sum().backward()
    torch.testing.assert_close(field.encoding.table.grad, once)


@COMPILED
def test_autograd_grad_returns_the_tables_gradient_and_leaves_grad_alone(backend: str) -> None:
    compiled, plain, p = make_field(backend), make_field("torch"), points_around(100).float()
    results = []
    for field in (compiled, plain):
        results.append(torch.autograd.grad(field.sdf(p).sum(), list(field.parameters())))
        assert all(x.grad is None for x in field.parameters())
    for a, b in zip(*results, strict=True):
        assert relative(a, b) < 1e-5
    q = p.clone().requires_grad_()
    (by_points,) = torch.autograd.grad(compiled.sdf(q).sum(), q)  # of points alone: no parameter is touched
    assert bool(by_points.any()) and all(x.grad is None for x in compiled.parameters())


def test_the_mlp_learns_with_a_frozen_table_and_vice_versa() -> None:
    p = points_around(100).float()
    for frozen in ("encoding", "mlp"):
        field = make_field("numba")
        for parameter in getattr(field, frozen).parameters():
            parameter.requires_grad_(False)
        field.sdf_and_gradient(p)[1].square().sum().backward()
        field.sdf(p).sum().backward()
        for name, parameter in field.named_parameters():
            assert (parameter.grad is None) == name.startswith(frozen)


def test_a_parameter_changed_between_forward_and_backward_is_detected() -> None:
    field, p = make_field("numba"), points_around(10).float()
    f = field.sdf(p).sum()
    with torch.no_grad():
        field.last.weight.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        f.backward()


def test_state_dict_and_copies_carry_the_whole_field() -> None:
    field, p = make_field("numba"), points_around(50).float()
    field.encoding.set_level_weights(WEIGHTS)
    field.sdf(p).sum().backward()
    other = make_field("torch", seed=5)
    other.load_state_dict(field.state_dict())
    torch.testing.assert_close(other.sdf(p), field.sdf(p), atol=1e-6, rtol=1e-5)
    assert torch.equal(copy.deepcopy(field).sdf(p), field.sdf(p))


@pytest.mark.parametrize("backend", ["torch", "numba", "triton"])
def test_mixed_precision_does_not_affect_the_field(backend: str) -> None:
    field, p = make_field(backend), points_around(50).float()
    exact = field.sdf(p)
    with torch.autocast("cpu", torch.bfloat16):
        mixed, gradient = field.sdf_and_gradient(p)
    torch.testing.assert_close(mixed, exact)
    gradient.square().sum().backward()
    assert field.encoding.table.grad is not None and field.encoding.table.grad.dtype == torch.float32


def test_numba_is_rejected_by_name_and_replaced_by_auto_if_it_does_not_support_a_field() -> None:
    p = points_around(10)
    with pytest.raises(UserError, match=r"computes in float32.*choose the backend auto or torch"):
        make_field("numba", torch.float64).sdf(p)
    assert make_field("auto", torch.float64).sdf(p).dtype == torch.float64
    assert torch.equal(make_field("auto").sdf(p.float()), make_field("numba").sdf(p.float()))


class PlaneField(SDFField):
    """An analytic field, linear in the point, that counts the points at which it is evaluated."""

    def __init__(self, normal: tuple[float, float, float], offset: float) -> None:
        nn.Module.__init__(self)
        self.normal, self.offset, self.evaluated = torch.tensor(normal), offset, 0

    def sdf(self, p: Tensor) -> Tensor:
        self.evaluated += len(p)
        return p @ self.normal - self.offset


def test_a_plane_is_reproduced_exactly_in_the_whole_box():
    cache, field = CachedGrid(12), PlaneField((0.48, 0.6, 0.64), 0.1)
    cache.refresh(field)
    p = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    p = torch.cat([p, torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, -1.0], [0.0, 0.0, 0.0]])])
    assert torch.allclose(cache.look_up(p), p @ field.normal - 0.1, atol=2e-6)  # each axis has its own slope
    beyond = (3 * p).clamp(-1, 1) @ field.normal - 0.1  # as at the border
    assert torch.allclose(cache.look_up(3 * p), beyond, atol=2e-6)
    assert field.evaluated == 12**3 and cache.cell == 2 / 11


def test_later_only_the_neighbourhood_of_the_surface_is_updated_also_after_a_checkpoint():
    """So a resumed run has the same values as an uninterrupted one."""
    cache, resumed = CachedGrid(20), CachedGrid(20)
    cache.refresh(PlaneField((0.0, 0.0, 1.0), 0.0))
    resumed.load_state_dict(cache.state_dict())
    z = torch.linspace(-1, 1, 20)
    near = z.abs() < 3 * cache.cell
    for one in (cache, resumed):
        after = PlaneField((0.0, 0.0, 1.0), 0.05)
        one.refresh(after)
        assert torch.allclose(one.values[near][:, 0, 0], z[near] - 0.05, atol=1e-6)
        assert torch.allclose(one.values[~near][:, 0, 0], z[~near], atol=1e-6)
        assert after.evaluated == int(near.sum()) * 400
    assert torch.equal(resumed.values, cache.values)
