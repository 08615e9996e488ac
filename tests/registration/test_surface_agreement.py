"""The compiled sums of points against surfaces, against a plain formula and against differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.geometry.rays import pixel_centres
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
from sl_nerfstudio.registration.pairs.surface_agreement import Side, agreement, agreement_at
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.surface_map import SurfaceMap, build_surface_map
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, similarities_of

SIZE = 100
RIG = rig_of(18, SIZE)
TRUE = similarities_of(RIG.T_world_camera.numpy(), RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy())
PENALTY = REGISTRATION_DEFAULTS.pair.agreement.behind_penalty
CAMERAS = {
    "pinhole": Device(40, 30, 50.0, 52.0, 19.0, 16.0),
    "lens": Device(40, 30, 50.0, 52.0, 19.0, 16.0, k1=-0.3, k2=0.1, p1=5e-3, p2=-8e-3),
    "DOE with a lens": Device(40, 30, 50.0, 52.0, 19.0, 16.0, k1=0.2, k2=-0.05, p1=-4e-3, p2=6e-3, model="DOE"),
}


@pytest.fixture(scope="module")
def maps():
    return [build_surface_map(c) for c in clouds_of(RIG, SIZE, noise=0.1)[:2]]


def between(i: int, j: int) -> Similarity:
    return TRUE[j].inverse() @ TRUE[i]


def stacked(*similarities: Similarity) -> Hypotheses:
    return Hypotheses(*(np.stack([getattr(S, key) for S in similarities]) for key in ("scale", "R", "t")))


# ------------------------------------------------------------------ against a plain formula


def bumpy_map(camera: Device, seed: int) -> SurfaceMap:
    """Depths and normals that vary from pixel to pixel, with holes: any map will do for sums over it."""
    rng = np.random.default_rng(seed)
    ray = unproject(Intrinsics.of(camera, torch.float64), pixel_centres(camera, torch.float64)).numpy()
    point = ray * (3 + 0.1 * rng.standard_normal((*ray.shape[:2], 1)))
    normal = -ray + 0.5 * rng.standard_normal(ray.shape)
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    valid = rng.random(ray.shape[:2]) < 0.8
    centroid = point[valid].mean(0)
    radius = float(np.sqrt(((point[valid] - centroid) ** 2).sum(-1).mean()))
    return SurfaceMap(camera, point, normal, valid, centroid, centroid, radius)


def plain_sums(source: Side, target: Side, S: Similarity, tolerance: float, width: float, facing_least: float):
    """H, g and the shares and mean square of one similarity, point by point as the module's text says."""
    limits = REGISTRATION_DEFAULTS.pair.agreement
    tau, kernel, hidden = (x * target.map.radius for x in (tolerance, width, limits.hidden_depth))
    H, g, shares, squares = np.zeros((7, 7)), np.zeros(7), [], []
    for mover, seen, reverse in ((source, target, False), (target, source, True)):
        own = S.inverse() if reverse else S
        p, n = own.points(mover.points), mover.normals @ own.R.T
        uv, front = project(Intrinsics.of(seen.map.camera, torch.float64), torch.from_numpy(p))
        column, row = np.floor(uv.numpy()).astype(int).T
        height, width_px = seen.map.valid.shape
        inside = front.numpy() & (column >= 0) & (row >= 0) & (column < width_px) & (row < height)
        inside &= (n * p).sum(-1) <= 0
        inside[inside] &= seen.map.valid[row[inside], column[inside]]
        P, N = seen.map.point[row[inside], column[inside]], seen.map.normal[row[inside], column[inside]]
        r = (N * (p[inside] - P)).sum(-1) * (S.scale if reverse else 1)
        facing = (N * n[inside]).sum(-1)
        on = (np.abs(r) < tau) & (facing > facing_least)
        before = ~on & (r > tau)
        behind = ~on & ~before & (r > -hidden)
        shares.append([x.sum() / len(mover.points) for x in (on, before, behind)])
        squares += (r[on] ** 2).tolist()
        used = (facing >= facing_least) & (np.abs(r) <= limits.kernel_cutoff * kernel)
        w = facing[used] / (1 + (r[used] / kernel) ** 2) ** 2
        m = -N[used] @ S.R.T if reverse else N[used]
        x = (mover.points if reverse else p)[inside][used] - target.map.centroid
        J = np.concatenate([m, np.cross(x, m), (x * m).sum(-1, keepdims=True)], 1)
        H += (J * w[:, None]).T @ J
        g += J.T @ (w * r[used])
    return H, g, np.mean(shares, 0), float(np.mean(squares))


@pytest.mark.parametrize("name", sorted(CAMERAS))
@pytest.mark.parametrize("seed", range(3))
def test_the_compiled_sums_are_those_of_the_plain_formula(name, seed):
    rng = np.random.default_rng(seed)
    sides = [Side.sampled(bumpy_map(camera, seed + 10 * k), 600, rng)
             for k, camera in enumerate((CAMERAS[name], CAMERAS["lens"]))]  # fmt: skip
    similarities = [
        Similarity(
            float(np.exp(rng.normal(0, 0.05))),
            Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix(),
            rng.normal(0, 0.1, 3),
        )
        for _ in range(4)
    ]
    limits = replace(REGISTRATION_DEFAULTS.pair.agreement, least_facing_cosine=0.5)
    found = agreement(*sides, stacked(*similarities), 0.05, 0.08, limits)
    for k, S in enumerate(similarities):
        H, g, shares, squares = plain_sums(*sides, S, 0.05, 0.08, 0.5)
        assert shares.min() > 0.02  # every case is present
        np.testing.assert_allclose(found.H[k], H, rtol=1e-9, atol=1e-9 * np.abs(H).max())
        np.testing.assert_allclose(found.g[k], g, rtol=1e-9, atol=1e-9 * np.abs(g).max())
        np.testing.assert_allclose([found.agreeing[k], found.in_front[k], found.behind[k]], shares, rtol=1e-12)
        assert found.squares[k] == pytest.approx(squares, rel=1e-9)
        assert found.judged[k] == pytest.approx(shares.sum())
        assert found.fitness[k] == pytest.approx(shares[0] / shares.sum())
        assert found.score(0.25)[k] == pytest.approx(shares[0] - shares[1] - 0.25 * shares[2])


# ------------------------------------------------------------------ on surfaces


def test_derivatives_of_the_agreement_are_those_of_differences(maps):
    """g is half the derivative of the sum of squared distances where the kernel is wide and nothing is cut off."""
    rng = np.random.default_rng(0)
    sides = [Side.sampled(m, 300, rng) for m in maps]
    S = between(0, 1)
    c, wide = maps[1].centroid, 1e3

    def moved(x: ndarray) -> Similarity:
        turn = Rotation.from_rotvec(x[3:6]).as_matrix()
        return Similarity(float(np.exp(x[6])), turn, c - np.exp(x[6]) * turn @ c + x[:3]) @ S

    # sums of r itself along each unknown: H[:, k] = sum w J J_k is the change of g with a step along k
    at_S = agreement(*sides, Hypotheses.of(S), 0.5, wide)
    H, h = at_S.H[0], 1e-5
    for k in range(7):
        ahead, behind = (moved(s * h * np.eye(7)[k]) for s in (1, -1))
        g_a, g_b = agreement(*sides, stacked(ahead, behind), 0.5, wide).g
        # points that change their pixel make single jumps, so only the whole vectors are compared
        assert (g_a - g_b) @ H[:, k] / (2 * h) == pytest.approx(H[:, k] @ H[:, k], rel=0.25)
    assert np.isfinite(at_S.g).all()


def test_the_truth_agrees_and_a_displaced_surface_is_seen_in_front(maps):
    rng = np.random.default_rng(0)
    sides = [Side.sampled(m, 500, rng) for m in maps]
    S = between(0, 1)
    nearer = Similarity(S.scale, S.R, S.t + np.array([0.0, 0.0, 0.6 * maps[1].radius]))
    found = agreement(*sides, stacked(S, nearer), 0.04, 0.04)
    assert found.fitness[0] > 0.9
    assert found.agreeing[0] > 0.4
    score = found.score(PENALTY)
    assert score[0] > 3 * max(score[1], 0.1)
    assert found.in_front[1] > 0.2


def test_a_surface_moved_back_is_behind_until_it_is_hidden(maps):
    """A little behind it contradicts; farther than the hidden depth it says nothing."""
    rng = np.random.default_rng(0)
    sides = [Side.sampled(m, 500, rng) for m in maps]
    S, radius = between(0, 1), maps[1].radius
    a_little, far = (Similarity(S.scale, S.R, S.t - np.array([0, 0, d * radius])) for d in (0.15, 3.0))
    found = agreement(*sides, stacked(S, a_little, far), 0.04, 0.04)
    assert found.behind[1] > found.behind[0] + 0.1
    assert found.agreeing[2] < 0.02


def test_agreement_of_one_similarity(maps):
    found = agreement_at((maps[0], maps[1]), between(0, 1), np.random.default_rng(0), 0.04, REGISTRATION_DEFAULTS.pair)
    assert len(found.agreeing) == 1
    assert found.fitness[0] > 0.9
