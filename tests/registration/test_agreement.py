"""The compiled sums of points against surfaces, against a plain formula and against differences."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch
import trimesh

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.geometry.triangulation import pixel_centres
from sl_nerfstudio.registration import agreement as module
from sl_nerfstudio.registration.agreement import (
    AGREEING_SIGMAS,
    BEHIND_WEIGHT,
    HIDDEN_DEPTH,
    KERNEL_CUTOFF,
    Hypotheses,
    Side,
    Tolerance,
    agreement,
)
from sl_nerfstudio.registration.surfaces import EmptyPlaces, FrameView, SurfaceMap, build_surface_map, tangent_planes
from tests.registration.graph_edges import exp_at
from tests.registration.shaped_clouds import RenderedClouds, rendered, seen_and_lit
from tests.relative_pose.two_views import pose_of

PROJECTOR = Device(30, 24, 26.0, 27.0, 15.5, 11.0, k1=0.05)
CAMERAS = {
    "pinhole": Device(40, 30, 50.0, 52.0, 19.0, 16.0),
    "lens": Device(40, 30, 50.0, 52.0, 19.0, 16.0, k1=-0.3, k2=0.1, p1=5e-3, p2=-8e-3),
    "DOE with a lens": Device(40, 30, 50.0, 52.0, 19.0, 16.0, k1=0.2, k2=-0.05, p1=-4e-3, p2=6e-3, model="DOE"),
}


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
    """H, g and the shares of one similarity, point by point as the module's text says."""
    radius = target.map.radius
    H, g, shares, absent = np.zeros((7, 7)), np.zeros(7), [], []
    for mover, seen, reverse in ((source, target, False), (target, source, True)):
        own = S.inverse() if reverse else S
        p, n = own.points(mover.points), mover.normals @ own.R.T
        uv, front = project(Intrinsics.of(seen.map.camera, torch.float64), torch.from_numpy(p))
        column, row = np.floor(uv.numpy()).astype(int).T
        height, width_px = seen.map.valid.shape
        inside = front.numpy() & (column >= 0) & (row >= 0) & (column < width_px) & (row < height)
        inside &= (n * p).sum(-1) <= 0
        empty = seen.map.nothing.empty[row[inside], column[inside]]
        absent.append((empty & seen_and_lit(seen.map.nothing, p[inside], n[inside])).sum() / len(p))
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
        used = (facing >= facing_least) & (np.abs(r) <= KERNEL_CUTOFF * tau)
        w = facing[used] / (1 + (r / tau)[used] ** 2) ** 2
        m = -N[used] @ S.R.T if reverse else N[used]
        x = (mover.points if reverse else p)[inside][used] - target.map.centroid
        J = np.concatenate([m, np.cross(x, m), (x * m).sum(-1, keepdims=True)], 1)
        H += (J * w[:, None]).T @ J
        g += J.T @ (w * r[used])
    return H, g, np.mean(shares, 0), float(np.mean(absent))


@pytest.mark.parametrize("name", sorted(CAMERAS))
@pytest.mark.parametrize("seed", range(3))
def test_the_compiled_sums_are_those_of_the_plain_formula(name, seed, monkeypatch):
    monkeypatch.setattr(module, "LEAST_FACING_COSINE", 0.5)
    rng = np.random.default_rng(seed)
    sides = [Side.sampled(bumpy_map(camera, seed + 10 * k), 600, rng)
             for k, camera in enumerate((CAMERAS[name], CAMERAS["lens"]))]  # fmt: skip
    increments = rng.normal(0, (0.1,) * 6 + (0.05,), (4, 7))
    similarities = [exp_at(x, np.zeros(3), 1.0, 1.0) for x in increments]
    tolerance = Tolerance(0.03, 3.0)  # each decides at some points
    found = agreement(*sides, Hypotheses.of(*similarities), tolerance)
    for k, S in enumerate(similarities):
        H, g, shares, absent = plain_sums(*sides, S, tolerance, 0.5)
        assert shares.min() > 0.02 and absent > 0.01  # every case is present
        np.testing.assert_allclose(found.H[k], H, rtol=1e-9, atol=1e-9 * np.abs(H).max())
        np.testing.assert_allclose(found.g[k], g, rtol=1e-9, atol=1e-9 * np.abs(g).max())
        np.testing.assert_allclose([found.agreeing[k], found.in_front[k], found.behind[k]], shares, rtol=1e-12)
        assert found.absent[k] == pytest.approx(absent)
        against = shares[1] + absent + BEHIND_WEIGHT * shares[2]
        assert found.score[k] == pytest.approx(shares[0] - against)


# Empty places: a frame that looks into empty space contradicts what would fill it.


def absent_in_pairs(found: RenderedClouds, factor: float = 1.0, known: bool = True) -> list[float]:
    """Shares of points that are missed, of all pairs of frames; the first of each sees the world scaled."""
    seen = [replace(cloud, seen=np.isfinite(cloud.coords).all(-1) if known else None) for cloud in found.clouds]
    maps, out = [build_surface_map(cloud) for cloud in seen], []
    for i, j in permutations(range(len(maps)), 2):
        S = found.S_world_camera[j].inverse() @ Similarity.scaling(factor) @ found.S_world_camera[i]
        sides = [Side.sampled(maps[k], 400, np.random.default_rng(0)) for k in (i, j)]
        out.append(float(agreement(*sides, Hypotheses.of(S), Tolerance(0.0, AGREEING_SIGMAS)).absent[0]))
    return out


@pytest.mark.parametrize("scene", ["chair", "vase"])
def test_right_frames_miss_nothing_of_each_other(scene):
    assert max(absent_in_pairs(rendered(scene, (0, 2, 6, 8)))) < 0.005


def test_what_is_larger_than_it_was_seen_is_missed_where_it_is_known_what_was_seen(tmp_path):
    trimesh.creation.box((110, 70, 50)).subdivide_to_size(8.0).export(tmp_path / "box.ply")
    box = rendered(str(tmp_path / "box.ply"), (0, 2, 6, 8))
    assert min(absent_in_pairs(box, 1.3)) > 0.02
    assert max(absent_in_pairs(box, 1.3, known=False)) == 0
