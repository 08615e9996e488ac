"""Likelihood of places: residuals against a plain formula, derivatives against differences, and what it decides."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.agreement import HIDDEN_DEPTH
from sl_nerfstudio.registration.evidence import (
    ABSENT,
    ABSENT_SHARE,
    BLOCK,
    CONTRADICTING_SIGMAS,
    HIDDEN,
    JUDGED,
    LEAST_FACING_COSINE,
    POSE_ERRORS,
    UNDECODED,
    UNKNOWNS,
    Commonness,
    Compared,
    FrameEvidence,
    KeptResiduals,
    PairEvidence,
    Places,
    ScanEvidence,
    frame_evidence,
)
from sl_nerfstudio.registration.pairs import (
    FINE_WIDTHS,
    LEAST_ODDS,
    SEARCH_WIDTHS,
    STEP_DEG,
    best_match,
    walk,
)
from sl_nerfstudio.registration.surfaces import EmptyPlaces
from sl_nerfstudio.relative_pose.epipolar import directions
from tests.registration.graph_edges import exp_at
from tests.registration.shaped_clouds import cloud_of_body, seen_and_lit
from tests.relative_pose.two_views import pose_of

PROJECTOR = Device(30, 24, 26.0, 27.0, 15.5, 11.0, k1=0.05)
CAMERAS = {
    "pinhole": Device(60, 45, 75.0, 78.0, 28.0, 24.0),
    "lens": Device(60, 45, 75.0, 78.0, 28.0, 24.0, k1=-0.3, k2=0.1, p1=5e-3, p2=-8e-3),
    "DOE": Device(60, 45, 75.0, 78.0, 28.0, 24.0, k1=0.2, k2=-0.05, p1=-4e-3, p2=6e-3, model="DOE"),
}


def unit(x: ndarray) -> ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def rays_of(camera: Device) -> ndarray:
    uv = np.stack(np.meshgrid(np.arange(camera.w) + 0.5, np.arange(camera.h) + 0.5), -1).reshape(-1, 2)
    return unit(directions(camera, uv)).reshape(camera.h, camera.w, 3)


# Residuals, against a plain formula.


def any_frame(camera: Device, seed: int, points: int = 400) -> FrameEvidence:
    """Distances, normals and errors that vary from place to place, with holes: any will do for a formula."""
    rng = np.random.default_rng(seed)
    ray = rays_of(camera)
    h, w = ray.shape[:2]
    distance = 3 + 0.05 * rng.standard_normal((h, w))
    distance[rng.random((h, w)) < 0.05] = np.nan
    surface = np.stack([distance, rng.uniform(0.02, 0.1, (h, w))], -1).astype(np.float32)
    blocks = -(-h // BLOCK), -(-w // BLOCK)
    coarse = unit(-ray[::BLOCK, ::BLOCK] + 0.7 * rng.standard_normal((*blocks, 3)))
    coarse[rng.random(blocks) < 0.1] = np.nan
    smooth = np.concatenate([0.05 * rng.standard_normal((*blocks, 5)), coarse], -1).astype(np.float32)
    some = rng.integers(0, h * w, points)
    position = ray.reshape(-1, 3)[some] * (3 + 0.4 * rng.standard_normal((points, 1)))
    normal = unit(-ray.reshape(-1, 3)[some] + 0.6 * rng.standard_normal((points, 3)))
    sigma, errors = rng.uniform(0.02, 0.1, (points, 1)), 0.05 * rng.standard_normal((points, 5))
    T = np.linalg.inv(pose_of((0.6, 0.1, 0.2), (0.0, 0.0, -3.0), 20.0))
    nothing = EmptyPlaces(rng.random((h, w)) < 0.7, PROJECTOR, T, rng.uniform(2.5, 3.5, (24, 30)))
    return FrameEvidence(
        camera, surface, smooth, nothing, np.concatenate([position, normal, sigma, errors], 1),
        position.mean(0), 1.0, 2.0, 0.05, 0.1,
    )  # fmt: skip


def plain(mover: FrameEvidence, seen: FrameEvidence, S: Similarity, own: ndarray, other: ndarray):
    """Residuals in sigmas, sigmas and codes of the mover's points on the other's surface, ray by ray."""
    out = []
    for point in mover.points:
        position, normal, sigma, errors = np.split(point, [3, 6, 7])
        along = unit(position)
        p = S.points((position + along * (errors @ own))[None])[0]
        n, distance = S.R @ normal, np.linalg.norm(p)
        uv, front = project(Intrinsics.of(seen.camera, torch.float64), torch.from_numpy(p[None]))
        u, v = uv[0].numpy() - 0.5
        h, w = seen.surface.shape[:2]
        if not (front[0] and 0 <= u < w - 1 and 0 <= v < h - 1) or -unit(p) @ n < LEAST_FACING_COSINE:
            out.append((0.0, np.nan, 0))
            continue
        i, j = int(v), int(u)
        four = seen.surface[i : i + 2, j : j + 2, 0].astype(np.float64)
        surface = np.array([1 - (v - i), v - i]) @ four @ np.array([1 - (u - j), u - j])
        nearest = int(v + 0.5), int(u + 0.5)
        if np.isnan(four).any():
            absent = seen.nothing.empty[nearest] and seen_and_lit(seen.nothing, p[None], n[None])[0]
            out.append((0.0, np.nan, ABSENT if absent else UNDECODED))
            continue
        block = seen.smooth[nearest[0] // BLOCK, nearest[1] // BLOCK].astype(np.float64)
        behind = distance - surface - block[:5] @ other
        if behind > HIDDEN_DEPTH * seen.radius:
            out.append((0.0, np.nan, HIDDEN))
            continue
        facing = block[5:] if -unit(p) @ block[5:] > 0.1 else n
        slope = S.scale * (S.R @ along) @ facing / (unit(p) @ facing)  # of the distance behind, by the point's own ray
        twist = (four[0, 0] + four[1, 1] - four[0, 1] - four[1, 0]) / 2
        spread = np.sqrt(seen.surface[nearest][1] ** 2 + (slope * sigma[0]) ** 2 + twist**2)
        out.append((behind / spread, spread, JUDGED))
    z, spread, codes = map(np.array, zip(*out, strict=True))
    return z, spread, codes


@pytest.mark.parametrize("name", sorted(CAMERAS))
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_residuals_are_those_of_the_plain_formula_both_ways(name, seed):
    rng = np.random.default_rng(seed)
    source, target = any_frame(CAMERAS[name], seed), any_frame(CAMERAS["lens"], seed + 10)
    some = [exp_at(x, target.centroid, 1.0, 1.0) for x in 0.1 * rng.standard_normal((3, 7))]
    places = replace(Places.of(*some), errors=rng.standard_normal((3, 2 * POSE_ERRORS)))
    found = PairEvidence(source, target).compare(places)
    for k, S in enumerate(some):
        own, other = np.split(places.errors[k], 2)
        parts = plain(source, target, S, own, other), plain(target, source, S.inverse(), other, own)
        z, spread, codes = (np.concatenate(each) for each in zip(*parts, strict=True))
        behind_edge = (found.codes[k] == HIDDEN) & (codes == JUDGED) & (z > CONTRADICTING_SIGMAS)  # see below
        assert behind_edge.sum() < 0.04 * len(codes)
        z, codes = np.where(behind_edge, 0, z), np.where(behind_edge, HIDDEN, codes)
        np.testing.assert_array_equal(found.codes[k], codes)
        assert set(codes.tolist()) == {0, JUDGED, ABSENT, UNDECODED, HIDDEN}
        np.testing.assert_allclose(found.z[k], z, rtol=2e-4, atol=1e-4)
        usual = np.repeat([target.usual_sigma, source.usual_sigma], [len(source.points), len(target.points)])
        judged = codes == JUDGED
        np.testing.assert_allclose(found.spread[k, judged], (spread / usual)[judged], rtol=1e-4)


# Normal equations, against differences of the residuals of a surface that is known exactly.


SIGMA = 1e-3  # small against distances: derivatives are those at the surface


def plane_frame(camera: Device, normal: ndarray, height: float, seed: int) -> FrameEvidence:
    """A plane `normal . p = -height` before a camera, points about it, and pose errors that are the same everywhere."""
    rng = np.random.default_rng(seed)
    ray, errors = rays_of(camera), SIGMA * rng.standard_normal(5)
    h, w = ray.shape[:2]
    distance = -height / (ray @ normal)
    surface = np.stack([distance, np.full((h, w), SIGMA)], -1).astype(np.float32)
    smooth = np.tile(np.r_[errors, normal].astype(np.float32), (-(-h // BLOCK), -(-w // BLOCK), 1))
    rows, columns = rng.integers(20, h - 20, 60), rng.integers(20, w - 20, 60)
    position = ray[rows, columns] * (distance[rows, columns] + SIGMA * rng.standard_normal(60))[:, None]
    parts = position, np.tile(normal, (60, 1)), np.zeros((60, 1)), SIGMA * rng.standard_normal((60, 5))
    nothing = EmptyPlaces(np.zeros((h, w), dtype=bool), PROJECTOR, np.eye(4), np.zeros((24, 30)))
    return FrameEvidence(
        camera,
        surface,
        smooth,
        nothing,
        np.concatenate(parts, 1),
        position.mean(0) + normal,
        1.0,
        1.0,
        SIGMA,
        SIGMA,
    )


@pytest.mark.parametrize("name", sorted(CAMERAS))
def test_the_normal_equations_are_those_of_differences_of_the_residuals(name):
    camera = replace(CAMERAS[name].scaled(8.0), w=480, h=360)  # fine enough for the surface between its places
    rng = np.random.default_rng(3)
    normal, height, width = unit(np.array([0.2, -0.3, 1.0])), 3.0, 2.5
    S = Similarity(1.3, Rotation.from_rotvec([0.05, -0.1, 0.2]).as_matrix(), np.array([0.1, 0.05, 0.2]))
    seen = S.R.T @ normal, (height + normal @ S.t) / S.scale  # of the same plane by the source
    source, target = plane_frame(camera, *seen, 1), plane_frame(camera, normal, height, 2)
    errors = rng.standard_normal(2 * POSE_ERRORS)

    def residuals(x: ndarray) -> ndarray:
        """Of the points of both frames, in sigmas."""
        T, out = exp_at(x[:7], target.centroid, 1.0, 9.0) @ S, []
        both = np.split(errors + x[7:], 2)
        for mover, other, M, n, h, k in (
            (source, target, T, normal, height, 0), (target, source, T.inverse(), *seen, 1),
        ):  # fmt: skip
            p, e = mover.points[:, :3], mover.points[:, 7:]
            p = M.points(p + unit(p) * (e @ both[k])[:, None])
            beyond = np.linalg.norm(p, axis=1) + h / (unit(p) @ n)
            out.append((beyond - other.smooth[0, 0, :5].astype(np.float64) @ both[1 - k]) / SIGMA)
        return np.concatenate(out)

    r, step = residuals(np.zeros(UNKNOWNS)), 1e-5
    J = np.stack([(residuals(step * d) - residuals(-step * d)) / (2 * step) for d in np.eye(UNKNOWNS)], 1)
    places = replace(Places.of(S), errors=errors[None])
    found, H, g = PairEvidence(source, target)._compare(places, np.array([width]))
    judged = found.codes[0] == JUDGED
    assert judged.sum() > 60
    np.testing.assert_allclose(found.z[0, judged], r[judged], atol=1e-2)
    weight = np.where(judged & (np.abs(r) <= 4 * width), 1 / (1 + (r / width) ** 2) ** 2, 0)
    wanted = (J * weight[:, None]).T @ J
    np.testing.assert_allclose(H[0], wanted, atol=3e-3 * np.abs(wanted).max())
    size = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(H[0] / np.outer(size, size), wanted / np.outer(size, size), atol=5e-3)
    np.testing.assert_allclose(g[0] / size, J.T @ (weight * r) / size, atol=2e-2)


# Bodies that are known exactly, seen by two cameras that go around the axis z.


def view(turn_deg: float, scale: float = 1.0, up_deg: float = 25.0) -> Similarity:
    """A camera three units from the origin, looking at it, with a baseline of some length."""
    a, b = np.radians([turn_deg, up_deg])
    back = np.array([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
    right = unit(np.cross([0.0, 0, 1], back))
    return Similarity(scale, np.stack([right, np.cross(back, right), back], 1), 3 * back)


def waves(p: ndarray) -> ndarray:
    """A ground with low waves, without edges."""
    x, y, z = p.T
    return z - 0.1 * (np.sin(3 * x + 1) * np.cos(2 * y) + np.sin(3 * y + 2 * x))


def pot(p: ndarray, bump: float = 0.0) -> ndarray:
    """A body of revolution about z without edges, with a small bump on its side."""
    z = p[:, 2]
    body = (p[:, :2] ** 2).sum(1) / 0.25 + z**2 / 0.4 - 1 - 0.15 * np.cos(6 * z)
    return body - 4 * bump * np.exp(-((np.linalg.norm(p - [0.5, 0.12, 0.1], axis=1) / 0.08) ** 2))


def pair_of(outside: Callable[[ndarray], ndarray], *views: Similarity, size: int = 200, sigma: float = 2e-3):
    """Two frames and the similarity of the first to the second."""
    clouds = [cloud_of_body(outside, S, size, sigma) for S in views]
    return [frame_evidence(c) for c in clouds], views[1].inverse() @ views[0]


def about_axis(views: tuple[Similarity, ...], degrees: float) -> Similarity:
    """The place at which the first frame is turned about the axis."""
    turn = Similarity(1.0, Rotation.from_euler("z", degrees, degrees=True).as_matrix(), np.zeros(3))
    return views[1].inverse() @ turn @ views[0]


def no_knowledge(*frames: FrameEvidence) -> tuple[Commonness, ...]:
    return tuple(Commonness.none(len(f.points)) for f in frames)


@pytest.fixture(scope="module")
def ground():
    return pair_of(waves, view(0.0, 1.0, 70.0), view(20.0, 1.3, 60.0))


# The edge is up to 60 places from what it hides.
@pytest.mark.parametrize("height", [pytest.param(0.1, marks=pytest.mark.slow), 0.3])
def test_what_an_edge_hides_contradicts_nothing_and_what_lies_behind_a_surface_does(height):
    """Of a ground that is higher on one side of a line, seen from its two sides: at its foot by one camera only."""
    views = view(0.0, 1.0, 45.0), view(180.0, 1.0, 45.0)
    (source, target), true = pair_of(lambda p: p[:, 2] - height * (p[:, 0] < 0), *views, size=500)
    evidence = PairEvidence(source, target)
    found = evidence.compare(Places.of(true))
    codes, z = found.codes[0], found.z[0]
    assert (codes == HIDDEN).sum() > 0.005 * len(codes)
    assert (z[codes == JUDGED] > 10).mean() < 1e-3
    lowered = views[1].inverse() @ Similarity(1.0, np.eye(3), np.array([0.0, 0.0, -0.05])) @ views[0]
    below = evidence.compare(Places.of(lowered))
    own = slice(None, len(source.points))
    judged, before = below.codes[0, own] == JUDGED, codes[own] == JUDGED
    assert judged.sum() > 0.8 * before.sum() and np.median(below.z[0, own][judged]) > 5


@pytest.mark.parametrize("share", [0.02, 0.5])
def test_what_hides_a_part_of_the_view_and_is_dark_itself_counts_once(ground, share):
    """Half of the view, as behind the dark side of a wall, costs no more than one point that is missed by chance."""
    (source, target), true = ground
    empty = np.zeros(target.surface.shape[:2], dtype=bool)
    empty[:, 80 : 80 + round(share * 200)] = True
    surface = np.where(empty[..., None], np.float32(np.nan), target.surface)
    lit_far = replace(target.nothing, reach=np.full_like(target.nothing.reach, np.inf))
    frames = [
        replace(target, surface=surface, nothing=replace(lit_far, empty=e)) for e in (empty, np.zeros_like(empty))
    ]
    absent, odds = [], []
    for frame in frames:
        evidence = PairEvidence(source, frame)
        found = evidence.compare(Places.of(true))
        absent.append(float(((found.codes[0] == ABSENT) / evidence.area).sum()))
        odds.append(float(evidence.log_odds(found, no_knowledge(source, frame))[0]))
    usual = no_knowledge(target)[0].absent_share
    assert absent[1] == 0 < absent[0] and (absent[0] > 10) == (share == 0.5)
    wanted = max(absent[0] * np.log(ABSENT_SHARE / usual), np.log(ABSENT_SHARE))
    assert odds[0] - odds[1] == pytest.approx(wanted, rel=1e-4)


@settings(max_examples=5)
@given(st.integers(0, 10**6))
def test_an_exact_pair_is_refined_to_the_truth(ground, seed):
    (source, target), true = ground
    x = np.random.default_rng(seed).normal(0, 0.02, 7)
    start = exp_at(x, target.centroid, target.radius, 1.0) @ true
    places, _ = PairEvidence(source, target).refined(Places.of(start), (*SEARCH_WIDTHS, *FINE_WIDTHS, 3.0, 3.0))
    D = places.similarity(0) @ true.inverse()
    off = D.points(target.centroid[None])[0] - target.centroid
    assert np.radians(angle_deg(D.R)) < 1e-4 and abs(np.log(D.scale)) < 1e-4
    assert np.linalg.norm(off) < 1e-4 * target.radius


@pytest.fixture(scope="module")
def compared(ground):
    """Some places of a pair, the truth first, with residuals."""
    (source, target), true = ground
    rng = np.random.default_rng(0)
    moved = [exp_at(x, target.centroid, target.radius, 1.0) for x in rng.normal(0, 0.01, (5, 7))]
    places = replace(Places.of(true, *(D @ true for D in moved)), errors=0.1 * rng.standard_normal((6, 10)))
    return source, target, places


def test_places_are_compared_alike_whichever_frame_is_the_source_and_whatever_the_units(compared):
    source, target, places = compared
    forward = PairEvidence(source, target)
    found = forward.compare(places)
    common = no_knowledge(source, target)
    leads = forward.comparison(found, common).leads
    np.testing.assert_array_equal(leads, -leads.T)
    assert leads[0, 1:].min() > 0 and np.ptp(leads) > 10
    back = [places.similarity(k).inverse() for k in range(len(places))]
    halves = places.errors[:, POSE_ERRORS:], places.errors[:, :POSE_ERRORS]
    backward = PairEvidence(target, source)
    again = backward.compare(replace(Places.of(*back), errors=np.concatenate(halves, 1)))
    pairs = [(backward, again, common[::-1])]
    long = [in_units(f, s) for f, s in ((source, 10.0), (target, 0.2))]
    there = [Similarity.scaling(0.2) @ places.similarity(k) @ Similarity.scaling(0.1) for k in range(len(places))]
    larger = PairEvidence(*long)
    pairs.append((larger, larger.compare(replace(Places.of(*there), errors=places.errors)), common))
    for evidence, other, known in pairs:
        assert (np.sort(other.codes) == np.sort(found.codes)).mean() > 0.9999
        np.testing.assert_allclose(evidence.comparison(other, known).leads, leads, atol=0.02)
        np.testing.assert_allclose(evidence.log_odds(other, known), forward.log_odds(found, common), atol=0.02)
        np.testing.assert_allclose(evidence.by_likelihood(other), forward.by_likelihood(found), atol=0.02)


def test_residuals_that_were_kept_are_in_units_of_the_noise_as_it_is_known_now(compared):
    source, target, true = compared[0], compared[1], compared[2].similarity(0)
    here = [true, exp_at(0.1 * np.eye(7)[4], target.centroid, target.radius, 1.0) @ true]
    kept, common = KeptResiduals([source, target]), no_knowledge(source, target)
    leads = []
    for noise in (1.0, 3.0, 1.0):
        again = ScanEvidence(kept, common, np.full(2, noise)).comparison(0, 1, here).leads
        fresh = ScanEvidence(KeptResiduals([source, target]), common, np.full(2, noise)).comparison(0, 1, here).leads
        np.testing.assert_array_equal(again, fresh)
        leads.append(float(again[0, 1]))
    assert leads[0] == leads[2] > 1.5 * leads[1] > 0


def test_a_place_at_which_views_share_most_errors_is_not_the_less_likely_for_those_that_they_do_not(compared):
    """Two places with the same few outliers; at the first, all other residuals are half as large."""
    source, target, _ = compared
    pair, common = PairEvidence(source, target), no_knowledge(source, target)
    n = len(pair.area)
    rng = np.random.default_rng(1)
    bulk = np.tile(np.clip(rng.standard_normal(n), -2, 2).astype(np.float32), (2, 1)) * np.float32([[0.5], [1.0]])
    outlier = rng.random(n) < 0.05
    z = np.where(outlier, np.float32(4.5), bulk)
    found = pair.scaled(Compared(z, np.full((2, n), JUDGED, np.int8), np.ones((2, n), np.float32)), (1.0, 1.0))
    assert np.abs(pair.comparison(found, common).leads[0, 1]) < 1e-3
    z[1, outlier] = 6.0
    assert pair.comparison(replace(found, z=z), common).leads[0, 1] > 1


def in_units(frame: FrameEvidence, factor: float) -> FrameEvidence:
    """The same frame with a baseline of another length."""
    points, smooth = frame.points.copy(), frame.smooth.copy()
    points[:, :3] *= factor
    points[:, 6:] *= factor
    smooth[..., :5] *= factor
    nothing = frame.nothing
    T = nothing.T_projector_camera.copy()
    T[:3, 3] *= factor
    return replace(
        frame, surface=frame.surface * np.float32(factor), smooth=smooth, points=points,
        centroid=factor * frame.centroid, radius=factor * frame.radius, usual_sigma=factor * frame.usual_sigma,
        depth_sigma=factor * frame.depth_sigma,
        nothing=replace(nothing, T_projector_camera=T, reach=factor * nothing.reach),
    )  # fmt: skip


TURNS = (0.0, 9.0, -15.0, 40.0)


@pytest.mark.parametrize(("bump", "least", "most"), [(0.0, -3.0, 3.0), (0.08, LEAST_ODDS, np.inf)])
@pytest.mark.slow
def test_a_surface_of_revolution_says_nothing_about_a_turn_and_a_bump_on_it_does(bump, least, most):
    views = view(0.0), view(20.0, 1.4)
    (source, target), _ = pair_of(lambda p: pot(p, bump), *views)
    evidence = PairEvidence(source, target)
    places, _ = evidence.refined(Places.of(*(about_axis(views, t) for t in TURNS)), FINE_WIDTHS)
    found = evidence.compare(places)
    leads = evidence.comparison(found, evidence.commonness(found)).leads[0, 1:]
    assert (leads > least).all() and (leads < most).all()


def test_a_walk_reaches_the_turn_that_no_slope_leads_to():
    """From 40 degrees beside it; refined from there alone the frames stay turned."""
    views = view(0.0), view(20.0, 1.4)
    (source, target), true = pair_of(lambda p: pot(p, 0.08), *views)
    evidence = PairEvidence(source, target)
    start, H = evidence.refined(Places.of(about_axis(views, 40.0)), FINE_WIDTHS)
    assert angle_deg(start.R[0] @ true.R.T) > 35
    way = walk(evidence, start, H[0])
    off = [angle_deg(way.R[k] @ true.R.T) for k in range(len(way))]
    assert min(off) < STEP_DEG
    match = best_match(evidence, way, (0, 1))
    assert match is not None and match.slip_deg == 0
    # farther round neither frame sees where the other has its bump: then there may be two
    assert all(angle_deg(r.S_target_source.R @ true.R.T) > 75 for r in match.rivals if r.log_odds > -LEAST_ODDS)
    assert angle_deg(match.S_target_source.R @ true.R.T) < 0.5
    alone = best_match(evidence, start, (0, 1))
    assert alone is None or angle_deg(alone.S_target_source.R @ true.R.T) > 35
