"""Frames in a wrong minimum are found by their residuals and moved to where the others support them."""

from dataclasses import replace
from math import radians

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.priors import PosePrior
from sl_nerfstudio.bundle_adjustment.relocalisation import find_lost_frames, relocalise, unplaced_frames
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings, RelocalisationSettings
from sl_nerfstudio.geometry.se3 import exp_se3, inverse, log_so3

from .analytic import ExactMaps, rig_of

FRAMES, SIZE, LOST = 6, 100, 2
SETTINGS = RelocalisationSettings()
PRIOR = PosePrior(*(torch.full((FRAMES,), s, dtype=torch.float64) for s in (0.05, radians(3.0), 0.01, radians(0.3))))


@pytest.fixture(scope="module")
def true():
    return rig_of(FRAMES, SIZE)


def relocalised(rig, true, mode="free"):
    generator = torch.Generator().manual_seed(0)
    return relocalise(rig, rig, ExactMaps.around(true, SIZE), PRIOR, mode, 0.05, generator, AdjustmentSettings())


@pytest.mark.parametrize("mode", ["free", "known-rig", "rigid-rig"])
def test_a_lost_frame_is_placed_and_no_other_moves(true, mode):
    away = exp_se3(torch.tensor([0.08, -0.05, 0.04, 0.06, 0.05, -0.1], dtype=torch.float64))
    cameras = true.T_world_camera.clone()
    cameras[LOST] = away @ cameras[LOST]
    rig = relocalised(replace(true, T_world_camera=cameras), true, mode)
    found = rig.T_world_camera
    if mode != "free":
        assert torch.equal(rig.T_camera_projector, true.T_camera_projector)
    others = torch.arange(FRAMES) != LOST
    assert torch.equal(found[others], true.T_world_camera[others])
    off = inverse(true.T_world_camera[LOST]) @ found[LOST]
    assert float(log_so3(off[:3, :3]).norm()) < radians(0.01) and float(off[:3, 3].norm()) < 1e-3


def test_no_frame_is_searched_if_all_agree(true):
    assert torch.equal(relocalised(true, true).T_world_camera, true.T_world_camera)


def test_lost_frames_are_those_with_little_support_best_first():
    shares = torch.tensor([0.8, 0.3, 0.85, 0.5, float("nan"), 0.9, 0.8], dtype=torch.float64)
    assert find_lost_frames(shares, SETTINGS).tolist() == [3, 1]
    alike = torch.tensor([0.8, 0.8, 0.78, 0.8, 0.8], dtype=torch.float64)
    assert not len(find_lost_frames(alike, SETTINGS))  # 2.5 % below equally good frames is not lost
    alike[2] = 0.7
    assert find_lost_frames(alike, SETTINGS).tolist() == [2]


def test_a_frame_that_is_far_off_is_named_and_no_other(true):
    maps = ExactMaps.around(true, SIZE)
    assert unplaced_frames(true, maps, 0.05, AdjustmentSettings()) == ()
    cameras = true.T_world_camera.clone()
    turn = torch.tensor([0, 0, 0, 0.3, 0.5, 0.85], dtype=torch.float64) * radians(60)
    cameras[LOST] = exp_se3(turn) @ cameras[LOST]
    assert unplaced_frames(replace(true, T_world_camera=cameras), maps, 0.05, AdjustmentSettings()) == (LOST,)
