"""How far frames may have slid: as starting poses allow if nothing holds them, and no farther elsewhere."""

from dataclasses import replace
from math import radians

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.parameters import UNKNOWNS
from sl_nerfstudio.bundle_adjustment.posterior import frame_lead, many_pixels
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import (
    AdjustmentSettings,
    SearchProblem,
    SearchProgress,
    problem_of,
    search,
)
from sl_nerfstudio.bundle_adjustment.slides import how_far, least_known_motions, with_slides

from . import analytic
from .analytic import images_of, rig_of, rough_prior

FRAMES, SIZE, START_DEG, STATED_DEG = 8, 120, 2.0, 0.25
BALL = (0.0, 0.0, 0.0, 0.45)  # on the axis of the disk: a body of revolution
KNOBS = ((0.3, 0.0, 0.38, 0.2), (-0.2, 0.3, 0.36, 0.2))
SETTINGS = AdjustmentSettings(200, frames_per_anchor=4, max_iterations=20)
ABOUT_AXIS = torch.tensor([0, 0, 0, 0, 0, 1.0], dtype=torch.float64)


def found_at_truth(*balls: tuple[float, float, float, float]) -> tuple[SearchProblem, SearchProgress]:
    """Noisy coordinates of balls over a disk, searched from the truth; and the truth is where it ends."""
    true, generator = rig_of(FRAMES, SIZE), torch.Generator().manual_seed(3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analytic, "BALLS", balls)
        images = images_of(true, SIZE)
    maps = CoordinateMaps.of(i + 0.1 * torch.randn(i.shape, generator=generator) for i in images)
    problem = problem_of(true, maps, rough_prior(FRAMES, START_DEG), SETTINGS)
    end = search(problem, "known-rig")
    assert end is not None
    return problem, replace(end[0], state=replace(end[0].state, rig=true))


@pytest.fixture(scope="module")
def round_scene():
    return found_at_truth(BALL)


@pytest.fixture(scope="module")
def held_scene():
    return found_at_truth(BALL, *KNOBS)


def stated_factor() -> torch.Tensor:
    """Every frame known to the same small angle about every axis, and to the same share of the scene's radius."""
    factor = torch.zeros(12 * FRAMES + UNKNOWNS, 6 * FRAMES, dtype=torch.float64)
    factor[: 6 * FRAMES] = radians(STATED_DEG) * torch.eye(6 * FRAMES, dtype=torch.float64)
    return factor


def sigma_deg(factor: torch.Tensor, frame: int, motion: torch.Tensor) -> float:
    return float(torch.rad2deg((motion @ factor[6 * frame : 6 * frame + 6]).norm()))


def turned_about_axis(rig: Rig, frame: int, degrees: float) -> Rig:
    step = torch.zeros(FRAMES, 6, dtype=torch.float64)
    step[frame] = radians(degrees) * ABOUT_AXIS
    return rig.moved(step, torch.zeros_like(step))


def test_a_body_of_revolution_is_known_about_its_axis_as_well_as_the_starting_poses(round_scene):
    problem, found = round_scene
    motions = least_known_motions(problem, "known-rig", found)
    assert float((motions[:, :6] @ ABOUT_AXIS).abs().min()) > 0.95 and not motions[:, 6:].any()
    wider = with_slides(problem, "known-rig", found, stated_factor(), [0, 3])
    for frame in (0, 3):
        assert 0.4 * START_DEG < sigma_deg(wider, frame, ABOUT_AXIS) < 1.1 * START_DEG
        tilt = torch.tensor([0, 0, 0, 1.0, 0, 0], dtype=torch.float64)
        assert sigma_deg(wider, frame, tilt) < 3 * STATED_DEG
    assert torch.equal(wider[:, : 6 * FRAMES], stated_factor())
    assert sigma_deg(wider, 1, ABOUT_AXIS) == pytest.approx(STATED_DEG)  # not asked about


def test_knobs_hold_what_would_slide(held_scene):
    problem, found = held_scene
    wider = with_slides(problem, "known-rig", found, stated_factor(), list(range(FRAMES)))
    assert max(sigma_deg(wider, k, ABOUT_AXIS) for k in range(FRAMES)) < 1.5 * STATED_DEG


def test_the_place_of_a_frame_leads_where_details_say_so_and_both_ways_alike(round_scene, held_scene):
    rig = rig_of(FRAMES, SIZE)
    for degrees in (2.0, -2.0):
        there = turned_about_axis(rig, 2, degrees)
        leads: list[tuple[float, float]] = []
        for problem, found in (round_scene, held_scene):
            forth, back = (
                frame_lead(problem, *rigs, found.noise, 2, many_pixels(problem))
                for rigs in ((rig, there), (there, rig))
            )
            leads.append((forth, back))
        for forth, back in leads:
            assert forth == pytest.approx(-back, abs=1e-9)
        assert abs(leads[0][0]) < 1 < leads[1][0]
        assert [forth for forth, _ in leads] == sorted(forth for forth, _ in leads)
    assert frame_lead(held_scene[0], rig, rig, held_scene[1].noise, 2, many_pixels(held_scene[0])) == 0


@given(st.floats(1e-4, 1.0), st.floats(5.0, 500.0))
def test_a_parabola_adds_next_to_nothing_and_a_flat_likelihood_what_starting_poses_allow(sigma, times):
    """In whatever unit."""
    prior = times * sigma
    assert how_far(lambda distance: -abs(distance) / (2 * sigma), sigma, prior) < 0.15 * sigma
    assert how_far(lambda _: 0.0, sigma, prior) == pytest.approx(prior, rel=0.4)
    assert how_far(lambda _: -10.0, sigma, prior) < 1e-6 * sigma
    assert how_far(lambda _: 0.0, sigma, 1.5 * sigma) == 0  # there is nowhere else to be


def test_a_place_that_is_as_likely_again_beyond_unlikely_ones_counts():
    far = how_far(lambda d: 0.0 if 14 < d < 18 else -1.0, 1.0, 20.0)
    assert 10 < far < 16
    asked: list[float] = []
    how_far(lambda d: asked.append(d) or -2.5, 1.0, 20.0)
    assert asked == [4.0, -4.0]  # nothing farther off, once both sides are decided
