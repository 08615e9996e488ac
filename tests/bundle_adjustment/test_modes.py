"""After rough starts further searches let frames out of minima of their own; what is already right is left at once."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
import torch

from sl_nerfstudio.bundle_adjustment import modes
from sl_nerfstudio.bundle_adjustment.adjust import adjust
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.modes import (
    Explored,
    departure_of,
    drawn_start,
    explore,
    farthest_frame,
    is_rough,
    registered_start,
    shake,
    with_others,
)
from sl_nerfstudio.bundle_adjustment.parameters import (
    UNKNOWNS,
    PosePrior,
    RefinePoses,
    baseline_scale,
    restore,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import (
    AdjustmentSettings,
    SearchProblem,
    problem_of,
    search,
    unplaced_frames,
)
from sl_nerfstudio.geometry.lie import exp_se3, inverse, log_se3, log_so3

from . import analytic
from .analytic import ExactMaps, disturbed, images_of, prior_of, rig_of, rough_prior, turned, turns_deg

FRAMES, SIZE, LOST = 6, 100, 2
SETTINGS = AdjustmentSettings(anchors_per_frame=100, frames_per_anchor=3, max_iterations=20, other_minima=False)

ASKED = replace(SETTINGS, other_minima=True)


@pytest.fixture(scope="module")
def true():
    return rig_of(FRAMES, SIZE)


@pytest.fixture(scope="module")
def exact(true):
    return ExactMaps.around(true, SIZE)


@pytest.fixture()
def without_surfaces(monkeypatch):
    """Hops from drawn poses alone."""
    monkeypatch.setattr(modes, "registered_start", lambda *_: None)


@pytest.fixture()
def searches(monkeypatch):
    """Where searches began."""
    begun = []

    def counted(problem: SearchProblem, refine: RefinePoses):
        begun.append(problem.begin)
        return search(problem, refine)

    monkeypatch.setattr(modes, "search", counted)
    return begun


def aligned_deg(rig: Rig, true: Rig) -> float:
    """Largest rotation of a frame from where it truly is, when all are aligned as one."""
    aligned = restore(true, rig, baseline_scale(true, rig, None))
    turn = inverse(true.T_world_camera) @ aligned.T_world_camera
    return float(torch.rad2deg(log_so3(turn[:, :3, :3]).norm(dim=-1)).max())


@pytest.mark.slow
def test_two_frames_that_agree_at_a_wrong_place_are_let_out(true, exact, searches, monkeypatch, without_surfaces):
    """Each alone would be found by its residuals; together they pass for placed."""
    monkeypatch.setattr(modes, "unplaced_frames", lambda *_: ())  # in a scene of six they do not
    away = exp_se3(torch.tensor([0.05, -0.04, 0.02, 0.05, 0.09, -0.07], dtype=torch.float64))
    cameras = true.T_world_camera.clone()
    cameras[4:] = away @ cameras[4:]
    problem = problem_of(replace(true, T_world_camera=cameras), exact, rough_prior(FRAMES, 3.0), SETTINGS)
    stuck = search(problem, "known-rig")[0]
    stuck = replace(stuck, state=replace(stuck.state, rig=problem.start))
    found = explore(problem, "known-rig", stuck)
    assert float(turns_deg(problem.start, true).max()) > 5 and len(searches) > 0
    assert float(turns_deg(found.rig, true).max()) < 0.01


@pytest.mark.slow
def test_a_right_result_is_kept_after_one_search_that_leads_back(true, exact, searches, without_surfaces):
    problem = problem_of(disturbed(true, 1, degrees=1.0), exact, rough_prior(FRAMES, 3.0), SETTINGS)
    first = search(problem, "known-rig")[0]
    assert explore(problem, "known-rig", first) == Explored(problem, "known-rig", first, (), True)
    assert len(searches) == 1
    assert float(turns_deg(searches[0], first.state.rig).max()) > 0.1  # it did not begin where it ended


@pytest.fixture(scope="module")
def first(true, exact):
    """The end of a search from the truth."""
    return search(problem_of(true, exact, rough_prior(FRAMES, 3.0), SETTINGS), "known-rig")[0]


def test_searches_that_end_elsewhere_and_are_less_probable_are_other_ends_until_patience_is_over(
    true, exact, first, monkeypatch, without_surfaces
):
    monkeypatch.setattr(modes, "_PATIENCE", 3)
    problem, ends = problem_of(true, exact, rough_prior(FRAMES, 3.0), SETTINGS), []

    def nowhere(problem: SearchProblem, refine: RefinePoses):
        ends.append(replace(first, state=replace(first.state, rig=problem.begin)))
        return ends[-1], 1.0

    monkeypatch.setattr(modes, "search", nowhere)
    found = explore(problem, "known-rig", first)
    assert found.best is first and not found.settled and len(ends) == 3
    assert all(a is b for a, b in zip(found.others, ends, strict=True))


@pytest.mark.slow
def test_ends_as_probable_widen_the_covariance_by_what_they_differ_and_others_by_nothing(true, exact, first):
    """Along the directions in which they differ, whatever is said there already."""
    problem = problem_of(true, exact, rough_prior(FRAMES, 3.0), ASKED)
    factor = torch.zeros(12 * FRAMES + UNKNOWNS, 1, dtype=torch.float64)

    def wider(*degrees: float) -> torch.Tensor:
        rigs = [turned(first.state.rig, LOST, d) for d in degrees]
        ends = tuple(replace(first, state=replace(first.state, rig=rig)) for rig in rigs)
        found, others = with_others(Explored(problem, "known-rig", noisy, ends), factor, ())
        assert not others
        return (found @ found.T)[:-UNKNOWNS, :-UNKNOWNS]

    noisy = replace(first, noise=0.5)
    small, again, large = (departure_of(turned(first.state.rig, LOST, d), first.state.rig) for d in (0.01, -0.01, 8.0))
    wanted = (torch.outer(small, small) + torch.outer(again, again)) / 2
    assert float((wider(0.01, -0.01) - wanted).abs().max()) < 0.05 * float(wanted.max())
    assert float((wider(0.01, -0.01, 8.0) - wanted).abs().max()) < 0.05 * float(wanted.max()) < float(large.max())


@pytest.mark.parametrize(
    ("degrees", "refine", "asked", "most_frames"),
    [(1.4, "free", True, 100), (3.0, "static-projector", True, 100), (3.0, "free", False, 100), (3.0, "free", True, 5)],
)
def test_no_further_search_where_starts_are_good_or_frames_cannot_move_or_nobody_asks(
    true, exact, first, searches, monkeypatch, degrees, refine, asked, most_frames
):
    monkeypatch.setattr(modes, "_MOST_FRAMES", most_frames)
    problem = problem_of(true, exact, rough_prior(FRAMES, degrees), replace(SETTINGS, further_searches=asked))
    assert explore(problem, refine, first).best is first and searches == []


def test_the_median_frame_decides_what_is_rough():
    rotation = torch.tensor([radians(d) for d in (0.5, 0.5, 2.0, 3.0, 9.0)], dtype=torch.float64)
    prior = PosePrior(rotation, rotation, rotation, rotation)
    assert is_rough(prior, 1.99) and not is_rough(prior, 2.01)


@pytest.mark.parametrize(("lost", "empty"), [((), ()), ((2,), ()), ((1, 4), ()), ((), (3,))])
def test_frames_that_see_too_little_of_what_the_others_agree_on_are_unplaced(true, lost, empty):
    rig, images = true, images_of(true, SIZE)
    for frame in lost:
        rig = turned(rig, frame, 5.0)
    for frame in empty:
        images[frame][:] = float("nan")
    assert unplaced_frames(rig, CoordinateMaps.of(images), 0.1, AdjustmentSettings()) == lost + empty


# Registered surfaces: a start that is near the truth however far off the given one is.

_EXACT = 0.5  # degrees: what images of 100 pixels and 100 look-ups of each frame allow


@pytest.fixture(scope="module")
def maps(true):
    return CoordinateMaps.of(images_of(true, SIZE))


@pytest.mark.slow
@pytest.mark.parametrize("refine", ["free", "known-rig"])
def test_frames_that_are_8_degrees_off_begin_within_one(true, maps, refine):
    start = disturbed(true, 3, degrees=8.0, shift=0.1, relative=0.03)
    problem = problem_of(start, maps, rough_prior(FRAMES, 8.0), SETTINGS)
    found = registered_start(problem, refine, start, range(FRAMES))
    assert found is not None
    assert aligned_deg(start, true) > 5 and aligned_deg(found, true) < 1
    if refine != "free":
        assert torch.equal(found.T_camera_projector, start.T_camera_projector)
    assert (found.baseline / start.baseline).numpy() == pytest.approx(np.ones(FRAMES), abs=0.02)  # it keeps its size
    # and its place: what all starts share is where the scene is
    assert aligned_deg(replace(start, T_world_camera=found.T_world_camera), start) < 12


@pytest.mark.slow
def test_frames_of_which_hardly_anything_was_decoded_stay_where_they_are(true, maps):
    images = [maps.image(k).clone() for k in range(FRAMES)]
    images[LOST][:] = float("nan")
    start = disturbed(true, 3, degrees=4.0, shift=0.05)
    problem = problem_of(start, CoordinateMaps.of(images), rough_prior(FRAMES, 4.0), SETTINGS)
    found = registered_start(problem, "free", start, range(FRAMES))
    assert found is not None
    assert torch.equal(found.T_world_camera[LOST], start.T_world_camera[LOST])
    empty = CoordinateMaps.of([torch.full_like(image, float("nan")) for image in images])
    assert registered_start(replace(problem, maps=empty), "free", start, range(FRAMES)) is None


@pytest.mark.slow
def test_the_first_further_search_begins_there(true, maps, searches, monkeypatch):
    """A start from which a search ends elsewhere is left at once, and drawn poses only confirm the new end."""
    start = disturbed(true, 5, degrees=12.0, shift=0.2)
    problem = problem_of(start, maps, rough_prior(FRAMES, 12.0), SETTINGS)
    monkeypatch.setattr(modes, "_MOST_HOPS", 1)
    first = search(problem, "known-rig")
    assert first is not None
    found = explore(problem, "known-rig", first[0])
    assert aligned_deg(searches[0], true) < 1 < aligned_deg(start, true)
    assert aligned_deg(found.rig, true) < _EXACT < 1 < aligned_deg(first[0].state.rig, true)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [90.0, 150.0])
def test_a_frame_that_is_far_off_is_found_by_its_surface(true, maps, degrees):
    start = turned(disturbed(true, 4, degrees=0.5, shift=0.01), LOST, degrees)
    prior = rough_prior(FRAMES, 1.0)
    named = adjust(start, maps, prior, "free", replace(SETTINGS, further_searches=False))
    assert named.unplaced == (LOST,)
    found = adjust(start, maps, prior, "free", SETTINGS)
    assert found.unplaced == () and aligned_deg(found.rig, true) < _EXACT
    others = torch.arange(FRAMES) != LOST
    assert torch.equal(found.start.T_world_camera[others], start.T_world_camera[others])
    assert torch.equal(found.start.T_camera_projector, start.T_camera_projector)
    # the scene is put where the others were given, whatever was said about the lost one
    rig = restore(found.start, found.rig, baseline_scale(found.start, found.rig, None))
    away = (inverse(start.T_world_camera) @ rig.T_world_camera)[others]
    assert float(torch.rad2deg(log_so3(away[:, :3, :3]).norm(dim=-1)).max()) < 1.5


# Objects that look the same from two sides.

ALIKE = ((0.4, 0.15, 0.0, 0.28), (-0.4, -0.15, 0.0, 0.28))  # balls that half a turn about the axis exchanges
MARK = (0.1, -0.45, -0.1, 0.2)
HALF_A_TURN = torch.tensor([0, 0, 0, 0, 0, 1.0], dtype=torch.float64) * radians(180)


def other_side(rig: Rig, frames: list[int]) -> Rig:
    """Some frames after half a turn about the axis."""
    delta = torch.zeros(rig.frames, 6, dtype=torch.float64)
    delta[frames] = HALF_A_TURN
    return rig.moved(delta, torch.zeros_like(delta))


@pytest.mark.parametrize(("frames", "mark"), [([LOST], ()), ([1, 2], ()), ([LOST], (MARK,))])
@pytest.mark.parametrize("at_the_result", [False, True])
def test_an_object_with_two_equal_sides_has_two_modes_unless_a_mark_tells_them_apart(
    true, first, frames, mark, at_the_result, monkeypatch
):
    monkeypatch.setattr(analytic, "BALLS", (*ALIKE, *mark))
    maps = CoordinateMaps.of(images_of(true, SIZE))
    problem = problem_of(true, maps, prior_of(FRAMES, *[1e6] * 4), ASKED)
    rigs = (true, other_side(true, frames))
    best, other = (
        replace(first, state=replace(first.state, rig=rig), noise=0.1)
        for rig in (reversed(rigs) if at_the_result and not mark else rigs)
    )
    factor = torch.zeros(12 * FRAMES + UNKNOWNS, 1, dtype=torch.float64)
    found, said = with_others(Explored(problem, "known-rig", best, (other, other)), factor, ())
    assert torch.equal(found, factor) and len(said) == (0 if mark else 1)  # the sigma is that of the result's own mode
    for mode in said:
        assert abs(mode.log_odds) < 2 * mode.error < 10 and mode.frames == tuple(frames)
        assert mode.angle_deg == pytest.approx(180, abs=0.01) and abs(mode.axis[2]) == pytest.approx(1, abs=1e-6)


# Increments between rigs.

SIGMAS = (0.03, radians(1.0), 0.01, radians(0.3))
PRIOR = prior_of(FRAMES, *SIGMAS, intrinsics=0.0)


def random_factor(seed: int) -> torch.Tensor:
    A = torch.randn(12 * FRAMES + 6, 80, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return A / 80**0.5


def test_a_shake_has_the_covariance_of_the_poses_given_the_intrinsics():
    factor, generator, k = random_factor(0), torch.Generator().manual_seed(1), 12 * FRAMES
    draws = torch.stack([shake(factor, 2.0, generator) for _ in range(1000)])
    wanted = torch.linalg.inv(torch.linalg.inv(factor @ factor.T)[:k, :k])  # precision of the poses alone
    assert float(((draws.T @ draws / 1000 / 4 - wanted) / wanted.diagonal().max()).abs().max()) < 0.2
    factor[k:] = 0  # intrinsics that are exact change nothing
    alone = shake(factor, 1.0, torch.Generator().manual_seed(2))
    assert alone.isfinite().all() and float(alone.abs().max()) > 0.1
    one = torch.zeros(k, dtype=torch.float64)
    assert farthest_frame(factor, one) == 0
    one[6:12] = 3 * factor[6:12].norm(dim=1)
    assert farthest_frame(factor, one) == pytest.approx(3)


def test_moving_and_scaling_all_frames_is_no_departure():
    rig = rig_of(FRAMES, SIZE)
    motion = exp_se3(torch.tensor([0.2, -0.1, 0.3, 0.5, -0.4, 0.3], dtype=torch.float64))
    moved = replace(rig.scaled(1.7), T_world_camera=motion @ rig.scaled(1.7).T_world_camera)
    assert float(departure_of(moved, rig).abs().max()) < 1e-9
    own = torch.zeros(FRAMES, 6, dtype=torch.float64)
    own[2, 4] = 1e-3
    assert float(departure_of(rig.moved(own, 0 * own), rig).norm()) > 5e-4


@pytest.mark.parametrize("with_projectors", [False, True])
def test_drawn_starts_scatter_as_the_prior_states(with_projectors):
    rig, generator = rig_of(FRAMES, SIZE), torch.Generator().manual_seed(0)
    starts = [drawn_start(rig, PRIOR, with_projectors, generator) for _ in range(300)]
    delta = torch.stack([log_se3(s.T_world_camera @ inverse(rig.T_world_camera)) for s in starts])
    T, there = rig.T_camera_projector, torch.stack([s.T_camera_projector for s in starts])
    turn = log_so3(there[..., :3, :3] @ T[:, :3, :3].transpose(1, 2))
    parts = (delta[..., :3], delta[..., 3:], there[..., :3, 3] - T[:, :3, 3], turn)
    wanted = [s if with_projectors or k < 2 else 0 for k, s in enumerate(SIGMAS)]
    assert [float(p.pow(2).mean().sqrt()) for p in parts] == pytest.approx(wanted, rel=0.1, abs=1e-12)
