"""Frames that do not agree with the others after a search are named."""

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings, unplaced_frames

from .analytic import images_of, rig_of, turned

FRAMES, SIZE, NOISE = 6, 100, 0.1


@pytest.mark.parametrize("lost", [(), (2,), (1, 4)])
def test_frames_that_see_too_little_of_what_the_others_agree_on_are_unplaced(lost):
    rig = true = rig_of(FRAMES, SIZE)
    for frame in lost:
        rig = turned(rig, frame, 5.0)
    maps = CoordinateMaps.of(images_of(true, SIZE))
    assert unplaced_frames(rig, maps, NOISE, AdjustmentSettings()) == lost


def test_a_frame_of_which_nothing_was_decoded_is_unplaced():
    rig = rig_of(FRAMES, SIZE)
    images = images_of(rig, SIZE)
    images[3] = torch.full_like(images[3], float("nan"))
    assert unplaced_frames(rig, CoordinateMaps.of(images), NOISE, AdjustmentSettings()) == (3,)
