"""SE(3) against matrix exponentials and scipy, Sim(3) and its fit against scipy, and the container of device poses."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy import ndarray
from random_geometry import BATCHES, angles, batches, directions, generator, motions, seeds, twists
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from torch import Tensor

from sl_nerfstudio.geometry.lie import (
    DevicePoses,
    Similarity,
    adjoint,
    angle_deg,
    departures,
    exp_se3,
    exp_so3,
    fit_similarity,
    inverse,
    inverse_poses,
    log_se3,
    log_so3,
    moved_poses,
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
def test_log_undoes_exp(seed: int, batch: tuple[int, ...], angle: float) -> None:
    xi = twists(batch, angle, generator(seed))
    assert close(log_so3(exp_so3(xi[..., 3:])), xi[..., 3:], 1e-11)
    assert close(log_se3(exp_se3(xi)), xi, 1e-10)


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


@pytest.mark.parametrize("batch", BATCHES)
def test_one_pose_moves_many_points(batch: tuple[int, ...]) -> None:
    source = generator(5)
    T = motions((), source)
    p = torch.randn(7, *batch, 3, generator=source, dtype=torch.float64)
    assert close(transform(T, p), p @ T[:3, :3].T + T[:3, 3], 1e-14)
    R, t = T[:3, :3], T[:3, 3]
    assert torch.equal(pose(R, t), T)


@pytest.mark.parametrize("angle", SPECIAL)
def test_first_and_second_derivatives_of_exp(angle: float) -> None:
    xi = twists((2,), angle, generator(2)).requires_grad_()
    assert torch.autograd.gradcheck(exp_se3, xi, eps=1e-6, atol=1e-8)
    w = xi.detach()[..., 3:].clone().requires_grad_()
    assert torch.autograd.gradcheck(exp_so3, w, eps=1e-6, atol=1e-8)
    assert torch.autograd.gradgradcheck(exp_se3, xi.detach()[0].requires_grad_(), eps=1e-6, atol=1e-6)


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


@given(seeds, batches, angles)
def test_the_adjoint_moves_a_twist_to_other_axes(seed: int, batch: tuple[int, ...], angle: float) -> None:
    g = generator(seed)
    T, xi = motions(batch, g), twists(batch, angle, g)
    moved = torch.matrix_exp(twist_matrix((adjoint(T) @ xi[..., None]).squeeze(-1)))
    assert close(moved, T @ torch.matrix_exp(twist_matrix(xi)) @ torch.linalg.inv(T), 1e-9)


def similarity(random: np.random.Generator, scale: float | None = None) -> Similarity:
    R = Rotation.from_rotvec(random.normal(size=3)).as_matrix()
    return Similarity(float(random.uniform(0.01, 100)) if scale is None else scale, R, random.normal(size=3) * 10)


@given(seeds)
def test_group_laws_of_similarities(seed: int) -> None:
    random = np.random.default_rng(seed)
    a, b = similarity(random), similarity(random)
    p = random.normal(size=(3, 1, 2, 3))
    size = a.scale * b.scale + 100 * a.scale + 100
    assert np.allclose((a @ b).points(p), a.points(b.points(p)), atol=1e-12 * size)
    assert np.allclose(a.inverse().points(a.points(p)), p, atol=1e-10)
    assert np.allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-12 * size)
    assert np.allclose(a.inverse().matrix(), np.linalg.inv(a.matrix()), atol=1e-8)
    assert np.array_equal(Similarity.identity().points(p), p)
    homogeneous = np.concatenate([p, np.ones((*p.shape[:-1], 1))], -1)
    assert np.allclose((a.matrix() @ homogeneous[..., None])[..., :3, 0], a.points(p), atol=1e-12 * size)


@given(seeds)
def test_poses_stay_rigid_and_carry_their_points_along(seed: int) -> None:
    random = np.random.default_rng(seed)
    S = similarity(random)
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, :3] = Rotation.random(4, random_state=seed % 1000).as_matrix()
    T[:, :3, 3] = random.normal(size=(4, 3))
    moved = S.poses(T)
    assert np.allclose(np.linalg.det(moved[:, :3, :3]), 1)
    assert np.array_equal(moved[:, 3], T[:, 3])
    p_device = random.normal(size=(4, 3))
    p = np.einsum("nij,nj->ni", T[:, :3, :3], p_device) + T[:, :3, 3]
    in_moved = np.einsum("nij,nj->ni", moved[:, :3, :3], S.scale * p_device) + moved[:, :3, 3]
    assert np.allclose(in_moved, S.points(p), atol=1e-10 * (1 + S.scale))


@given(seeds, st.integers(3, 30))
def test_exact_points_give_the_exact_map(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    S = similarity(random)
    source = random.normal(size=(count, 3))
    found = fit_similarity(source, S.points(source))
    assert found.scale == pytest.approx(S.scale, rel=1e-9)
    assert np.allclose(found.R, S.R, atol=1e-7)
    assert np.allclose(found.points(source), S.points(source), atol=1e-8 * S.scale)
    rigid = similarity(random, scale=1.0)
    found = fit_similarity(source, rigid.points(source), with_scale=False)
    assert found.scale == 1
    assert np.allclose(found.points(source), rigid.points(source), atol=1e-8)


@given(seeds)
def test_rotation_is_scipy_s(seed: int) -> None:
    random = np.random.default_rng(seed)
    source = random.normal(size=(20, 3))
    S = similarity(random, 1.0)
    target = S.points(source) + 0.1 * random.normal(size=(20, 3))
    weights = random.uniform(0.1, 1, 20)
    found = fit_similarity(source, target, with_scale=False, weights=weights)
    share = weights / weights.sum()
    expected, _ = Rotation.align_vectors(target - share @ target, source - share @ source, weights=weights)
    assert np.allclose(found.R, expected.as_matrix(), atol=1e-10)


def test_noisy_fit_with_scale_is_the_least_squares_one() -> None:
    random = np.random.default_rng(5)
    source = random.normal(size=(15, 3))
    target = similarity(random, 2.5).points(source) + 0.2 * random.normal(size=(15, 3))
    weights = random.uniform(0.1, 1, 15)
    found = fit_similarity(source, target, weights=weights)

    def cost(x: ndarray) -> float:
        S = Similarity(float(np.exp(x[6])), Rotation.from_rotvec(x[:3]).as_matrix(), x[3:6])
        return float((weights * ((S.points(source) - target) ** 2).sum(1)).sum())

    start = np.concatenate([Rotation.from_matrix(found.R).as_rotvec(), found.t, [np.log(found.scale)]])
    best = minimize(cost, start + 0.02 * random.normal(size=7), method="BFGS", options={"gtol": 1e-10})
    assert cost(start) <= best.fun * (1 + 1e-9)
    assert np.allclose(best.x, start, atol=1e-5)


def test_mirrored_points_are_not_mirrored() -> None:
    source = np.random.default_rng(6).normal(size=(10, 3))
    found = fit_similarity(source, source * np.array([1.0, 1, -1]))
    assert np.linalg.det(found.R) == pytest.approx(1)
    flat = source * np.array([1.0, 1, 0])
    found = fit_similarity(flat, flat)
    assert np.linalg.det(found.R) == pytest.approx(1)
    assert np.allclose(found.points(flat), flat, atol=1e-12)


def test_too_few_pairs() -> None:
    with pytest.raises(ValueError, match="needs at least 3 pairs of points"):
        fit_similarity(np.ones((2, 3)), np.ones((2, 3)))


# The container of all poses: what its operations mean, for any rigid motions.


def poses_of(seed: int, count: int = 5) -> DevicePoses:
    source = generator(seed)
    return DevicePoses(motions((count,), source).numpy(), motions((count,), source, 2.0).numpy())


def similarity_of(seed: int, scale: float) -> Similarity:
    T = motions((), generator(seed), 1.5).numpy()
    return Similarity(scale, T[:3, :3], T[:3, 3])


scales = st.floats(0.01, 100.0)


@given(seeds)
def test_relative_poses_lead_from_each_camera_to_its_projector(seed):
    poses = poses_of(seed)
    assert len(poses) == 5
    np.testing.assert_allclose(poses.T_world_camera @ poses.T_camera_projector, poses.T_world_projector, atol=1e-12)
    np.testing.assert_allclose(poses.baseline, np.linalg.norm(poses.T_camera_projector[:, :3, 3], axis=1), atol=1e-12)
    assert np.array_equal(poses.stacked(), np.concatenate([poses.T_world_camera, poses.T_world_projector]))


@given(seeds, seeds, scales)
def test_another_world_scales_lengths_and_leaves_relative_orientations(seed, other, scale):
    poses, S = poses_of(seed), similarity_of(other, scale)
    mapped = poses.mapped(S)
    np.testing.assert_allclose(mapped.baseline, scale * poses.baseline, rtol=1e-9)
    np.testing.assert_allclose(mapped.T_camera_projector[:, :3, :3], poses.T_camera_projector[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(mapped.stacked()[:, :3, 3], S.points(poses.stacked()[:, :3, 3]), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(mapped.mapped(S.inverse()).stacked(), poses.stacked(), atol=1e-9)
    poses.T_world_camera[2] = np.nan  # a frame without poses
    assert np.isnan(poses.mapped(S).baseline).tolist() == [False, False, True, False, False]
    some = poses[[3, 1]]
    assert np.array_equal(some.stacked(), poses.stacked()[[3, 1, 8, 6]])


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1), st.floats(0, 180))
def test_the_angle_of_a_rotation_is_that_of_its_vector_however_small(axis, deg):
    vector = np.radians(deg) * np.array(axis) / np.linalg.norm(axis)
    assert angle_deg(Rotation.from_rotvec(vector).as_matrix()) == pytest.approx(deg, abs=1e-9)


# Compiled increments of poses.

ANGLES = [0.0, 1e-12, 1e-8, 1e-5, 1e-2, 0.2999, 0.3, 0.3001, 1.0, 2.0, 3.0, np.pi - 1e-3, np.pi - 1e-7]
AXES = [(1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (1.0, -2.0, 0.5), (-0.3, 0.4, 5.0)]


def twist_of(shift, axis, angle: float) -> np.ndarray:
    return np.concatenate([shift, angle * np.array(axis) / np.linalg.norm(axis)])


def some_poses(n: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.random(n, random_state=seed).as_matrix(), random.normal(size=(n, 3))
    return T


@pytest.mark.parametrize("angle", ANGLES)
def test_increments_are_matrix_exponentials_and_departures_take_them_back(angle):
    twists = np.stack([twist_of((0.3, -0.8, 2.0), axis, angle) for axis in AXES])
    T, relative = some_poses(len(AXES), 1), some_poses(len(AXES), 2)
    moved, turned = np.empty_like(T), np.empty_like(T)
    moved_poses(len(T), T, twists, moved)
    for k, twist in enumerate(twists):
        assert np.allclose(
            moved[k], torch.matrix_exp(twist_matrix(torch.from_numpy(twist))).numpy() @ T[k], rtol=0, atol=1e-14
        )
    moved_poses(len(T), relative, twists, turned)
    found = np.empty((len(T), 12))
    departures(len(T), T, moved, relative, turned, found)
    # beside pi the logarithm of the shift is as ill-conditioned as a tangent
    assert np.allclose(found[:, :6], twists, rtol=0, atol=1e-13 if angle < 3.1 else 1e-6)
    assert np.allclose(found[:, 6:9], turned[:, :3, 3] - relative[:, :3, 3], rtol=0, atol=1e-15)
    assert np.allclose(found[:, 9:], twists[:, 3:], rtol=0, atol=1e-13)


@given(st.integers(0, 10**6), st.integers(1, 5))
def test_departures_and_increments_are_each_others_inverse(seed, n):
    then, now, first, second = (some_poses(n, seed + k) for k in range(4))
    found, back = np.empty((n, 12)), np.empty_like(then)
    departures(n, then, now, first, second, found)
    moved_poses(n, then, np.ascontiguousarray(found[:, :6]), back)
    assert np.allclose(back, now, rtol=0, atol=1e-11)
    inverse_poses(n, then, back)
    assert np.allclose(back, np.linalg.inv(then), rtol=0, atol=1e-13)
    between = second[:, :3, :3] @ first[:, :3, :3].transpose(0, 2, 1)
    assert np.allclose(Rotation.from_rotvec(found[:, 9:]).as_matrix(), between, rtol=0, atol=1e-13)
