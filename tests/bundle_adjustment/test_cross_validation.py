"""Refined poses are judged by pixels that took no part: a disturbed rig loses, wrong decodings decide nothing."""

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.cross_validation import HeldOutPixels, cross_validate
from sl_nerfstudio.bundle_adjustment.residuals import Rig

from .analytic import ExactMaps, disturbed, rig_of

FRAMES, SIZE, WIDTH = 4, 60, 4.0


@pytest.fixture(scope="module")
def true() -> Rig:
    return rig_of(FRAMES, SIZE)


@pytest.fixture(scope="module")
def maps(true) -> CoordinateMaps:
    return ExactMaps.around(true, SIZE)


@pytest.fixture(scope="module")
def held_out(maps) -> HeldOutPixels:
    generator = torch.Generator().manual_seed(0)
    uv = [maps.draw(k, 80, generator) for k in range(FRAMES)]
    frame = torch.arange(FRAMES).repeat_interleave(torch.tensor([len(u) for u in uv]))
    return HeldOutPixels(frame, torch.cat(uv), maps.decoded_at(frame, torch.cat(uv)))


@pytest.mark.parametrize("kind", ["frames", "projectors"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_disturbed_rig_is_worse_than_the_true_one(true, maps, held_out, kind, seed):
    small = {"degrees": 0.3, "shift": 0.01}
    rig = disturbed(true, seed, **small) if kind == "frames" else disturbed(true, seed, **small, relative=1.0)
    better, worse = cross_validate(rig, true, held_out, maps, WIDTH), cross_validate(true, rig, held_out, maps, WIDTH)
    assert better.better and not worse.better
    assert better.after_px < 0.9 * better.before_px  # what is hidden in another frame costs the same in both
    assert (better.before_px, better.after_px) == pytest.approx((worse.after_px, worse.before_px))
    assert better.before_px <= WIDTH


def test_the_same_rig_is_no_better(true, maps, held_out):
    verdict = cross_validate(true, true, held_out, maps, WIDTH)
    assert verdict.before_px == verdict.after_px and not verdict.better


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_wrong_decodings_do_not_decide(true, maps, held_out, share):
    generator = torch.Generator().manual_seed(1)
    wrong = torch.rand(len(held_out.frame), generator=generator) < share
    elsewhere = 400 * torch.rand(len(wrong), 2, generator=generator, dtype=torch.float64)
    uv = torch.where(wrong[:, None], elsewhere, held_out.uv_projector)
    spoilt = HeldOutPixels(held_out.frame, held_out.uv_camera, uv)
    verdict = cross_validate(disturbed(true, 0, degrees=0.3, shift=0.01), true, spoilt, maps, WIDTH)
    assert verdict.better and verdict.before_px <= WIDTH


def test_a_rig_that_sees_nothing_is_the_worst(true, maps, held_out):
    """Cameras turned away: no residual can be formed, which is no excuse."""
    away = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    blind = Rig(true.camera, true.projector, true.T_world_camera @ away, true.T_camera_projector)
    verdict = cross_validate(true, blind, held_out, maps, WIDTH)
    assert not verdict.better and verdict.after_px <= WIDTH
