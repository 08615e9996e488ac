"""Scale, position and orientation after an adjustment; no residual changes."""

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import observe, place_anchors
from sl_nerfstudio.bundle_adjustment.parameters import (
    PosePrior,
    agreeing_scale,
    baseline_scale,
    gauge_directions,
    gauge_projection,
    restore,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig, residuals_of
from sl_nerfstudio.geometry.lie import exp_se3, inverse, log_se3

from .analytic import disturbed, images_of, rig_of

FRAMES, SIZE = 4, 40


def scaled(rig: Rig, factor: float, twist: tuple[float, ...]) -> Rig:
    """The whole scene in another gauge."""
    camera, relative = rig.T_world_camera.clone(), rig.T_camera_projector.clone()
    camera[:, :3, 3] *= factor
    relative[:, :3, 3] *= factor
    motion = exp_se3(torch.tensor(twist, dtype=torch.float64))
    return Rig(rig.camera, rig.projector, motion @ camera, relative)


TWIST = (0.2, -0.1, 0.3, 0.2, 0.4, -0.1)


@pytest.mark.parametrize("known", [None, 0, 2])
def test_a_changed_gauge_is_undone(known):
    start = rig_of(FRAMES, SIZE)
    moved = scaled(start, 1.3, TWIST)
    found = restore(start, moved, baseline_scale(start, moved, known))
    assert torch.allclose(found.T_world_camera, start.T_world_camera, rtol=0, atol=1e-12)
    assert torch.allclose(found.T_camera_projector, start.T_camera_projector, rtol=0, atol=1e-12)


@pytest.mark.parametrize("known", [None, 1])
def test_the_known_baseline_or_the_mean_is_kept(known):
    start = rig_of(FRAMES, SIZE)
    rig = scaled(disturbed(start, 1, relative=1.0), 0.8, TWIST)
    before, after = start.baseline, restore(start, rig, baseline_scale(start, rig, known)).baseline
    assert not torch.allclose(before, after, rtol=1e-4)
    if known is None:
        assert float(after.log().mean() - before.log().mean()) == pytest.approx(0, abs=1e-13)
    else:
        assert float(after[known]) == pytest.approx(float(before[known]), rel=1e-13)
    assert torch.allclose(after / rig.baseline, (after / rig.baseline)[:1], rtol=1e-12)


def prior_of(frame_translation: float, relative_translation: float) -> PosePrior:
    every = torch.ones(FRAMES, dtype=torch.float64)
    return PosePrior(frame_translation * every, 0.1 * every, relative_translation * every, 0.01 * every)


@pytest.mark.parametrize("frames, relative", [(0.05, 0.05), (0.3, 0.01), (0.01, 0.3), (1e-6, 1.0), (1.0, 1e-6)])
def test_the_scale_that_agrees_best_is_the_weighted_least_squares_one(frames, relative):
    # baselines are 3 % too long relative to the cameras' positions: the two imply different scales
    start, long = rig_of(FRAMES, SIZE), 1.03
    rig = rig_of(FRAMES, SIZE)
    rig.T_camera_projector[:, :3, 3] *= long
    centre = start.T_world_camera[:, :3, 3]
    of_frames = float((centre - centre.mean(0)).pow(2).sum()) / frames**2
    of_baselines = float(start.baseline.pow(2).sum()) / relative**2
    expected = (of_frames + long * of_baselines) / (of_frames + long**2 * of_baselines)
    found = agreeing_scale(start, scaled(rig, 0.7, TWIST), prior_of(frames, relative))
    assert found * 0.7 == pytest.approx(expected, rel=1e-9)


def test_no_residual_changes():
    true = rig_of(FRAMES, SIZE)
    maps, generator = CoordinateMaps.of(images_of(true, SIZE)), torch.Generator().manual_seed(0)
    rig = disturbed(true, 1, degrees=0.3, shift=0.01, relative=0.5)
    anchors = place_anchors(rig, maps, 40, generator)
    rows = observe(rig, anchors, maps, 3, 50.0, 0.1, generator)
    factor = baseline_scale(true, rig, 0)
    found = restore(true, rig, factor)
    before = residuals_of(rig, anchors, rows, maps)
    after = residuals_of(found, anchors.at(anchors.depth * factor), rows, maps)
    assert before.cross_valid.sum() > 30 and torch.equal(before.cross_valid, after.cross_valid)
    assert torch.allclose(before.own, after.own, atol=1e-9)
    assert torch.allclose(before.cross[before.cross_valid], after.cross[before.cross_valid], atol=1e-8)


@pytest.mark.parametrize("frame", [None, 1])
def test_the_projection_is_what_restoring_leaves_of_small_increments(frame):
    true, generator = rig_of(4, 80), torch.Generator().manual_seed(3)
    x = 1e-6 * torch.randn(48, generator=generator, dtype=torch.float64)
    moved = true.moved(*x.reshape(2, 4, 6))
    back = restore(true, moved, baseline_scale(true, moved, frame))
    left = [
        log_se3(now @ inverse(then)).reshape(-1)
        for now, then in (
            (back.T_world_camera, true.T_world_camera),
            (back.T_camera_projector, true.T_camera_projector),
        )
    ]
    P = gauge_projection(true, frame)
    assert torch.allclose(P @ x, torch.cat(left), atol=1e-10)
    assert (P @ gauge_directions(true)).abs().max() < 1e-9 and torch.allclose(P @ P, P, atol=1e-9)
