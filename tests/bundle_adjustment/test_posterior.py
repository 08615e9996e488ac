"""Ends of searches are compared by what both explain: a nearly round object is where counting look-ups goes wrong."""

from dataclasses import replace
from math import radians

import pytest
import torch

from sl_nerfstudio.bundle_adjustment import adjust as hops
from sl_nerfstudio.bundle_adjustment.adjust import adjust, log_odds
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.parameters import PosePrior
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import SearchProblem, SearchProgress, problem_of, search
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings, HopSettings, OtherMinimaSettings
from sl_nerfstudio.geometry.lie import inverse, log_so3
from sl_nerfstudio.model.pose_refinement import PriorConfig

from . import analytic
from .analytic import disturbed, images_of, rig_of, rough_prior

FRAMES, SIZE = 10, 100
ROUND = (0.0, 0.0, 0.0, 0.45)  # a ball on the axis of the disk
FEATURE = (0.25, 0.0, 0.38, 0.12)  # a smaller one on it, the only thing that shows how the object is turned
LARGER = (0.3, 0.0, 0.3, 0.25)
SETTINGS = AdjustmentSettings(
    anchors_per_frame=200,
    frames_per_anchor=8,
    max_iterations=20,
    other_minima=OtherMinimaSettings(searches=0),
    hops=HopSettings(most=1),
)
UNSTATED_DEG = PriorConfig().frame_rotation_deg


@pytest.fixture(scope="module")
def true():
    return rig_of(FRAMES, SIZE)


def noisy_maps(true: Rig, *balls: tuple[float, float, float, float]) -> CoordinateMaps:
    """Coordinates of such balls over a disk, with 0.3 px of noise."""
    generator = torch.Generator().manual_seed(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analytic, "BALLS", balls)
        images = images_of(true, SIZE)
    return CoordinateMaps.of(i + 0.3 * torch.randn(i.shape, generator=generator) for i in images)


@pytest.fixture(scope="module")
def maps(true):
    return noisy_maps(true, ROUND, FEATURE)


@pytest.fixture(scope="module")
def round_maps(true):
    return noisy_maps(true, ROUND)


def piled(rig: Rig) -> Rig:
    """All frames turned about the object's axis to where the first one is."""
    turn = torch.zeros(FRAMES, 6, dtype=torch.float64)
    turn[:, 5] = -torch.arange(FRAMES) * radians(360 / FRAMES)
    return rig.moved(turn, torch.zeros_like(turn))


def turns_deg(rig: Rig, other: Rig) -> torch.Tensor:
    """Of each frame against another rig, when their first frames coincide."""
    a, b = (inverse(r.T_world_camera[:1]) @ r.T_world_camera for r in (rig, other))
    return torch.rad2deg(log_so3((a @ inverse(b))[:, :3, :3]).norm(dim=-1))


def ends_at(problem: SearchProblem, *rigs: Rig) -> list[SearchProgress]:
    """Ends of searches with the same noise."""
    found = search(problem, "known-rig")
    assert found is not None
    return [replace(found[0], state=replace(found[0].state, rig=rig), noise=0.1) for rig in rigs]


@pytest.mark.parametrize("degrees", [UNSTATED_DEG, 2.5])
def test_frames_of_a_round_object_are_not_piled_up_on_one_side(true, maps, monkeypatch, degrees):
    """Starts are right to 1.7 degrees, stated or not; a registration of the surfaces says otherwise."""
    monkeypatch.setattr(hops, "registered_start", lambda *_: piled(true))
    start = disturbed(true, 1, degrees=1.7)
    found = adjust(start, maps, rough_prior(FRAMES, degrees), "known-rig", SETTINGS)
    left = turns_deg(found.rig, true)
    assert float(left.median()) < 0.5 and float(left.max()) < float(turns_deg(start, true).max()) < 4


@pytest.fixture(scope="module")
def nothing_known():
    """A prior that says next to nothing."""
    return PosePrior(*(torch.full((FRAMES,), 1e6, dtype=torch.float64) for _ in range(4)))


def test_what_contradicts_costs_whatever_else_is_seen(true, nothing_known):
    problem = problem_of(true, noisy_maps(true, ROUND, LARGER), nothing_known, SETTINGS)
    right, wrong = ends_at(problem, true, piled(true))
    assert log_odds(problem, right, wrong) > 150


def test_seeing_each_other_more_is_no_evidence(true, round_maps, nothing_known):
    """Wherever frames are turned about the axis of a body of revolution, they agree.

    What is hidden from where they belong, a fifth of all, is no contradiction: 680 nats, if it were. What is left are
    look-ups that are more oblique there.
    """
    problem = problem_of(true, round_maps, nothing_known, SETTINGS)
    right, wrong = ends_at(problem, true, piled(true))
    assert abs(log_odds(problem, wrong, right)) < 7 * FRAMES


def test_leaving_the_starting_poses_costs_what_the_prior_says(true, round_maps, nothing_known):
    known = rough_prior(FRAMES, 12.0)
    piled_up = piled(true)
    problem, unknown = (problem_of(true, round_maps, prior, SETTINGS) for prior in (known, nothing_known))
    right, wrong = ends_at(problem, true, piled_up)
    turn = torch.arange(FRAMES) * 360.0 / FRAMES
    turn = torch.minimum(turn, 360 - turn)
    prior = float((turn / 12.0).square().sum()) / 2
    lost = log_odds(unknown, wrong, right) - log_odds(problem, wrong, right)
    assert lost == pytest.approx(prior, rel=1e-6)


def test_the_odds_of_two_ends_are_opposite(true, maps):
    problem = problem_of(true, maps, rough_prior(FRAMES, 2.0), SETTINGS)
    right, beside = ends_at(problem, true, disturbed(true, 2, degrees=0.5))
    odds = log_odds(problem, right, beside)
    assert odds > HopSettings().least_gain and log_odds(problem, beside, right) == pytest.approx(-odds, abs=1e-6)
    assert log_odds(problem, right, right) == 0
