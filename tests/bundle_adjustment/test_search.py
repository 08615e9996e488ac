"""Frames in a wrong minimum are found by their residuals and moved to where the others support them."""

from dataclasses import replace
from math import radians

import pytest
import torch

from sl_nerfstudio.bundle_adjustment import search as searching
from sl_nerfstudio.bundle_adjustment.search import (
    AdjustmentSettings,
    Relocalised,
    find_lost_frames,
    frame_support,
    problem_of,
    relocalise,
)
from sl_nerfstudio.geometry.lie import exp_se3, inverse, log_so3

from .analytic import ExactMaps, prior_of, rig_of, turned

FRAMES, SIZE, LOST, NOISE = 6, 100, 2, 0.05
SETTINGS = AdjustmentSettings()
WHATEVER = torch.full((FRAMES,), float("inf"), dtype=torch.float64)
PRIOR = prior_of(FRAMES, 0.05, radians(3.0), 0.01, radians(0.3))


@pytest.fixture(scope="module")
def true():
    return rig_of(FRAMES, SIZE)


@pytest.fixture(scope="module")
def maps(true):
    return ExactMaps.around(true, SIZE)


def relocalised(rig, maps, mode="free", expected=WHATEVER):
    """Search for lost frames."""
    return relocalise(problem_of(rig, maps, PRIOR, SETTINGS), mode, rig, NOISE, expected)


@pytest.mark.parametrize("mode", ["free", "known-rig", "rigid-rig"])
def test_a_lost_frame_is_placed_and_no_other_moves(true, maps, mode):
    away = exp_se3(torch.tensor([0.08, -0.05, 0.04, 0.06, 0.05, -0.1], dtype=torch.float64))
    cameras = true.T_world_camera.clone()
    cameras[LOST] = away @ cameras[LOST]
    search = relocalised(replace(true, T_world_camera=cameras), maps, mode)
    rig, found = search.rig, search.rig.T_world_camera
    assert (search.found, search.in_vain) == ((LOST,), ())
    if mode != "free":
        assert torch.equal(rig.T_camera_projector, true.T_camera_projector)
    others = torch.arange(FRAMES) != LOST
    assert torch.equal(found[others], true.T_world_camera[others])
    off = inverse(true.T_world_camera[LOST]) @ found[LOST]
    assert float(log_so3(off[:3, :3]).norm()) < radians(0.01) and float(off[:3, 3].norm()) < 1e-3
    again = relocalised(rig, maps, mode)
    assert again == Relocalised(again.rig, (), ()) and torch.equal(again.rig.T_world_camera, found)  # all agree now


def test_lost_frames_are_those_with_little_support_best_first():
    shares = torch.tensor([0.8, 0.3, 0.85, 0.5, float("nan"), 0.9, 0.8], dtype=torch.float64)
    assert find_lost_frames(shares).tolist() == [3, 1]
    alike = torch.tensor([0.8, 0.8, 0.78, 0.8, 0.8], dtype=torch.float64)
    assert not len(find_lost_frames(alike))  # 2.5 % below equally good frames is not lost
    alike[2] = 0.7
    assert find_lost_frames(alike).tolist() == [2]


@pytest.mark.slow
def test_a_frame_that_agrees_as_well_as_is_expected_is_not_searched_for(true, maps):
    rig, expected = turned(true, LOST, 5), WHATEVER.clone()
    expected[LOST] = float(frame_support(rig, maps, NOISE, SETTINGS)[LOST]) - 0.05
    assert relocalised(rig, maps, expected=expected) == Relocalised(rig, (), ())
    expected[LOST] += 0.35
    assert relocalised(rig, maps, expected=expected).found == (LOST,)


def test_a_frame_that_was_searched_for_in_vain_is_searched_for_again_only_when_others_were_found(
    true, maps, monkeypatch
):
    outcomes = [((), (1, 2)), ((3,), (4,)), ((), ())]
    asked = []

    def searched(problem, refine, rig, noise, expected):
        asked.append(expected.isinf() & (expected < 0))
        found, in_vain = outcomes[len(asked) - 1]
        moved = replace(rig, T_world_camera=exp_se3(torch.full((FRAMES, 6), 1e-3)).double() @ rig.T_world_camera)
        return Relocalised(moved if len(asked) < 3 else rig, found, in_vain)

    monkeypatch.setattr(searching, "relocalise", searched)
    searching.search(problem_of(true, maps, PRIOR, replace(SETTINGS, anchors_per_frame=100)), "known-rig")
    assert [skipped.nonzero().squeeze(-1).tolist() for skipped in asked] == [[], [1, 2], [4]]
