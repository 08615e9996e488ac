"""Two frames onto each other: search, rivals, slip, tone, and which pairs are accepted."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration import pairs
from sl_nerfstudio.registration.agreement import Hypotheses, Side, Tolerance
from sl_nerfstudio.registration.evidence import LARGEST_NOISE, Commonness, Frame
from sl_nerfstudio.registration.pairs import (
    ANYWHERE,
    LEAST_ODDS,
    NEARBY,
    NEIGHBOURS,
    PairMatch,
    Rival,
    Search,
    edge_weights,
    is_accepted,
    is_ambiguous,
    likeness,
    register_pair,
    rotations,
    screw_motion,
    search_places,
    turn_by_tone,
    variance_along,
    weakest_rotation,
)
from sl_nerfstudio.registration.surfaces import build_surface_map
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, difference, on_a_ball, part_of, rolled, similarities_of
from tests.registration.graph_edges import exp_at
from tests.registration.shaped_clouds import cloud_of_depth, relief, rendered, with_wall

SIZE, FRAMES = 100, 18  # 20 degrees from frame to frame
RIG = rig_of(FRAMES, SIZE)
TRUE = similarities_of(RIG.T_world_camera.numpy(), RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy())


@pytest.fixture(scope="module")
def clouds():
    return clouds_of(RIG, SIZE, noise=0.1)


@pytest.fixture(scope="module")
def frames(clouds):
    return [Frame.of(c) for c in clouds]


def between(i: int, j: int) -> Similarity:
    return TRUE[j].inverse() @ TRUE[i]


def registered(frames, search: Search = NEIGHBOURS, guess: Similarity | None = None, seed: int = 0) -> PairMatch:
    found = register_pair((frames[0], frames[1]), (0, 1), search, np.random.default_rng(seed), guess)
    assert found is not None
    return found


def assert_near(found: Similarity, true: Similarity, target: Frame, degrees: float = 1.0) -> None:
    angle, shift, scale = difference(found, true, target.map.centroid)
    assert angle < degrees and shift < 0.02 * target.map.radius and scale < 0.02


# Search and refinement.


@pytest.mark.parametrize(("i", "j"), [(0, 1), (4, 6), (9, 8)])
def test_neighbours_find_each_other(frames, i, j):
    found = register_pair((frames[i], frames[j]), (i, j), NEIGHBOURS, np.random.default_rng(0))
    assert_near(found.S_target_source, between(i, j), frames[j])
    assert (found.source, found.target) == (i, j)
    assert found.fitness > 0.9 and found.fitness >= found.overlap > 0.4
    assert found.lead > LEAST_ODDS and found.rotation_sigma_deg < 1
    assert is_accepted(found) and not is_ambiguous(found)


def test_a_rolled_camera_is_found_without_a_guess():
    """Frame 1 rotated about its line of sight by 130 degrees, as if held that way."""
    rig, roll = part_of(RIG, [0, 1]), torch.eye(4, dtype=torch.float64)
    roll[:3, :3] = torch.from_numpy(rolled(130))
    camera, relative = rig.T_world_camera.clone(), rig.T_camera_projector.clone()
    camera[1], relative[1] = camera[1] @ roll, roll.T @ relative[1]
    held = replace(rig, T_world_camera=camera, T_camera_projector=relative)
    pair = [Frame.of(c) for c in clouds_of(held, SIZE)]
    true = Similarity(1.0, rolled(130), np.zeros(3)).inverse() @ between(0, 1)
    assert_near(registered(pair, ANYWHERE).S_target_source, true, pair[1])


def test_the_scale_stays_within_its_bound(frames, monkeypatch):
    """Without the prior a cloud would collapse onto a patch; the bound holds whatever the prior says."""
    monkeypatch.setattr(pairs, "SCALE_SIGMA", 100.0)
    S = between(2, 3)
    wrong = Similarity(3.0 * S.scale, S.R, S.t)
    found = search_places((frames[2].map, frames[3].map), NEARBY, np.random.default_rng(0), wrong)
    assert np.abs(np.log(found.scale / wrong.scale)).max() <= pairs.LARGEST_LOG_SCALE + 1e-9
    match = register_pair((frames[2], frames[3]), (2, 3), NEARBY, np.random.default_rng(0), wrong)
    assert match is None or not is_accepted(match) or abs(np.log(match.S_target_source.scale / S.scale)) < 0.02


@pytest.mark.parametrize("walled", [(True, False), (False, True)], ids=["source", "target"])
def test_a_wall_that_one_frame_alone_saw_does_not_move_the_alignment(clouds, frames, walled):
    distance = 3 * np.linalg.norm(clouds[2].centroid)
    pair = [Frame.of(with_wall(clouds[k], distance)) if w else frames[k] for k, w in zip((2, 3), walled, strict=True)]
    assert_near(registered(pair).S_target_source, between(2, 3), frames[3])


def test_the_result_does_not_depend_on_the_lengths_of_the_baselines(clouds, frames):
    """One cloud ten times as large, the other a third: the same pair."""
    factors, lengths = (10.0, 1 / 3), ("points", "sigma_noise", "pose_errors")
    scaled = [
        Frame.of(replace(clouds[k], **{key: f * getattr(clouds[k], key) for key in lengths}))
        for k, f in zip((2, 3), factors, strict=True)
    ]
    a, b = registered(frames[2:4]), registered(scaled)
    S = Similarity.scaling(1 / factors[1]) @ b.S_target_source @ Similarity.scaling(factors[0])
    angle, shift, scale = difference(S, a.S_target_source, frames[3].map.centroid)
    assert angle < 0.05 and shift < 1e-3 * frames[3].map.radius and scale < 1e-3
    for key in ("overlap", "fitness", "log_odds", "rotation_sigma_deg"):
        assert getattr(b, key) == pytest.approx(getattr(a, key), rel=0.02, abs=5e-3)


# Starts.


@settings(max_examples=20)
@given(st.floats(0, 20), st.integers(0, 10**6))
def test_every_rotation_within_reach_has_a_start_nearby(degrees, seed):
    """In a cubic lattice nothing is farther from a node than half the diagonal of a cell, plus its curvature."""
    axis = np.random.default_rng(seed).standard_normal(3)
    wanted = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
    starts = Rotation.from_matrix(rotations(Search(20.0, 5.0)))
    assert starts[0].magnitude() == 0 and starts.magnitude().max() <= np.radians(20) + 1e-9
    assert np.degrees((starts * wanted.inv()).magnitude().min()) < 5.0 * np.sqrt(3) / 2 + 2.5


# Rivals, acceptance, weights.


@pytest.mark.parametrize(("odd", "ambiguous"), [(0.0, True), (0.35, False)])
def test_half_a_turn_of_a_symmetric_surface_is_a_rival_as_good_as_the_best(odd, ambiguous):
    frame = Frame.of(cloud_of_depth(lambda x, y: relief(x, y, odd)))
    centre, radius = frame.map.centroid, frame.map.radius
    found = registered((frame, frame), ANYWHERE)
    odds = [rival.log_odds for rival in found.rivals]
    assert odds == sorted(odds, reverse=True) and is_accepted(found)
    assert is_ambiguous(found) is ambiguous and found.lead == min([found.log_odds, *(-each for each in odds)])
    turns = Similarity.identity(), Similarity(1.0, rolled(180), np.zeros(3))
    said = [found.S_target_source, *(r.S_target_source for r in found.rivals)]
    if ambiguous:
        assert abs(odds[0]) < LEAST_ODDS / 2
        for true in turns:
            assert min(difference(S, true, centre)[0] for S in said[:2]) < 1
    else:
        assert difference(found.S_target_source, turns[0], centre)[0] < 1
    for k, a in enumerate(said):
        for b in said[:k]:
            angle, shift, _ = difference(a, b, centre)
            assert angle > pairs.SAME_PLACE_DEG or shift > pairs.SAME_PLACE_SHIFT * radius


def match(log_odds: float = 50.0, *rivals: float) -> PairMatch:
    S = Similarity.identity()
    return PairMatch(
        0, 1, S, np.eye(7), 0.5, 0.9, log_odds, tuple(Rival(S, odds) for odds in rivals), 0.5, 0.0, np.zeros(7),
        (Commonness.none(0), Commonness.none(0)), (1.0, 1.0),
    )  # fmt: skip


@given(st.floats(-100, 100), st.lists(st.floats(-100, 0), max_size=3))
def test_a_pair_is_accepted_by_its_odds_and_ambiguous_by_its_rivals(odds, rivals):
    found = match(odds, *rivals)
    assert is_accepted(found) is (odds > LEAST_ODDS)
    assert is_ambiguous(found) is any(rival > -LEAST_ODDS for rival in rivals)
    assert (found.lead > LEAST_ODDS) is (is_accepted(found) and not any(rival >= -LEAST_ODDS for rival in rivals))


def test_what_slips_needs_no_odds_but_residuals_that_are_noise():
    slips = replace(match(LEAST_ODDS / 2), slip_deg=5.0)
    assert is_accepted(slips) and not is_accepted(replace(slips, noise=(1.0, LARGEST_NOISE)))
    assert is_accepted(replace(match(), noise=(1.0, LARGEST_NOISE)))  # its other places may be right


def about_x(deg: float) -> Similarity:
    return Similarity(1.0, Rotation.from_rotvec([math.radians(deg), 0.0, 0.0]).as_matrix(), np.zeros(3))


def test_places_along_a_slip_are_one_side_and_those_beyond_it_others():
    """Sides at 0 and 40 degrees, the second with a slide of its own."""
    rivals = tuple(Rival(about_x(deg), odds) for deg, odds in ((3, -1.0), (-6, -4.0), (40, -2.0), (44, -3.0)))
    slips = replace(match(), rivals=rivals, slip_deg=7.0)
    assert [one.log_odds for one in slips.sides] == [0.0, -2.0]
    for deg, side in ((5.0, 0.0), (-9.0, 0.0), (19.0, 0.0), (43.0, 40.0)):
        assert angle_deg(slips.nearest(about_x(deg)).R @ about_x(side).R.T) < 1e-6
    assert slips.log_odds_at(about_x(-6.0)) == -4.0  # what it says of a place is as before
    (weight,) = edge_weights([slips])
    assert weight == pytest.approx(1 / (1 + math.exp(-2)))
    firm = replace(slips, slip_deg=0.0)
    assert len(firm.sides) == 5 and edge_weights([firm])[0] < weight


@given(st.lists(st.floats(-20, 0), min_size=1, max_size=6))
def test_the_variance_along_a_slip_is_that_of_its_places(odds):
    """Of the places within it by their probabilities; uniform where it leads from side to side."""
    places = [Rival(about_x(3.0 * k), float(value)) for k, value in enumerate([0.0, *odds])]
    p, turned = np.exp([0.0, *odds][:4]), np.array([0.0, 3.0, 6.0, 9.0])[: len(places)]
    wanted = np.radians(np.sqrt((p * turned**2).sum() / p.sum()))
    assert math.sqrt(variance_along(places, 9.5)) == pytest.approx(wanted, abs=1e-9)
    assert math.sqrt(variance_along(places, 150.0)) == pytest.approx(math.radians(150) / math.sqrt(3))
    assert math.sqrt(variance_along(places, 2.0)) == pytest.approx(math.radians(1.0))


@given(st.lists(st.floats(-100, 0), max_size=40), st.integers(0, 39))
def test_the_weight_of_a_pair_is_about_the_probability_that_it_is_right(rivals, k):
    """Bayes with equal priors; a rival that becomes more likely takes weight away."""
    (weight,) = edge_weights([match(50.0, *rivals)])
    assert weight == pytest.approx(max(1 / (1 + np.exp(rivals).sum()), 0.02))
    assert edge_weights([match(50.0, *rivals, -1.0)])[0] <= weight
    assert len(edge_weights([])) == 0


# Slip.

SURFACE = build_surface_map(cloud_of_depth(lambda x, y: 3 + 0.2 * np.sin(9 * x) * np.cos(8 * y), 40))
increments = arrays(np.float64, 7, elements=st.floats(-0.6, 0.6))


@settings(max_examples=20)
@given(increments)
def test_a_screw_motion_is_the_integral_of_its_velocity(x):
    """p(1) = c + e^l R(w) (p - c) + radius * integral of e^(l s) R(s w) v ds, by quadrature; to first order x."""
    found = screw_motion(x, SURFACE)
    v, w, growth = SURFACE.radius * x[:3], x[3:6], x[6]
    s, weight = np.polynomial.legendre.leggauss(12)
    s, weight = (s + 1) / 2, weight / 2
    shift = np.einsum("k,kij,j->i", weight * np.exp(growth * s), Rotation.from_rotvec(s[:, None] * w).as_matrix(), v)
    p = np.random.default_rng(0).normal(size=(5, 3))
    turned = np.exp(growth) * (p - SURFACE.centroid) @ Rotation.from_rotvec(w).as_matrix().T
    np.testing.assert_allclose(found.points(p), SURFACE.centroid + turned + shift, atol=1e-9)
    errors = [
        np.abs(screw_motion(h * x, SURFACE).matrix() - exp_at(h * x, SURFACE.centroid, SURFACE.radius, 1.0).matrix())
        for h in (1e-2, 1e-3)
    ]
    assert errors[1].max() <= errors[0].max() / 80 + 1e-12  # of second order: a hundredth


@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_the_least_known_rotation_is_the_unobservable_one(seed):
    rng = np.random.default_rng(seed)
    free = rng.normal(size=7)
    free /= np.linalg.norm(free[3:6])
    others = np.linalg.svd(free[None])[2][1:]
    information = others.T @ np.diag(rng.uniform(1, 10, 6)) @ others + 1e-9 * np.eye(7)
    found, known = weakest_rotation(information)
    assert known[0] < 1e-6 and (np.diff(known) >= 0).all()
    np.testing.assert_allclose(found * np.sign(found @ free), free, atol=1e-5)
    assert np.linalg.norm(found[3:6]) == pytest.approx(1)


def matched(scene: str, i: int, j: int):
    """Two frames of a rendered scene, registered, with the truth."""
    some = rendered(scene, (i, j))
    frames, S = [Frame.of(c) for c in some.clouds], some.S_world_camera
    return registered(frames), S[1].inverse() @ S[0], frames[1].map, some


def test_slipping_about_the_axis_of_a_vase_is_found_and_its_size_is_stated():
    found, true, _, some = matched("vase", 4, 5)
    assert found.rotation_sigma_deg >= found.slip_deg / np.sqrt(3) > 0 and not found.holds
    # The least known rotation is that about the vase's axis, in the target's camera axes.
    w, vectors = np.linalg.eigh(np.linalg.inv(found.information)[3:6, 3:6])
    axis = some.T_world_camera[1][:3, :3].T @ [0, 0, 1]
    assert abs(vectors[:, -1] @ axis) > np.cos(np.radians(10))
    assert w[-2] < w[-1] / 4  # the other rotations are known
    # Whatever it slipped by is covered, and nothing but a slip about the axis is wrong.
    D = Rotation.from_matrix((found.S_target_source @ true.inverse()).R).as_rotvec()
    assert np.degrees(np.linalg.norm(D)) < 2.5 * found.rotation_sigma_deg
    assert np.degrees(np.linalg.norm(D - axis * (axis @ D))) < 1.5


@pytest.mark.parametrize("scene", ["head", "frog"])
@pytest.mark.slow
def test_objects_with_a_relief_do_not_slip(scene):
    found, true, target, _ = matched(scene, 4, 5)
    angle, shift, _ = difference(found.S_target_source, true, target.centroid)
    assert angle < 1.5 and shift < 0.03 * target.radius
    assert found.slip_deg == 0 and found.rotation_sigma_deg < 2


def test_a_ball_slips_though_its_place_is_known(clouds):
    ball = registered([Frame.of(on_a_ball(clouds[k], 0.8, str(k))) for k in (0, 1)])
    assert ball.fitness > 0.9 and ball.rotation_sigma_deg > 3 and ball.slip_deg > 0
    assert np.linalg.eigvalsh(ball.information[:3, :3])[0] > 100 * np.radians(1 / ball.rotation_sigma_deg) ** 2


def test_a_few_points_that_a_motion_moves_hold_a_table_in_place():
    """All points but those of a ridge stay on the table's plane, whatever the motion; their number says nothing."""

    def table(ridge: float) -> Frame:
        def depth(x, y):
            height = ridge * np.clip(1 - np.abs(x - 0.3) / 0.06, 0, None) * (np.abs(y - 0.1) < 0.15)
            return 3 - height

        return Frame.of(cloud_of_depth(depth, 120))

    bare, held = (registered((one, one), NEARBY) for one in (table(0.0), table(0.12)))
    assert bare.slip_deg >= 12 and not bare.holds
    assert held.holds


# Tone.


@cache
def vase(first: int, second: int) -> tuple[tuple[Frame, Frame], Similarity]:
    """Two frames of a vase with blotches, and the true similarity."""
    some = rendered("vase", (first, second), resolution=300, lit=True)
    frames, S = tuple(Frame.of(c) for c in some.clouds), some.S_world_camera
    return (frames[0], frames[1]), S[1].inverse() @ S[0]


def with_tone(frame: Frame, tone: np.ndarray) -> Frame:
    known = np.isfinite(frame.map.tone)
    return replace(frame, map=replace(frame.map, tone=np.where(known, tone, np.nan).astype(np.float32)))


def blotches(frame: Frame, seed: int) -> np.ndarray:
    """Random ones, about as large as those of the vase."""
    return gaussian_filter(np.random.default_rng(seed).standard_normal(frame.map.valid.shape), 4)


@pytest.mark.parametrize("pair", [(4, 6), pytest.param((15, 17), marks=pytest.mark.slow)])
def test_the_blotches_of_a_vase_hold_it(pair):
    """Surfaces alone leave the frames turned by more; with tones, the turn is right to within what is stated."""
    frames, true = vase(*pair)
    bare, found = registered([with_tone(f, np.full_like(f.map.tone, np.nan)) for f in frames]), registered(frames)
    assert bare.slip_deg > 0 and not bare.by_tone
    assert found.slip_deg == 0 and found.by_tone
    off = angle_deg((found.S_target_source @ true.inverse()).R)
    assert off < 1.5 and off < 3.5 * found.rotation_sigma_deg
    assert found.rotation_sigma_deg < 3 < bare.rotation_sigma_deg


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.slow
def test_tones_that_are_not_the_surface_s_hold_nothing(seed):
    """Those of another vase; and the same at the same places of both images: a highlight, not a print."""
    (first, second), _ = vase(4, 6)
    made = blotches(first, seed)
    assert not registered((first, with_tone(second, blotches(second, seed)))).by_tone
    assert not registered((with_tone(first, made), with_tone(second, made))).by_tone


def test_a_motion_that_leaves_both_surfaces_ends_without_a_word():
    """What shrinks or grows threefold within a radian has nothing to follow after some steps."""
    frames, true = vase(4, 6)
    rng = np.random.default_rng(0)
    sides = Side.sampled(frames[0].map, 400, rng), Side.sampled(frames[1].map, 400, rng)
    away = np.array([5.0, -3.0, 4.0, 0.6, 0.0, 0.8, 1.1])
    with np.errstate(all="raise", under="ignore"):
        assert turn_by_tone(sides, true, away, Tolerance(0.0, 2.0)) is None


def test_likeness_is_the_correlation_of_the_tones_that_meet():
    """Of a frame with itself it is one; with the opposite tones minus one; turned away it is not known."""
    surface = vase(4, 6)[0][0].map
    far = Similarity(1.0, Rotation.from_rotvec([0, 2.5, 0]).as_matrix(), np.zeros(3))
    both = Hypotheses.of(Similarity.identity(), far)
    one, opposite = (
        Side.sampled(m, 400, np.random.default_rng(0)) for m in (surface, replace(surface, tone=-surface.tone))
    )
    for other, expected in ((one, 1), (opposite, -1)):
        np.testing.assert_allclose(likeness((one, other), both, Tolerance(0.0, 2.0)), [expected, np.nan], atol=1e-6)
