import math

import numpy as np
import pytest
import torch
from hypothesis import given
from random_geometry import BATCHES, angles, batches, directions, generator, motions, seeds, twists
from scipy.spatial.transform import Rotation
from torch import Tensor

from sl_nerfstudio.geometry.lie import (
    adjoint,
    exp_se3,
    exp_so3,
    hat,
    inverse,
    log_se3,
    log_so3,
    pose,
    rotate,
    transform,
)

SPECIAL = [0.0, 1e-12, 1e-7, 1e-5, 1e-3, 0.29999, 0.3, 0.30001, 1.0, 3.0]


def twist_matrix(xi: Tensor) -> Tensor:
    """The element of the Lie algebra, (*batch, 4, 4)."""
    out = torch.zeros(*xi.shape[:-1], 4, 4, dtype=xi.dtype)
    for column, axis in enumerate(torch.eye(3, dtype=xi.dtype)):
        out[..., :3, column] = torch.linalg.cross(xi[..., 3:], axis.expand_as(xi[..., 3:]))
    out[..., :3, 3] = xi[..., :3]
    return out


def close(a: Tensor, b: Tensor, tolerance: float = 1e-12) -> bool:
    return a.shape == b.shape and bool(((a - b).abs() <= tolerance).all())


@given(seeds, batches, angles)
def test_exp_is_the_matrix_exponential(seed: int, batch: tuple[int, ...], angle: float) -> None:
    xi = twists(batch, angle, generator(seed))
    assert close(exp_se3(xi), torch.matrix_exp(twist_matrix(xi)))
    assert close(exp_se3(xi)[..., :3, :3], exp_so3(xi[..., 3:]), 1e-15)


@given(seeds, batches, angles)
def test_rotations_agree_with_scipy(seed: int, batch: tuple[int, ...], angle: float) -> None:
    w = angle * directions(batch, generator(seed))
    expected = Rotation.from_rotvec(w.reshape(-1, 3).numpy())
    R = exp_so3(w)
    assert np.abs(R.reshape(-1, 3, 3).numpy() - expected.as_matrix()).max() < 1e-14
    if angle < 3.1:
        scipys = torch.from_numpy(Rotation.from_matrix(R.reshape(-1, 3, 3).numpy()).as_rotvec()).reshape(w.shape)
        assert close(log_so3(R), scipys, 1e-12)


@given(seeds, batches, angles)
def test_log_undoes_exp(seed: int, batch: tuple[int, ...], angle: float) -> None:
    xi = twists(batch, angle, generator(seed))
    assert close(log_so3(exp_so3(xi[..., 3:])), xi[..., 3:], 1e-11)
    assert close(log_se3(exp_se3(xi)), xi, 1e-10)


@given(seeds, batches, angles)
def test_exp_undoes_log(seed: int, batch: tuple[int, ...], angle: float) -> None:
    T = motions(batch, generator(seed), angle)
    assert close(exp_se3(log_se3(T)), T, 1e-12)


@pytest.mark.parametrize("size", [1e-3, 1e-6, 1e-9, 1e-12, 1e-15, 1e-20])
def test_small_angles_keep_all_their_digits(size: float) -> None:
    w = size * directions((50,), generator(0))
    assert bool(((log_so3(exp_so3(w)) - w).abs() <= 1e-12 * size + 1e-16 * size).all())


@pytest.mark.parametrize("below", [1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 0.0])
def test_angles_near_pi(below: float) -> None:
    w = (math.pi - below) * directions((50,), generator(1))
    found = log_so3(exp_so3(w))
    # At pi itself both signs of the axis are right.
    nearer = torch.minimum((found - w).norm(dim=-1), (found + w).norm(dim=-1) + (0 if below < 1e-9 else 1e3))
    assert float(nearer.max()) < 1e-8
    assert bool((found.norm(dim=-1) <= math.pi + 1e-12).all())


@given(seeds, batches, angles)
def test_group_laws(seed: int, batch: tuple[int, ...], angle: float) -> None:
    source = generator(seed)
    a, b = motions(batch, source, angle), motions(batch, source)
    p = torch.randn(*batch, 3, generator=source, dtype=torch.float64)
    eye = torch.eye(4, dtype=torch.float64).expand(*batch, 4, 4)
    assert close(a @ inverse(a), eye)
    assert close(inverse(a) @ a, eye)
    assert close(inverse(a @ b), inverse(b) @ inverse(a))
    assert close(transform(a @ b, p), transform(a, transform(b, p)), 1e-11)
    assert close(transform(inverse(a), transform(a, p)), p, 1e-11)
    assert close(rotate(a, p), transform(a, p) - a[..., :3, 3], 1e-11)
    homogeneous = torch.cat([p, torch.ones_like(p[..., :1])], -1)
    assert close(transform(a, p), (a @ homogeneous[..., None])[..., :3, 0])
    assert close(log_se3(inverse(a)), -log_se3(a), 1e-10)


@given(seeds, angles)
def test_adjoint(seed: int, angle: float) -> None:
    """T exp(xi) T^-1 = exp(Ad_T xi), with the adjoint of (v, w) twists written out."""
    source = generator(seed)
    T, xi = motions((), source), twists((), angle, source)
    v, w = xi[:3], xi[3:]
    R, t = T[:3, :3], T[:3, 3]
    adjoint = torch.cat([R @ v + torch.linalg.cross(t, R @ w), R @ w])
    assert close(T @ exp_se3(xi) @ inverse(T), exp_se3(adjoint), 1e-11)


@given(seeds, batches)
def test_hat_is_the_cross_product(seed: int, batch: tuple[int, ...]) -> None:
    source = generator(seed)
    a, b = directions(batch, source), directions(batch, source)
    assert close((hat(a) @ b[..., None]).squeeze(-1), torch.linalg.cross(a, b), 1e-15)
    assert close(hat(a), -hat(a).transpose(-1, -2), 0.0)


def test_first_three_numbers_are_the_translation() -> None:
    xi = torch.tensor([1.0, 2, 3, 0, 0, 0], dtype=torch.float64)
    assert exp_se3(xi)[:3, 3].tolist() == [1, 2, 3]
    turn = exp_se3(torch.tensor([0, 0, 0, 0, 0, math.pi / 2], dtype=torch.float64))
    assert close(
        transform(turn, torch.tensor([1.0, 0, 0], dtype=torch.float64)), torch.tensor([0, 1.0, 0]).double(), 1e-15
    )


@pytest.mark.parametrize("batch", BATCHES)
def test_one_pose_moves_many_points(batch: tuple[int, ...]) -> None:
    source = generator(5)
    T = motions((), source)
    p = torch.randn(7, *batch, 3, generator=source, dtype=torch.float64)
    assert close(transform(T, p), p @ T[:3, :3].T + T[:3, 3], 1e-14)
    R, t = T[:3, :3], T[:3, 3]
    assert torch.equal(pose(R, t), T)


@pytest.mark.parametrize("angle", SPECIAL)
def test_gradients_of_exp(angle: float) -> None:
    xi = twists((2,), angle, generator(2)).requires_grad_()
    assert torch.autograd.gradcheck(exp_se3, xi, eps=1e-6, atol=1e-8)
    w = xi.detach()[..., 3:].clone().requires_grad_()
    assert torch.autograd.gradcheck(exp_so3, w, eps=1e-6, atol=1e-8)


@pytest.mark.parametrize("angle", SPECIAL)
def test_second_derivatives_of_exp(angle: float) -> None:
    xi = twists((), angle, generator(3)).requires_grad_()
    assert torch.autograd.gradgradcheck(exp_se3, xi, eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("angle", SPECIAL)
def test_gradients_of_log(angle: float) -> None:
    """Along the group: the derivative of log(exp(xi)) is the identity, that of log(T exp(d)) is checked numerically."""
    xi = twists((), angle, generator(4))
    jacobian = torch.autograd.functional.jacobian(lambda x: log_se3(exp_se3(x)), xi)
    assert close(jacobian, torch.eye(6, dtype=torch.float64), 1e-8)
    T = exp_se3(xi)
    zero = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: log_se3(T @ exp_se3(d)), zero, eps=1e-6, atol=1e-7)


def test_float32_is_as_good_as_float32_can_be() -> None:
    for angle in (1e-6, 1e-4, 1e-3, 1e-2, 0.1, 0.29, 0.31, 1.0, 3.0):
        xi = twists((100,), angle, generator(6))
        assert float((exp_se3(xi.float()).double() - exp_se3(xi)).abs().max()) < 2e-6
        exact = torch.autograd.functional.jacobian(lambda x: exp_se3(x).sum(0), xi[:3])
        single = torch.autograd.functional.jacobian(lambda x: exp_se3(x).sum(0), xi[:3].float())
        assert float((single.double() - exact).abs().max()) < 2e-5, angle


def test_zero_twist_has_an_exact_gradient() -> None:
    xi = torch.zeros(6, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(exp_se3, xi)
    for index in range(6):
        assert torch.equal(jacobian[..., index], twist_matrix(torch.eye(6, dtype=torch.float64)[index]))


@given(seeds, batches, angles)
def test_the_adjoint_moves_a_twist_to_other_axes(seed: int, batch: tuple[int, ...], angle: float) -> None:
    g = generator(seed)
    T, xi = motions(batch, g), twists(batch, angle, g)
    moved = torch.matrix_exp(twist_matrix((adjoint(T) @ xi[..., None]).squeeze(-1)))
    assert close(moved, T @ torch.matrix_exp(twist_matrix(xi)) @ torch.linalg.inv(T), 1e-9)
