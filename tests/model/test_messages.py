"""Messages of a training run about poses and intrinsics."""

import torch

from sl_nerfstudio.bundle_adjustment.parameters import SelfCalibration
from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange
from sl_nerfstudio.model.messages import contradiction_message, departed_message, unplaced_message
from sl_nerfstudio.review.verdict import DepartedFrame

CAMERAS = [Device(800, 600, focal, focal, 400.0, 300.0) for focal in (500.0, 600.0, 610.0)]
PROJECTOR = Device(1000, 800, 1200.0, 1200.0, 500.0, 400.0)


def test_a_contradiction_is_reported_with_devices_units_and_remedy():
    change = IntrinsicsChange.of((-0.0068, 0.0, 0.001, 0.0005, 0.0, 0.002))
    found = SelfCalibration.of(change, torch.eye(6, dtype=torch.float64) * 0.0005**2)
    text = contradiction_message(found, CAMERAS, PROJECTOR)
    assert found.contradicts() and "chi square 206" in text
    assert "camera: focal length -0.68 ± 0.05 %, principal point (+0.0 ± 0.3, +0.6 ± 0.3) px" in text
    assert "projector: focal length +0.05 ± 0.05 %, principal point (+0.0 ± 0.6, +2.4 ± 0.6) px" in text
    assert "--pipeline.model.refine-intrinsics True" in text
    small = SelfCalibration.of(IntrinsicsChange.of((0.0005,) * 6), torch.eye(6, dtype=torch.float64) * 0.0005**2)
    assert contradiction_message(small, CAMERAS, PROJECTOR) == ""


def test_frames_that_cannot_be_placed_or_ended_far_off_are_named():
    assert unplaced_message([]) == departed_message([]) == ""
    assert "frame_3, frame_5." in unplaced_message(["frame_3", "frame_5"])
    assert "frame_3 (60.0 deg, stated 1)" in departed_message([DepartedFrame("frame_3", 60.02, 1.0)])
