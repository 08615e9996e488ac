"""The compiled sums of points against surfaces, against a plain formula and against differences."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.geometry.triangulation import pixel_centres
from sl_nerfstudio.registration import agreement as module
from sl_nerfstudio.registration.agreement import (
    AGREEING_SIGMAS,
    BEHIND_WEIGHT,
    HIDDEN_DEPTH,
    KERNEL_CUTOFF,
    LEAST_LIT_COSINE,
    PENALTY,
    Hypotheses,
    Side,
    Tolerance,
    agreement,
    agreement_at,
)
from sl_nerfstudio.registration.surfaces import EmptyPlaces, FrameView, SurfaceMap, build_surface_map, tangent_planes
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, similarities_of
from tests.registration.shaped_clouds import rendered
from tests.relative_pose.two_views import pose_of

SIZE = 100
RIG = rig_of(18, SIZE)
TRUE = similarities_of(RIG.T_world_camera.numpy(), RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy())
NEAR = Tolerance(0.04, 0.0)
PROJECTOR = Device(30, 24, 26.0, 27.0, 15.5, 11.0, k1=0.05)
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
    return Hypotheses.of(*similarities)


# Against a plain formula.


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
    sigma = rng.uniform(0.005, 0.03, valid.shape)
    even = np.ones(int(valid.sum()))
    tone = np.full(valid.shape, np.nan, dtype=np.float32)
    plane = tangent_planes(point, normal, sigma)
    T = np.linalg.inv(pose_of((0.6, 0.1, 0.2), (0.0, 0.0, -3.0), 20.0))
    nothing = EmptyPlaces(~valid & (rng.random(valid.shape) < 0.7), PROJECTOR, T, rng.uniform(2.5, 3.5, (24, 30)))
    return SurfaceMap(
        camera, point, plane, valid, tone, nothing, even, centroid, radius, (FrameView(centroid, radius),)
    )


def plain_sums(source: Side, target: Side, S: Similarity, tolerance: Tolerance, facing_least: float):
    """H, g and the shares and mean square of one similarity, point by point as the module's text says."""
    radius = target.map.radius
    H, g, shares, squares, costs, absent = np.zeros((7, 7)), np.zeros(7), [], [], [], []
    for mover, seen, reverse in ((source, target, False), (target, source, True)):
        own = S.inverse() if reverse else S
        p, n = own.points(mover.points), mover.normals @ own.R.T
        uv, front = project(Intrinsics.of(seen.map.camera, torch.float64), torch.from_numpy(p))
        column, row = np.floor(uv.numpy()).astype(int).T
        height, width_px = seen.map.valid.shape
        inside = front.numpy() & (column >= 0) & (row >= 0) & (column < width_px) & (row < height)
        inside &= (n * p).sum(-1) <= 0
        absent.append(plain_absent(seen.map.nothing, p[inside], n[inside], row[inside], column[inside]) / len(p))
        inside[inside] &= seen.map.valid[row[inside], column[inside]]
        P, N = seen.map.point[row[inside], column[inside]], seen.map.normal[row[inside], column[inside]]
        r = (N * (p[inside] - P)).sum(-1) * (S.scale if reverse else 1)
        sigma_seen = seen.map.sigma[row[inside], column[inside]] * (S.scale if reverse else 1)
        spread = np.hypot(mover.sigma[inside] * (1 if reverse else S.scale), sigma_seen)
        tau = np.maximum(tolerance.radii * radius, tolerance.sigmas * spread)
        facing = (N * n[inside]).sum(-1)
        on = (np.abs(r) < tau) & (facing > facing_least)
        before = ~on & (r > tau)
        behind = ~on & ~before & (r > -HIDDEN_DEPTH * radius)
        shares.append([x.sum() / len(mover.points) for x in (on, before, behind)])
        squares += ((r / spread)[on] ** 2).tolist()
        x2 = ((r / tau)[on | before | behind]) ** 2
        costs += (x2 / (1 + x2)).tolist()
        used = (facing >= facing_least) & (np.abs(r) <= KERNEL_CUTOFF * tau)
        w = facing[used] / (1 + (r / tau)[used] ** 2) ** 2
        m = -N[used] @ S.R.T if reverse else N[used]
        x = (mover.points if reverse else p)[inside][used] - target.map.centroid
        J = np.concatenate([m, np.cross(x, m), (x * m).sum(-1, keepdims=True)], 1)
        H += (J * w[:, None]).T @ J
        g += J.T @ (w * r[used])
    return H, g, np.mean(shares, 0), float(np.mean(squares)), float(np.mean(costs)), float(np.mean(absent))


def plain_absent(nothing: EmptyPlaces, p: ndarray, n: ndarray, row: ndarray, column: ndarray) -> int:
    """How many of the points at empty places would be seen, and reached by the projector's light."""
    R, t = nothing.T_projector_camera[:3, :3], nothing.T_projector_camera[:3, 3]
    q, m = p @ R.T + t, n @ R.T
    towards = [-(a * b).sum(1) / np.linalg.norm(a, axis=1) for a, b in ((p, n), (q, m))]
    uv, front = project(Intrinsics.of(nothing.projector, torch.float64), torch.from_numpy(q))
    x, y = np.floor(uv.numpy()).astype(int).T
    h, w = nothing.reach.shape
    lit = front.numpy() & (x >= 0) & (y >= 0) & (x < w) & (y < h)
    lit[lit] &= np.linalg.norm(q[lit], axis=1) < nothing.reach[y[lit], x[lit]]
    return int((nothing.empty[row, column] & lit & (np.min(towards, 0) >= LEAST_LIT_COSINE)).sum())


@pytest.mark.parametrize("name", sorted(CAMERAS))
@pytest.mark.parametrize("seed", range(3))
def test_the_compiled_sums_are_those_of_the_plain_formula(name, seed, monkeypatch):
    monkeypatch.setattr(module, "LEAST_FACING_COSINE", 0.5)
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
    tolerance = Tolerance(0.03, 3.0)  # each decides at some points
    found = agreement(*sides, stacked(*similarities), tolerance)
    for k, S in enumerate(similarities):
        H, g, shares, squares, cost, absent = plain_sums(*sides, S, tolerance, 0.5)
        assert shares.min() > 0.02 and absent > 0.01  # every case is present
        np.testing.assert_allclose(found.H[k], H, rtol=1e-9, atol=1e-9 * np.abs(H).max())
        np.testing.assert_allclose(found.g[k], g, rtol=1e-9, atol=1e-9 * np.abs(g).max())
        np.testing.assert_allclose([found.agreeing[k], found.in_front[k], found.behind[k]], shares, rtol=1e-12)
        assert found.squares[k] == pytest.approx(squares, rel=1e-9)
        assert found.cost[k] == pytest.approx(cost, rel=1e-9)
        assert found.judged[k] == pytest.approx(shares.sum())
        assert found.absent[k] == pytest.approx(absent)
        assert found.fitness[k] == pytest.approx(shares[0] / (shares.sum() + absent))
        against = shares[1] + absent + BEHIND_WEIGHT * shares[2]
        assert found.score(PENALTY)[k] == pytest.approx(shares[0] - PENALTY * against)


# On surfaces.


def test_derivatives_of_the_agreement_are_those_of_differences(maps):
    """g is half the derivative of the sum of squared distances where the kernel is wide and nothing is cut off."""
    rng = np.random.default_rng(0)
    sides = [Side.sampled(m, 300, rng) for m in maps]
    S = between(0, 1)
    c, wide = maps[1].centroid, Tolerance(1e3, 0.0)

    def moved(x: ndarray) -> Similarity:
        turn = Rotation.from_rotvec(x[3:6]).as_matrix()
        return Similarity(float(np.exp(x[6])), turn, c - np.exp(x[6]) * turn @ c + x[:3]) @ S

    # sums of r itself along each unknown: H[:, k] = sum w J J_k is the change of g with a step along k
    at_S = agreement(*sides, Hypotheses.of(S), wide)
    H, h = at_S.H[0], 1e-5
    for k in range(7):
        ahead, behind = (moved(s * h * np.eye(7)[k]) for s in (1, -1))
        g_a, g_b = agreement(*sides, stacked(ahead, behind), wide).g
        # points that change their pixel make single jumps, so only the whole vectors are compared
        assert (g_a - g_b) @ H[:, k] / (2 * h) == pytest.approx(H[:, k] @ H[:, k], rel=0.25)
    assert np.isfinite(at_S.g).all()


# The tolerance.


@settings(max_examples=15)
@given(st.integers(-6, 6), st.integers(-6, 6), st.booleans())
def test_agreement_does_not_depend_on_the_unit_of_either_frame(maps, a, b, by_length):
    """Each frame's unit is its baseline, which may be short or long: powers of two, so that rounding is the same."""
    tolerance = Tolerance(0.04, 0.0) if by_length else Tolerance(0.0, 3.0)
    factors = 2.0**a, 2.0**b
    sides = [Side.sampled(m, 300, np.random.default_rng(0)) for m in maps]
    scaled = [Side.sampled(in_unit(m, f), 300, np.random.default_rng(0)) for m, f in zip(maps, factors, strict=True)]
    S = Similarity.scaling(factors[1]) @ between(0, 1) @ Similarity.scaling(1 / factors[0])
    found, again = (agreement(*pair, Hypotheses.of(T), tolerance) for pair, T in ((sides, between(0, 1)), (scaled, S)))
    for key in ("agreeing", "in_front", "behind", "squares"):
        np.testing.assert_allclose(getattr(again, key), getattr(found, key), rtol=1e-9)
    D = np.array([1.0] * 3 + [factors[1]] * 4)
    np.testing.assert_allclose(again.H[0], found.H[0] * D[:, None] * D, rtol=1e-7, atol=1e-9)


def in_unit(m: SurfaceMap, factor: float) -> SurfaceMap:
    lengths = {key: getattr(m, key) * factor for key in ("point", "centroid", "radius")}
    return replace(m, plane=tangent_planes(m.point * factor, m.normal, m.sigma * factor), **lengths)


# Empty places: a frame that looks into empty space contradicts what would fill it.

EMPTY_FRAMES = (0, 2, 6, 8)


def maps_with_empty_places(clouds) -> list[SurfaceMap]:
    """The frames with what they saw of the pattern: here, all that has coordinates."""
    return [build_surface_map(replace(cloud, seen=np.isfinite(cloud.coords).all(-1))) for cloud in clouds]


def absent_in_pairs(maps, poses, change: Similarity | None = None) -> list[float]:
    """Shares of points that are missed, of all pairs of frames; `change` of the world is done to the first of each."""
    out = []
    for i, j in permutations(range(len(maps)), 2):
        S = poses[j].inverse() @ (poses[i] if change is None else change @ poses[i])
        found = agreement_at((maps[i], maps[j]), S, np.random.default_rng(0), Tolerance(0.0, AGREEING_SIGMAS))
        out.append(float(found.absent[0]))
    return out


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A box whose three sides differ; the longest is along x."""
    file = tmp_path_factory.mktemp("box") / "box.ply"
    trimesh.creation.box((110, 70, 50)).subdivide_to_size(8.0).export(file)
    return rendered(str(file), EMPTY_FRAMES)


@pytest.mark.parametrize("scene", ["chair", "vase"])
def test_right_frames_miss_nothing_of_each_other(scene):
    found = rendered(scene, EMPTY_FRAMES)
    assert max(absent_in_pairs(maps_with_empty_places(found.clouds), found.S_world_camera)) < 0.005


def test_what_is_larger_than_it_was_seen_is_missed_where_it_is_known_what_was_seen(box):
    larger = Similarity(1.3, np.eye(3), np.zeros(3))
    assert min(absent_in_pairs(maps_with_empty_places(box.clouds), box.S_world_camera, larger)) > 0.02
    assert max(absent_in_pairs([build_surface_map(c) for c in box.clouds], box.S_world_camera, larger)) == 0
