"""Held-out pixels judge poses: a disturbed rig is rejected, chance and wrong decodings decide nothing."""

from dataclasses import replace

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.adjust import (
    CrossValidation,
    HeldOutPixels,
    cross_validate,
    mean_and_error,
)
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.residuals import Rig

from .analytic import ExactMaps, decoded_at, disturbed, rig_of

FRAMES, SIZE, NOISE = 4, 60, 1.0
WIDTH = 4 * NOISE


@pytest.fixture(scope="module")
def true() -> Rig:
    return rig_of(FRAMES, SIZE)


@pytest.fixture(scope="module")
def maps(true) -> CoordinateMaps:
    return ExactMaps.around(true, SIZE)


@pytest.fixture(scope="module")
def held_out(maps) -> HeldOutPixels:
    generator = torch.Generator().manual_seed(0)
    drawn = maps.draw(torch.arange(FRAMES), 160, generator)
    frame, uv = drawn.frame, drawn.uv_camera
    pixel = uv.long() // 8
    block = 64 * frame + 8 * pixel[:, 1] + pixel[:, 0]
    return HeldOutPixels(frame, uv, decoded_at(maps, frame, uv), block)


@pytest.mark.parametrize("kind", ["frames", "projectors"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_disturbed_rig_is_worse_than_the_true_one(true, maps, held_out, kind, seed):
    small = {"degrees": 0.3, "shift": 0.01}
    rig = disturbed(true, seed, **small) if kind == "frames" else disturbed(true, seed, **small, relative=1.0)
    better, worse = cross_validate(rig, true, held_out, maps, NOISE), cross_validate(true, rig, held_out, maps, NOISE)
    assert better.better and not worse.better
    assert better.after_px < 0.9 * better.before_px  # pixels hidden in another frame cost the same in both
    assert (better.before_px, better.after_px) == pytest.approx((worse.after_px, worse.before_px))
    assert better.before_px <= WIDTH


def test_the_same_rig_is_no_better(true, maps, held_out):
    found = cross_validate(true, true, held_out, maps, NOISE)
    assert found.before_px == found.after_px and not found.better


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_wrong_decodings_do_not_decide(true, maps, held_out, share):
    generator = torch.Generator().manual_seed(1)
    wrong = torch.rand(len(held_out.frame), generator=generator) < share
    elsewhere = 400 * torch.rand(len(wrong), 2, generator=generator, dtype=torch.float64)
    uv = torch.where(wrong[:, None], elsewhere, held_out.uv_projector)
    spoilt = replace(held_out, uv_projector=uv)
    found = cross_validate(disturbed(true, 0, degrees=0.3, shift=0.01), true, spoilt, maps, NOISE)
    assert found.better and found.before_px <= WIDTH


def test_a_rig_that_sees_nothing_is_the_worst(true, maps, held_out):
    """Cameras look away, so no residual can be formed: that must not count as agreement."""
    away = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    blind = Rig(true.camera, true.projector, true.T_world_camera @ away, true.T_camera_projector)
    found = cross_validate(true, blind, held_out, maps, NOISE)
    assert not found.better and found.after_px <= WIDTH


def test_a_difference_within_its_standard_error_decides_nothing(true, maps, held_out):
    """Poses that differ by much less than the decoding noise: the old ones are kept, whichever chance favours."""
    generator = torch.Generator().manual_seed(3)
    noisy = replace(
        held_out, uv_projector=held_out.uv_projector + torch.randn(len(held_out.frame), 2, generator=generator).double()
    )
    nudges = [disturbed(true, seed, degrees=0.002, shift=0.00005) for seed in range(12)]
    found = [cross_validate(true, nudge, noisy, maps, NOISE) for nudge in nudges]
    assert {f.difference < 0 for f in found} == {True, False}  # a comparison without a margin would keep some
    assert not any(f.better for f in found)


def test_a_gain_that_biased_decoding_could_explain_decides_nothing():
    """Beyond chance by ten standard errors, but by less than a hundredth of the mean square."""
    common = {"standard_error": 0.00005, "standard_errors": 2.0, "least_gain": 0.01}
    assert not CrossValidation(before_px=0.3, after_px=0.2992, difference=-0.0005, **common).better
    assert CrossValidation(before_px=0.3, after_px=0.298, difference=-0.0012, **common).better


def test_the_standard_error_is_that_of_independent_blocks():
    """Values that are the same throughout a block count as one; checked against the spread over many draws."""
    generator = torch.Generator().manual_seed(0)
    block = torch.arange(40).repeat_interleave(25)
    means, errors = [], []
    for _ in range(400):
        values = torch.randn(40, generator=generator, dtype=torch.float64)[block]
        mean, error = mean_and_error(values, block)
        means.append(mean)
        errors.append(error)
    assert torch.tensor(means).std().item() == pytest.approx(sum(errors) / len(errors), rel=0.1)
    assert mean_and_error(torch.ones(5, dtype=torch.float64), torch.zeros(5, dtype=torch.int64))[1] == float("inf")
