"""Messages of a training run about poses and intrinsics."""

import torch

from sl_nerfstudio.bundle_adjustment.adjust import CrossValidation
from sl_nerfstudio.bundle_adjustment.parameters import SelfCalibration
from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange
from sl_nerfstudio.model.messages import (
    contradiction_message,
    departed_message,
    poses_message,
    unplaced_message,
)
from sl_nerfstudio.model.pose_refinement import ScanAdjustment
from sl_nerfstudio.review.verdict import DepartedFrame

from ..bundle_adjustment.analytic import rig_of

CAMERAS = [Device(800, 600, focal, focal, 400.0, 300.0) for focal in (500.0, 600.0, 610.0)]
PROJECTOR = Device(1000, 800, 1200.0, 1200.0, 500.0, 400.0)


def test_a_contradiction_is_reported_with_devices_units_and_remedy():
    change = IntrinsicsChange.of((-0.0068, 0.0, 0.001, 0.0005, 0.0, 0.002))
    found = SelfCalibration.of(change, torch.eye(6, dtype=torch.float64) * 0.0005**2)
    text = contradiction_message(found, CAMERAS, PROJECTOR)
    assert found.contradicts() and "chi square 206" in text
    assert "camera: focal length -0.68 ± 0.05 %, principal point (+0.0 ± 0.3, +0.6 ± 0.3) px" in text
    assert "projector: focal length +0.05 ± 0.05 %, principal point (+0.0 ± 0.6, +2.4 ± 0.6) px" in text
    assert "cause:" in text and "remedy:" in text and "--pipeline.model.refine-intrinsics True" in text


def test_intrinsics_that_may_be_correct_are_not_mentioned():
    found = SelfCalibration.of(IntrinsicsChange.of((0.0005,) * 6), torch.eye(6, dtype=torch.float64) * 0.0005**2)
    assert contradiction_message(found, CAMERAS, PROJECTOR) == ""


def test_both_residuals_are_in_the_message():
    rig = rig_of(3, 60)
    better = CrossValidation(before_px=3.0, after_px=0.25, difference=-8.0, standard_error=0.1, least_gain=0.01)
    text = poses_message(ScanAdjustment(rig, torch.zeros(3, 12), torch.zeros(42, 42), better, 0.1))
    assert text == "Poses adjusted: held-out pixels agree to 0.25 px, before 3 px."
    chance = CrossValidation(before_px=0.3, after_px=0.29, difference=-0.01, standard_error=0.1, least_gain=0.01)
    text = poses_message(ScanAdjustment(rig, torch.zeros(3, 12), torch.zeros(42, 42), chance, 0.1))
    assert text.startswith("Poses NOT changed") and text.endswith("starting poses are kept.")
    assert "0.29 px, before 0.3 px" in text


def test_frames_that_cannot_be_placed_are_named():
    assert unplaced_message([]) == ""
    text = unplaced_message(["frame_3", "frame_5"])
    assert text.startswith("Frames that cannot be placed: frame_3, frame_5.") and "remedy:" in text


def test_frames_far_from_their_starts_are_named_with_both_causes():
    assert departed_message([]) == ""
    text = departed_message([DepartedFrame("frame_3", 60.02, 1.0)])
    assert text.startswith("Frames far from their starting poses: frame_3 (60.0 deg, stated 1).")
    assert "was found again" in text and "slid along" in text and "remedy:" in text
    assert max(map(len, text.splitlines())) < 120
