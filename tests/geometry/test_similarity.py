import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy import ndarray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity, fit_similarity

seeds = st.integers(0, 2**31 - 1)


def similarity(random: np.random.Generator, scale: float | None = None) -> Similarity:
    R = Rotation.from_rotvec(random.normal(size=3)).as_matrix()
    return Similarity(float(random.uniform(0.01, 100)) if scale is None else scale, R, random.normal(size=3) * 10)


@given(seeds)
def test_group_laws(seed: int) -> None:
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


def test_weight_zero_is_as_if_absent() -> None:
    random = np.random.default_rng(7)
    source = random.normal(size=(10, 3))
    S = similarity(random)
    target = S.points(source)
    target[3] += 100
    weights = np.ones(10)
    weights[3] = 0
    found = fit_similarity(source, target, weights=weights)
    assert found.scale == pytest.approx(S.scale, rel=1e-9)


def test_too_few_pairs() -> None:
    with pytest.raises(ValueError, match="needs at least 3 pairs of points"):
        fit_similarity(np.ones((2, 3)), np.ones((2, 3)))
