"""The field: both implementations against torch's own derivatives, and its behaviour as a distance."""

import copy
from typing import Any

import pytest
import torch
from torch import Tensor

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.field.backend import TableGradient
from sl_nerfstudio.field.field import FieldConfig, SDFField
from sl_nerfstudio.field.torch_backend import knee
from tests.field.fields import make_field, plain_sdf, points_around, relative

CASES = [("torch", torch.float64, 1e-12), ("torch", torch.float32, 1e-5), ("numba", torch.float32, 1e-5)]
CASES += [("warp", torch.float32, 1e-5)]
OPTIONS = [{}, {"smooth": True}, {"hidden_layers": 1, "hidden": 40}, {"hidden_layers": 3}]
WEIGHTS = torch.tensor([1.0, 0.5, 0.0, 0.25])


def gradients(field: SDFField) -> list[Tensor]:
    return [torch.zeros_like(x) if x.grad is None else x.grad.clone() for x in field.parameters()]


def reference(options: dict[str, Any], p: Tensor, g: Tensor, v: Tensor | None) -> tuple[list[Tensor], list[Tensor]]:
    """Values (f, df/dp) and parameter gradients of `g f + v . grad f`, by torch's double backward in float64."""
    field = make_field("torch", torch.float64, **options)
    field.set_level_weights(WEIGHTS.double())
    p = p.clone().requires_grad_()
    f = plain_sdf(field, p)
    (n,) = torch.autograd.grad(f.sum(), p, create_graph=True)
    loss = (g * f).sum() if v is None else (g * f).sum() + (v * n).sum()
    loss.backward()
    return [f.detach(), n.detach()], gradients(field)


@pytest.mark.parametrize(("backend", "dtype", "tolerance"), CASES)
@pytest.mark.parametrize("options", OPTIONS)
def test_values_and_all_first_derivatives(
    backend: str, dtype: torch.dtype, tolerance: float, options: dict[str, Any]
) -> None:
    p, g = points_around(300), torch.randn(300).double()
    (f_true, n_true), parameters_true = reference(options, p, g, None)
    field = make_field(backend, dtype, **options)
    field.set_level_weights(WEIGHTS.to(dtype))
    q = p.to(dtype).requires_grad_()
    f = field.sdf(q)
    (f * g.to(dtype)).sum().backward()
    assert q.grad is not None
    assert relative(f, f_true) < tolerance
    assert relative(q.grad, g[:, None] * n_true) < tolerance
    for got, wanted in zip(gradients(field), parameters_true, strict=True):
        assert relative(got, wanted) < tolerance


@pytest.mark.parametrize(("backend", "dtype", "tolerance"), CASES)
@pytest.mark.parametrize("options", OPTIONS)
def test_the_gradient_trains_all_parameters_as_double_backward_does(
    backend: str, dtype: torch.dtype, tolerance: float, options: dict[str, Any]
) -> None:
    p, g, v = points_around(300), torch.randn(300).double(), torch.randn(300, 3).double()
    (f_true, n_true), parameters_true = reference(options, p, g, v)
    field = make_field(backend, dtype, **options)
    field.set_level_weights(WEIGHTS.to(dtype))
    f, n = field.sdf_and_gradient(p.to(dtype))
    ((f * g.to(dtype)).sum() + (n * v.to(dtype)).sum()).backward()
    assert relative(f, f_true) < tolerance
    assert relative(n, n_true) < tolerance
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
    field = SDFField(FieldConfig(sphere_radius=0.4))
    p = torch.rand(5000, 3) * 2 - 1
    f, n = field.sdf_and_gradient(p)
    error = (f - (p.norm(dim=-1) - 0.4)).detach()[p.norm(dim=-1) > 0.1]
    assert float(error.abs().max()) < 0.05
    assert float(error.std()) < 0.01
    direction = torch.nn.functional.cosine_similarity(n.detach(), p, dim=-1)
    assert float(direction[p.norm(dim=-1) > 0.2].min()) > 0.9


@pytest.mark.parametrize("backend", ["torch", "numba", "warp"])
def test_outside_the_box_it_grows_by_the_distance_from_it(backend: str) -> None:
    field = make_field(backend)
    on_face = torch.tensor([[1.0, 0.3, -0.2], [0.1, -1.0, 0.7], [1.0, 1.0, -1.0]])
    outward = torch.tensor([[1.0, 0, 0], [0, -1.0, 0], [3**-0.5, 3**-0.5, -(3**-0.5)]])
    near = field.sdf(on_face).detach()
    far, gradient = field.sdf_and_gradient(on_face + 2.5 * outward)
    torch.testing.assert_close(far.detach(), near + 2.5, atol=1e-5, rtol=0)
    slope = (gradient.detach() * outward).sum(-1)
    torch.testing.assert_close(slope, torch.ones(3), atol=1e-5, rtol=0)


@pytest.mark.parametrize("backend", ["torch", "numba", "warp"])
def test_nan_points_give_nan_values_and_do_not_affect_others(backend: str) -> None:
    field = make_field(backend)
    p = points_around(200).float()
    clean = field.sdf(p).detach()
    p[17, 1] = float("nan")
    f, n = field.sdf_and_gradient(p)
    assert bool(f[17].isnan()) and bool(n[17].isnan().any())
    others = torch.arange(200) != 17
    torch.testing.assert_close(f[others].detach(), clean[others])


@pytest.mark.parametrize("backend", ["torch", "numba", "warp"])
def test_without_gradients_there_is_no_buffer_for_them(backend: str) -> None:
    field, p = make_field(backend), points_around(50).float()
    with torch.inference_mode():
        f, n = field.sdf_and_gradient(p)
    assert TableGradient.known(field.encoding.table) is None
    got, normal = field.sdf_and_gradient(p)
    assert torch.equal(f, got.detach()) and torch.equal(n, normal.detach())


def test_infinite_points_do_not_crash_the_compiled_kernels() -> None:
    p = torch.tensor([[float("inf"), 0, 0], [0, float("-inf"), 1e30]])
    assert bool((make_field("numba").sdf(p) > 1e20).all())


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


def test_a_switched_off_level_gets_no_gradient_and_has_no_effect() -> None:
    field = make_field("numba")
    field.set_level_weights(torch.tensor([1.0, 1.0, 0.0, 0.0]))
    p = points_around(100).float()
    field.sdf_and_gradient(p)[1].square().sum().backward()
    layout, grad = field.encoding.layout, field.encoding.table.grad
    assert grad is not None and float(grad[: layout.offsets[2]].abs().max()) > 0
    assert float(grad[layout.offsets[2] :].abs().max()) == 0
    before = field.sdf(p).detach()
    with torch.no_grad():
        field.encoding.table[layout.offsets[2] :].normal_()
    assert torch.equal(field.sdf(p).detach(), before)


def test_backward_accumulates_and_starts_from_zero_after_zero_grad() -> None:
    field, p = make_field("numba"), points_around(100).float()

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


def test_autograd_grad_returns_the_tables_gradient_and_leaves_grad_alone() -> None:
    compiled, plain, p = make_field("numba"), make_field("torch"), points_around(100).float()
    results = []
    for field in (compiled, plain):
        results.append(torch.autograd.grad(field.sdf(p).sum(), list(field.parameters())))
        assert field.encoding.table.grad is None
    for a, b in zip(*results, strict=True):
        assert relative(a, b) < 1e-5


def test_autograd_grad_of_points_alone_touches_no_parameter() -> None:
    field, p = make_field("numba"), points_around(100).float().requires_grad_()
    (g,) = torch.autograd.grad(field.sdf(p).sum(), p)
    assert float(g.abs().max()) > 0
    assert all(x.grad is None for x in field.parameters())


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
    field.set_level_weights(WEIGHTS)
    field.sdf(p).sum().backward()
    other = make_field("torch", seed=5)
    other.load_state_dict(field.state_dict())
    torch.testing.assert_close(other.sdf(p), field.sdf(p), atol=1e-6, rtol=1e-5)
    assert torch.equal(copy.deepcopy(field).sdf(p), field.sdf(p))


def test_numba_is_rejected_by_name_and_replaced_by_auto_if_it_does_not_support_a_field() -> None:
    p = points_around(10)
    refusal = "needs 8 features per level, the field has 4; choose the backend auto or torch"
    with pytest.raises(UserError, match=refusal):
        make_field("numba", features=4).sdf(p.float())
    with pytest.raises(UserError, match="computes in float32"):
        make_field("numba", torch.float64).sdf(p)
    assert make_field("auto", features=4).sdf(p.float()).shape == (10,)
    assert make_field("auto", torch.float64).sdf(p).dtype == torch.float64


def test_auto_uses_the_compiled_kernels_on_a_cpu() -> None:
    p = points_around(10).float()
    assert torch.equal(make_field("auto").sdf(p), make_field("numba").sdf(p))


@pytest.mark.parametrize("backend", ["torch", "numba", "warp"])
def test_mixed_precision_does_not_affect_the_field(backend: str) -> None:
    field, p = make_field(backend), points_around(50).float()
    exact = field.sdf(p)
    with torch.autocast("cpu", torch.bfloat16):
        mixed, gradient = field.sdf_and_gradient(p)
    torch.testing.assert_close(mixed, exact)
    gradient.square().sum().backward()
    assert field.encoding.table.grad is not None and field.encoding.table.grad.dtype == torch.float32
