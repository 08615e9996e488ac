"""After rough starts further searches let frames out of minima of their own; what is already right is left at once."""

from dataclasses import replace
from math import radians

import pytest
import torch

from sl_nerfstudio.bundle_adjustment import adjust as adjustment
from sl_nerfstudio.bundle_adjustment import adjust as hops
from sl_nerfstudio.bundle_adjustment.adjust import Hopped, adjust, hopped, is_rough
from sl_nerfstudio.bundle_adjustment.covariance import departure_of
from sl_nerfstudio.bundle_adjustment.parameters import PosePrior, RefinePoses
from sl_nerfstudio.bundle_adjustment.search import (
    AdjustmentSettings,
    HopSettings,
    SearchProblem,
    SearchProgress,
    problem_of,
    search,
)
from sl_nerfstudio.geometry.lie import exp_se3, inverse, log_so3

from .analytic import ExactMaps, disturbed, rig_of, rough_prior

FRAMES, SIZE = 6, 100
SETTINGS = AdjustmentSettings(anchors_per_frame=100, frames_per_anchor=3, max_iterations=20)


@pytest.fixture(scope="module")
def true():
    return rig_of(FRAMES, SIZE)


@pytest.fixture(autouse=True)
def without_surfaces(monkeypatch):
    """Hops from drawn poses alone; for those from surfaces see test_registered_start."""
    monkeypatch.setattr(hops, "registered_start", lambda *_: None)


def problem_from(start, true, degrees: float = 3.0, **changed) -> SearchProblem:
    settings = replace(SETTINGS, hops=replace(HopSettings(), **changed))
    return problem_of(start, ExactMaps.around(true, SIZE), rough_prior(FRAMES, degrees), settings)


@pytest.fixture()
def searches(monkeypatch):
    """Where searches began."""
    begun = []

    def counted(problem: SearchProblem, refine: RefinePoses):
        begun.append(problem.begin)
        return search(problem, refine)

    monkeypatch.setattr(hops, "search", counted)
    return begun


def turns_deg(rig, other) -> list[float]:
    """Of each frame against another rig, when their first frames coincide."""
    a, b = (inverse(r.T_world_camera[:1]) @ r.T_world_camera for r in (rig, other))
    return torch.rad2deg(log_so3((a @ inverse(b))[:, :3, :3]).norm(dim=-1)).tolist()


def test_two_frames_that_agree_at_a_wrong_place_are_let_out(true, searches, monkeypatch):
    """Each alone would be found by its residuals; together they pass for placed."""
    monkeypatch.setattr(hops, "unplaced_frames", lambda *_: ())  # in a scene of six they do not
    away = exp_se3(torch.tensor([0.05, -0.04, 0.02, 0.05, 0.09, -0.07], dtype=torch.float64))
    cameras = true.T_world_camera.clone()
    cameras[4:] = away @ cameras[4:]
    problem = problem_from(replace(true, T_world_camera=cameras), true)
    stuck = search(problem, "known-rig")[0]
    stuck = replace(stuck, state=replace(stuck.state, rig=problem.start))
    found = hopped(problem, "known-rig", stuck).best
    assert max(turns_deg(problem.start, true)) > 5 and len(searches) > 0
    assert max(turns_deg(found.state.rig, true)) < 0.01


def test_a_right_result_is_kept_after_one_search_that_leads_back(true, searches):
    problem = problem_from(disturbed(true, 1, degrees=1.0), true)
    first = search(problem, "known-rig")[0]
    searches.clear()
    assert hopped(problem, "known-rig", first) == Hopped(first, (), True)
    assert len(searches) == 1
    begun = torch.tensor(turns_deg(searches[0], first.state.rig))
    assert float(begun.max()) > 0.1  # it did not begin where it ended


def test_searches_that_end_elsewhere_and_explain_less_are_other_ends_until_patience_is_over(true, monkeypatch):
    problem = problem_from(true, true, patience=3)
    first = search(problem, "known-rig")[0]
    ends = []

    def nowhere(problem: SearchProblem, refine: RefinePoses):
        ends.append(replace(first, state=replace(first.state, rig=problem.begin)))
        return ends[-1], 1.0

    monkeypatch.setattr(hops, "search", nowhere)
    found = hopped(problem, "known-rig", first)
    assert found.best is first and not found.settled and len(ends) == 3
    assert all(a is b for a, b in zip(found.others, ends, strict=True))


@pytest.mark.parametrize("worse", [False, True])
def test_other_ends_that_fit_as_well_widen_the_covariance_by_what_they_differ(true, monkeypatch, worse):
    problem = problem_from(true, true, degrees=1.0)
    step = torch.zeros(2, FRAMES, 6, dtype=torch.float64)
    step[0, 2, 4] = 1e-3

    def with_another(problem: SearchProblem, refine: RefinePoses, found: SearchProgress) -> Hopped:
        return Hopped(found, (replace(found, state=replace(found.state, rig=found.state.rig.moved(*step))),), True)

    monkeypatch.setattr(adjustment, "_MOST_LEFT", 1e9)
    monkeypatch.setattr(adjustment, "_WORSE", 1.4 if worse else 1e30)  # residuals are 1e-9 px
    settings = SETTINGS
    alone = adjust(problem.start, problem.maps, problem.prior, "known-rig", settings)
    monkeypatch.setattr(adjustment, "hopped", with_another)
    found = adjust(problem.start, problem.maps, problem.prior, "known-rig", settings)
    assert torch.equal(found.rig.T_world_camera, alone.rig.T_world_camera)
    other = departure_of(alone.rig.moved(*step), alone.rig)
    more = found.covariance - alone.covariance
    wanted = torch.zeros_like(more) if worse else torch.outer(other, other)
    assert float((more - wanted).abs().max()) < 1e-12


@pytest.mark.parametrize(
    ("degrees", "refine", "changed"),
    [(1.4, "free", {}), (3.0, "static-projector", {}), (3.0, "free", {"most": 0}), (3.0, "free", {"most_frames": 5})],
)
def test_no_further_search_where_starts_are_good_or_frames_cannot_move_or_nobody_asks(
    true, searches, degrees, refine, changed
):
    problem = problem_from(true, true, degrees, **changed)
    first = search(problem, "free")[0]
    searches.clear()
    assert hopped(problem, refine, first).best is first and searches == []


def test_the_median_frame_decides_what_is_rough():
    rotation = torch.tensor([radians(d) for d in (0.5, 0.5, 2.0, 3.0, 9.0)], dtype=torch.float64)
    prior = PosePrior(rotation, rotation, rotation, rotation)
    assert is_rough(prior, 1.99) and not is_rough(prior, 2.01)
