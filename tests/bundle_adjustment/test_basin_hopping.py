"""After rough starts further searches let frames out of minima of their own; what is already right is left at once.

Ends of searches are compared by what both explain: a nearly round object is where counting look-ups goes wrong.
"""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
import torch

from sl_nerfstudio.bundle_adjustment import adjust as adjustment
from sl_nerfstudio.bundle_adjustment import basin_hopping
from sl_nerfstudio.bundle_adjustment.adjust import adjust
from sl_nerfstudio.bundle_adjustment.basin_hopping import Hopped, hopped, is_rough, log_odds, registered_start
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import departure_of
from sl_nerfstudio.bundle_adjustment.parameters import (
    USUAL_FRAME_ROTATION_DEG,
    PosePrior,
    RefinePoses,
    baseline_scale,
    restore,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import (
    AdjustmentSettings,
    SearchProblem,
    SearchProgress,
    problem_of,
    search,
)
from sl_nerfstudio.geometry.lie import exp_se3, inverse, log_so3

from . import analytic
from .analytic import ExactMaps, disturbed, images_of, prior_of, rig_of, rough_prior, turned

FRAMES, SIZE, LOST = 6, 100, 2
SETTINGS = AdjustmentSettings(anchors_per_frame=100, frames_per_anchor=3, max_iterations=20, other_minima=0)


@pytest.fixture(scope="module")
def true():
    return rig_of(FRAMES, SIZE)


@pytest.fixture(scope="module")
def exact(true):
    return ExactMaps.around(true, SIZE)


@pytest.fixture()
def without_surfaces(monkeypatch):
    """Hops from drawn poses alone."""
    monkeypatch.setattr(basin_hopping, "registered_start", lambda *_: None)


@pytest.fixture()
def searches(monkeypatch):
    """Where searches began."""
    begun = []

    def counted(problem: SearchProblem, refine: RefinePoses):
        begun.append(problem.begin)
        return search(problem, refine)

    monkeypatch.setattr(basin_hopping, "search", counted)
    return begun


def turns_deg(rig: Rig, other: Rig) -> torch.Tensor:
    """Rotation of each frame against another rig, when their first frames coincide."""
    a, b = (inverse(r.T_world_camera[:1]) @ r.T_world_camera for r in (rig, other))
    return torch.rad2deg(log_so3((a @ inverse(b))[:, :3, :3]).norm(dim=-1))


def aligned_deg(rig: Rig, true: Rig) -> float:
    """Largest rotation of a frame from where it truly is, when all are aligned as one."""
    aligned = restore(true, rig, baseline_scale(true, rig, None))
    turn = inverse(true.T_world_camera) @ aligned.T_world_camera
    return float(torch.rad2deg(log_so3(turn[:, :3, :3]).norm(dim=-1)).max())


@pytest.mark.slow
def test_two_frames_that_agree_at_a_wrong_place_are_let_out(true, exact, searches, monkeypatch, without_surfaces):
    """Each alone would be found by its residuals; together they pass for placed."""
    monkeypatch.setattr(basin_hopping, "unplaced_frames", lambda *_: ())  # in a scene of six they do not
    away = exp_se3(torch.tensor([0.05, -0.04, 0.02, 0.05, 0.09, -0.07], dtype=torch.float64))
    cameras = true.T_world_camera.clone()
    cameras[4:] = away @ cameras[4:]
    problem = problem_of(replace(true, T_world_camera=cameras), exact, rough_prior(FRAMES, 3.0), SETTINGS)
    stuck = search(problem, "known-rig")[0]
    stuck = replace(stuck, state=replace(stuck.state, rig=problem.start))
    found = hopped(problem, "known-rig", stuck).best
    assert float(turns_deg(problem.start, true).max()) > 5 and len(searches) > 0
    assert float(turns_deg(found.state.rig, true).max()) < 0.01


@pytest.mark.slow
def test_a_right_result_is_kept_after_one_search_that_leads_back(true, exact, searches, without_surfaces):
    problem = problem_of(disturbed(true, 1, degrees=1.0), exact, rough_prior(FRAMES, 3.0), SETTINGS)
    first = search(problem, "known-rig")[0]
    assert hopped(problem, "known-rig", first) == Hopped(first, (), True)
    assert len(searches) == 1
    assert float(turns_deg(searches[0], first.state.rig).max()) > 0.1  # it did not begin where it ended


@pytest.fixture(scope="module")
def first(true, exact):
    """The end of a search from the truth."""
    return search(problem_of(true, exact, rough_prior(FRAMES, 3.0), SETTINGS), "known-rig")[0]


def test_searches_that_end_elsewhere_and_are_less_probable_are_other_ends_until_patience_is_over(
    true, exact, first, monkeypatch, without_surfaces
):
    monkeypatch.setattr(basin_hopping, "_PATIENCE", 3)
    problem, ends = problem_of(true, exact, rough_prior(FRAMES, 3.0), SETTINGS), []

    def nowhere(problem: SearchProblem, refine: RefinePoses):
        ends.append(replace(first, state=replace(first.state, rig=problem.begin)))
        return ends[-1], 1.0

    monkeypatch.setattr(basin_hopping, "search", nowhere)
    found = hopped(problem, "known-rig", first)
    assert found.best is first and not found.settled and len(ends) == 3
    assert all(a is b for a, b in zip(found.others, ends, strict=True))


@pytest.mark.slow
def test_other_ends_that_fit_as_well_widen_the_covariance_by_what_they_differ(true, exact, monkeypatch):
    prior, settings = rough_prior(FRAMES, 1.0), replace(SETTINGS, other_minima=3)
    step = torch.zeros(2, FRAMES, 6, dtype=torch.float64)
    step[0, 2, 4] = 1e-3

    def with_another(problem: SearchProblem, refine: RefinePoses, found: SearchProgress) -> Hopped:
        return Hopped(found, (replace(found, state=replace(found.state, rig=found.state.rig.moved(*step))),), True)

    monkeypatch.setattr(adjustment, "MOST_LEFT", 1e9)
    alone = adjust(true, exact, prior, "known-rig", settings)
    monkeypatch.setattr(adjustment, "hopped", with_another)
    other = departure_of(alone.rig.moved(*step), alone.rig)
    for worse, wanted in ((1.4, 0.0 * torch.outer(other, other)), (1e30, torch.outer(other, other))):
        monkeypatch.setattr(adjustment, "_WORSE", worse)  # residuals are 1e-9 px
        found = adjust(true, exact, prior, "known-rig", settings)
        assert torch.equal(found.rig.T_world_camera, alone.rig.T_world_camera)
        assert float((found.covariance - alone.covariance - wanted).abs().max()) < 1e-12


@pytest.mark.parametrize(
    ("degrees", "refine", "hops", "most_frames"),
    [(1.4, "free", 12, 100), (3.0, "static-projector", 12, 100), (3.0, "free", 0, 100), (3.0, "free", 12, 5)],
)
def test_no_further_search_where_starts_are_good_or_frames_cannot_move_or_nobody_asks(
    true, exact, first, searches, monkeypatch, degrees, refine, hops, most_frames
):
    monkeypatch.setattr(basin_hopping, "MOST_FRAMES", most_frames)
    problem = problem_of(true, exact, rough_prior(FRAMES, degrees), replace(SETTINGS, hops=hops))
    assert hopped(problem, refine, first).best is first and searches == []


def test_the_median_frame_decides_what_is_rough():
    rotation = torch.tensor([radians(d) for d in (0.5, 0.5, 2.0, 3.0, 9.0)], dtype=torch.float64)
    prior = PosePrior(rotation, rotation, rotation, rotation)
    assert is_rough(prior, 1.99) and not is_rough(prior, 2.01)


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
def test_the_first_hop_begins_there(true, maps, searches):
    """A start from which a search ends elsewhere is left at once, and drawn poses only confirm the new end."""
    start = disturbed(true, 5, degrees=12.0, shift=0.2)
    problem = problem_of(start, maps, rough_prior(FRAMES, 12.0), replace(SETTINGS, hops=2))
    first = search(problem, "known-rig")
    assert first is not None
    found = hopped(problem, "known-rig", first[0]).best
    assert aligned_deg(searches[0], true) < 1 < aligned_deg(start, true)
    assert aligned_deg(found.state.rig, true) < _EXACT < 5 < aligned_deg(first[0].state.rig, true)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [90.0, 150.0])
def test_a_frame_that_is_far_off_is_found_by_its_surface(true, maps, degrees):
    start = turned(disturbed(true, 4, degrees=0.5, shift=0.01), LOST, degrees)
    prior = rough_prior(FRAMES, 1.0)
    named = adjust(start, maps, prior, "free", replace(SETTINGS, lost_by_surface=False))
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


# Ends of searches on a nearly round object.

MANY = 10
ROUND = (0.0, 0.0, 0.0, 0.45)  # a ball on the axis of the disk
FEATURE = (0.25, 0.0, 0.38, 0.12)  # a smaller one on it, the only thing that shows how the object is turned
LARGER = (0.3, 0.0, 0.3, 0.25)
ONE_HOP = replace(SETTINGS, anchors_per_frame=200, frames_per_anchor=8, hops=1)
UNSTATED_DEG = USUAL_FRAME_ROTATION_DEG
NOTHING_KNOWN = prior_of(MANY, *[1e6] * 4)


@pytest.fixture(scope="module")
def ring():
    return rig_of(MANY, SIZE)


def noisy_maps(ring: Rig, *balls: tuple[float, float, float, float]) -> CoordinateMaps:
    """Coordinates of such balls over a disk, with 0.3 px of noise."""
    generator = torch.Generator().manual_seed(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analytic, "BALLS", balls)
        images = images_of(ring, SIZE)
    return CoordinateMaps.of(i + 0.3 * torch.randn(i.shape, generator=generator) for i in images)


@pytest.fixture(scope="module")
def featured_maps(ring):
    return noisy_maps(ring, ROUND, FEATURE)


@pytest.fixture(scope="module")
def round_maps(ring):
    return noisy_maps(ring, ROUND)


def piled(rig: Rig) -> Rig:
    """All frames turned about the object's axis to where the first one is."""
    turn = torch.zeros(MANY, 6, dtype=torch.float64)
    turn[:, 5] = -torch.arange(MANY) * radians(360 / MANY)
    return rig.moved(turn, torch.zeros_like(turn))


def ends_at(problem: SearchProblem, *rigs: Rig) -> list[SearchProgress]:
    """Ends of searches with the same noise."""
    found = search(replace(problem, settings=replace(ONE_HOP, max_iterations=1)), "known-rig")
    assert found is not None
    return [replace(found[0], state=replace(found[0].state, rig=rig), noise=0.1) for rig in rigs]


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [UNSTATED_DEG, 2.5])
def test_frames_of_a_round_object_are_not_piled_up_on_one_side(ring, featured_maps, monkeypatch, degrees):
    """Starts are right to 1.7 degrees, stated or not; a registration of the surfaces says otherwise."""
    monkeypatch.setattr(basin_hopping, "registered_start", lambda *_: piled(ring))
    start = disturbed(ring, 1, degrees=1.7)
    found = adjust(start, featured_maps, rough_prior(MANY, degrees), "known-rig", ONE_HOP)
    left = turns_deg(found.rig, ring)
    assert float(left.median()) < 0.5 and float(left.max()) < float(turns_deg(start, ring).max()) < 4


def test_what_contradicts_costs_whatever_else_is_seen(ring):
    problem = problem_of(ring, noisy_maps(ring, ROUND, LARGER), NOTHING_KNOWN, ONE_HOP)
    right, wrong = ends_at(problem, ring, piled(ring))
    assert log_odds(problem, right, wrong) > 150


def test_seeing_each_other_more_is_no_evidence_and_leaving_the_starting_poses_costs_what_the_prior_says(
    ring, round_maps
):
    """Wherever frames are turned about the axis of a body of revolution, they agree.

    What is hidden from where they belong, a fifth of all, is no contradiction: 680 nats, if it were. What is left are
    look-ups that are more oblique there.
    """
    problem, known = (problem_of(ring, round_maps, p, ONE_HOP) for p in (NOTHING_KNOWN, rough_prior(MANY, 12.0)))
    right, wrong = ends_at(problem, ring, piled(ring))
    odds = log_odds(problem, wrong, right)
    assert abs(odds) < 7 * MANY
    turn = torch.arange(MANY) * 360.0 / MANY
    prior = float((torch.minimum(turn, 360 - turn) / 12.0).square().sum()) / 2
    assert odds - log_odds(known, wrong, right) == pytest.approx(prior, rel=1e-6)


def test_the_odds_of_two_ends_are_opposite(ring, featured_maps):
    problem = problem_of(ring, featured_maps, rough_prior(MANY, 2.0), ONE_HOP)
    right, beside = ends_at(problem, ring, disturbed(ring, 2, degrees=0.5))
    odds = log_odds(problem, right, beside)
    assert odds > basin_hopping._LEAST_ODDS and log_odds(problem, beside, right) == pytest.approx(-odds, abs=1e-6)
    assert log_odds(problem, right, right) == 0
