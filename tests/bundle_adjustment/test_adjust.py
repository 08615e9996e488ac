"""The adjustment recovers true poses, keeps fixed what is not free, withstands wrong decodings, and knows when to stop.

Where captures do not hold the frames, the stated sigma covers how far other minima are. Held-out pixels decide whether
the poses are kept.
"""

from dataclasses import dataclass, fields, replace
from math import radians

import pytest
import torch
from torch import Tensor

from sl_nerfstudio.bundle_adjustment import adjust as adjustment
from sl_nerfstudio.bundle_adjustment import modes, observations, search
from sl_nerfstudio.bundle_adjustment.adjust import (
    Adjustment,
    CrossValidation,
    HeldOutPixels,
    adjust,
    cross_validate,
    find_minimum,
    with_other_minima,
)
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps, MapSample
from sl_nerfstudio.bundle_adjustment.modes import departure_of, farthest_frame
from sl_nerfstudio.bundle_adjustment.parameters import PosePrior, constrained
from sl_nerfstudio.bundle_adjustment.posterior import mean_and_error
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings, SearchStage, run_stage
from tests.formulas import pose_errors

from . import analytic
from .analytic import ExactMaps, decoded_at, disturbed, images_of, prior_of, rig_of, static_rig

FRAMES, SIZE = 6, 100
QUICK = AdjustmentSettings(anchors_per_frame=80, frames_per_anchor=3, max_iterations=16)


def loose_prior(frames: int, relative: float = 0.1) -> PosePrior:
    """As loose as the disturbance of these tests is large."""
    return prior_of(frames, 0.03, radians(1.0), 0.03 * relative, radians(1.0) * relative)


PRIOR = loose_prior(FRAMES)


def errors(found: Rig, true: Rig) -> tuple[float, float]:
    """Largest error of rotations (degree) and of positions (scene units) of all devices, when they are aligned."""
    both = (torch.cat([rig.T_world_camera, rig.T_world_projector]).numpy() for rig in (found, true))
    _, degrees, off = pose_errors(*both)
    return float(degrees.max()), float(off.max())


def assert_recovered(found: Rig, true: Rig) -> None:
    turn, shift = errors(found, true)
    assert turn < 1e-2 and shift < 1e-3


@pytest.fixture(scope="module")
def true() -> Rig:
    return rig_of(FRAMES, SIZE)


@pytest.fixture(scope="module")
def exact(true) -> CoordinateMaps:
    return ExactMaps.around(true, SIZE)


@pytest.fixture(scope="module")
def maps(true) -> CoordinateMaps:
    return CoordinateMaps.of(images_of(true, SIZE))


def test_disturbed_frames_are_recovered_and_a_known_rig_keeps_its_relative_poses_bit_for_bit(true, exact):
    start = disturbed(true)
    found = adjust(start, exact, PRIOR, "known-rig", QUICK)
    assert errors(start, true)[0] > 1 and errors(start, true)[1] > 0.03
    assert_recovered(found.rig, true)
    assert found.median_before_px > 0.5 and found.median_after_px < 1e-3
    assert torch.equal(found.rig.T_camera_projector, true.T_camera_projector)


@pytest.mark.slow
def test_disturbed_projectors_are_recovered_from_exact_look_ups(true, exact):
    """Frames and projectors are disturbed; without pixels, only rounding separates the result from the truth."""
    found = adjust(disturbed(true, 1, relative=0.1), exact, PRIOR, "free", replace(QUICK, max_iterations=24))
    assert_recovered(found.rig, true)
    assert found.median_after_px < 0.02


def test_a_static_projector_stays_in_one_place_while_cameras_are_recovered():
    true = static_rig(FRAMES, SIZE)
    start = constrained("static-projector", disturbed(true, 3, relative=0.1))
    there = start.T_world_projector
    assert torch.allclose(there, there[:1].expand_as(there), rtol=0, atol=1e-12)
    found = adjust(start, ExactMaps.around(true, SIZE), PRIOR, "static-projector", QUICK)
    assert torch.allclose(found.rig.T_world_projector, there, rtol=0, atol=1e-9)
    assert errors(start, true)[0] > 0.1
    assert_recovered(found.rig, true)


def test_off_moves_nothing_and_exact_starts_stay(true, maps, exact):
    start = disturbed(true)
    off = adjust(start, maps, PRIOR, "off", replace(QUICK, max_iterations=2))
    assert torch.equal(off.rig.T_world_camera, start.T_world_camera)
    assert torch.equal(off.rig.T_camera_projector, start.T_camera_projector)
    assert torch.equal(off.covariance, torch.zeros_like(off.covariance))
    found = adjust(true, exact, PRIOR, "free", replace(QUICK, max_iterations=3, other_minima=False))
    assert (found.rig.T_world_camera - true.T_world_camera).abs().max() < 1e-5
    assert (found.rig.T_camera_projector - true.T_camera_projector).abs().max() < 1e-5


@dataclass(frozen=True)
class SpoiltMaps(ExactMaps):
    """Exact except for some pixels, which show coordinates from elsewhere."""

    wrong: Tensor  # bool (frames, h, w)

    def look_up(self, frame: Tensor, uv_camera: Tensor, memory: object = None) -> MapSample:
        found = super().look_up(frame, uv_camera)
        pixel = uv_camera.long().clamp(0, SIZE - 1)
        offset = self.wrong[frame, pixel[:, 1], pixel[:, 0]][:, None] * found.uv_projector.new_tensor([70.0, -45.0])
        return replace(found, uv_projector=found.uv_projector + offset)


@pytest.mark.slow
def test_wrong_cells_do_not_spoil_it(true, exact):
    """3 % of the cells of 5 x 5 pixels."""
    cells = torch.rand(FRAMES, SIZE // 5, SIZE // 5, generator=torch.Generator().manual_seed(0)) < 0.03
    spoilt = SpoiltMaps(
        **{f.name: getattr(exact, f.name) for f in fields(exact)},
        wrong=cells.repeat_interleave(5, 1).repeat_interleave(5, 2),
    )
    settings = replace(QUICK, max_iterations=30, other_minima=False)
    assert_recovered(adjust(disturbed(true), spoilt, PRIOR, "known-rig", settings).rig, true)


def test_one_seed_one_result(true, maps):
    brief = replace(QUICK, anchors_per_frame=30, max_iterations=3, other_minima=False)
    a, b, c = (adjust(disturbed(true), maps, PRIOR, "free", replace(brief, seed=seed)).rig for seed in (5, 5, 6))
    assert torch.equal(a.T_world_camera, b.T_world_camera) and torch.equal(a.T_camera_projector, b.T_camera_projector)
    assert not torch.equal(a.T_world_camera, c.T_world_camera)


def test_frames_that_share_nothing_do_not_move(true, maps):
    """A single frame, and frames of which one decoded nothing: no exception, no NaN."""
    one = Rig(true.camera[:1], true.projector, true.T_world_camera[:1], true.T_camera_projector[:1])
    alone = adjust(one, CoordinateMaps.of(images_of(one, SIZE)), loose_prior(1), "free", QUICK)
    assert torch.equal(alone.rig.T_world_camera, one.T_world_camera)
    assert torch.equal(alone.rig.T_camera_projector, one.T_camera_projector)
    assert alone.covariance.isfinite().all() and alone.noise_px > 0
    none = adjust(disturbed(true), maps, PRIOR, "free", replace(QUICK, max_iterations=0))
    assert torch.equal(none.rig.T_world_camera, disturbed(true).T_world_camera) and none.iterations == 0
    images = images_of(true, SIZE)
    images[2] = torch.full_like(images[2], float("nan"))
    brief = replace(QUICK, max_iterations=3, other_minima=False)
    found = adjust(true, CoordinateMaps.of(images), PRIOR, "free", brief).rig
    assert found.T_world_camera.isfinite().all() and found.T_camera_projector.isfinite().all()
    assert torch.allclose(found.T_world_camera[2], true.T_world_camera[2], atol=1e-9)


@pytest.mark.slow
def test_errors_that_all_frames_share_near_borders_do_not_turn_the_cameras(monkeypatch):
    """Within three pixels of the border of what is decoded, coordinates are off in the same sense in every frame."""
    true, generator = rig_of(FRAMES, 2 * SIZE), torch.Generator().manual_seed(5)
    noisy = []
    for image in images_of(true, 2 * SIZE):
        outside = 1 - torch.isfinite(image[..., 0]).float()
        near = torch.nn.functional.max_pool2d(outside[None], 7, 1, 3)[0]
        noisy.append(image + 0.1 * torch.randn(image.shape, generator=generator) + 0.6 * near[..., None])
    maps, turns = CoordinateMaps.of(noisy), []
    for limit in (observations._MOST_BORDER_NOISE, float("inf")):
        monkeypatch.setattr(observations, "_MOST_BORDER_NOISE", limit)
        found = adjust(disturbed(true), maps, PRIOR, "known-rig", replace(QUICK, anchors_per_frame=300))
        turns.append(errors(found.rig, true)[0])
    assert turns[0] < 0.9 * turns[1]


# Other minima.

FEW = 4
TIGHT = prior_of(FEW, 0.03, radians(1.0), 0.003, radians(0.1), intrinsics=0.0)
SEVERAL = AdjustmentSettings(anchors_per_frame=150, frames_per_anchor=3, max_iterations=30)
ONE = replace(SEVERAL, other_minima=False)


def noisy_maps(seed: int, noise: float, size: int = SIZE, frames: int = FEW) -> CoordinateMaps:
    """Noisy coordinate images of the scene as it is now."""
    generator = torch.Generator().manual_seed(seed)
    images = images_of(rig_of(frames, size), size)
    return CoordinateMaps.of([image + noise * torch.randn(size, size, 2, generator=generator) for image in images])


@pytest.mark.slow
def test_further_steps_move_no_frame_by_much_of_its_sigma(monkeypatch):
    """Steps are small where noise is, and add up: those below 1e-4 alone led on by 1.3 sigma."""
    size = 200
    start, maps = disturbed(rig_of(FRAMES, size), 1), noisy_maps(1, 0.03, size, FRAMES)
    found = find_minimum(start, maps, prior_of(FRAMES, 0.05, 0.03, 0.005, 0.005), "free", AdjustmentSettings())
    monkeypatch.setattr(search, "_CONVERGED", 1e-9)
    onwards = run_stage(found.explored.problem, SearchStage("free", False, 30), found.explored.best)
    assert farthest_frame(found.factor, departure_of(onwards.state.rig, found.rig)) < 0.3


def test_frames_that_slide_on_a_plane_have_a_sigma_that_covers_their_error(monkeypatch):
    """With what other searches find it is larger. The question can be asked later, and changes no pose."""
    monkeypatch.setattr(analytic, "BALLS", ())
    true, maps = rig_of(FEW, SIZE), noisy_maps(0, 0.02)
    one = find_minimum(disturbed(true, 0), maps, TIGHT, "known-rig", SEVERAL)
    several = with_other_minima(one)
    assert torch.equal(one.rig.T_world_camera, several.rig.T_world_camera) and several.explored is None
    assert with_other_minima(several) is several
    error = departure_of(true, one.rig)[: 6 * FEW]
    rms = [float((error / f.covariance.diagonal()[: 6 * FEW].sqrt()).pow(2).mean().sqrt()) for f in (one, several)]
    assert rms[1] < rms[0] < 1.5
    assert float((several.sigma / one.sigma)[:, :6].max()) > 1.5
    unasked = with_other_minima(find_minimum(disturbed(true, 0), maps, TIGHT, "known-rig", ONE))
    assert torch.equal(unasked.factor, one.factor)


@pytest.fixture
def searches(monkeypatch) -> list:
    """All searches, in order."""
    begun, search = [], adjustment.search
    for module in (adjustment, modes):
        monkeypatch.setattr(module, "search", lambda *a: begun.append(a) or search(*a))
    return begun


@pytest.mark.slow
def test_a_scene_that_holds_its_frames_is_searched_once(searches):
    size = 240
    maps = noisy_maps(1, 0.3, size)
    one = find_minimum(
        disturbed(rig_of(FEW, size), 1), maps, TIGHT, "known-rig", replace(SEVERAL, anchors_per_frame=300)
    )
    several = with_other_minima(one)
    assert len(searches) == 1 and torch.equal(several.factor[:, : one.factor.shape[1]], one.factor)
    assert float(several.sigma[:, 3:6].max()) < 0.2 * float(TIGHT.frame_rotation[0])


@pytest.mark.slow
def test_a_frame_of_another_scene_asks_for_no_searches_and_widens_nothing(monkeypatch, searches):
    """It agrees with nothing anywhere, which says nothing about where the others are."""
    stranger = 2
    maps = noisy_maps(1, 0.3)
    monkeypatch.setattr(analytic, "BALLS", analytic.BALLS[:1])
    strange = noisy_maps(11, 0.3).image(stranger).reshape(-1, 2).roll(SIZE // 5, 0).reshape(SIZE, SIZE, 2)
    maps = CoordinateMaps.of([strange if frame == stranger else maps.image(frame) for frame in range(FEW)])
    one: Adjustment = find_minimum(disturbed(rig_of(FEW, SIZE), 1), maps, TIGHT, "free", SEVERAL)
    assert one.unplaced == (stranger,)
    searches.clear()  # the first one, and one with the stranger where its surface fits best
    assert torch.equal(one.factor, with_other_minima(one).factor) and not searches


# Cross-validation.

NOISE = 1.0
WIDTH = 4 * NOISE
SMALL = {"degrees": 0.3, "shift": 0.01}


@pytest.fixture(scope="module")
def small_rig() -> Rig:
    return rig_of(FEW, 60)


@pytest.fixture(scope="module")
def small_maps(small_rig) -> CoordinateMaps:
    return ExactMaps.around(small_rig, 60)


@pytest.fixture(scope="module")
def held_out(small_maps) -> HeldOutPixels:
    frame, uv = small_maps.draw(torch.arange(FEW), 160, torch.Generator().manual_seed(0))
    pixel = uv.long() // 8
    block = 64 * frame + 8 * pixel[:, 1] + pixel[:, 0]
    return HeldOutPixels(frame, uv, decoded_at(small_maps, frame, uv), block)


@pytest.mark.parametrize("relative", [0.0, 1.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_disturbed_rig_is_worse_than_the_true_one(small_rig, small_maps, held_out, relative, seed):
    rig = disturbed(small_rig, seed, **SMALL, relative=relative)
    better, worse = (cross_validate(a, b, held_out, small_maps, NOISE) for a, b in ((rig, small_rig), (small_rig, rig)))
    assert better.better and not better.worse and worse.worse and not worse.better
    assert better.after_px < 0.9 * better.before_px  # pixels hidden in another frame cost the same in both
    assert (better.before_px, better.after_px) == pytest.approx((worse.after_px, worse.before_px))
    assert better.before_px <= WIDTH


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_wrong_decodings_do_not_decide(small_rig, small_maps, held_out, share):
    generator = torch.Generator().manual_seed(1)
    wrong = torch.rand(len(held_out.frame), generator=generator) < share
    elsewhere = 400 * torch.rand(len(wrong), 2, generator=generator, dtype=torch.float64)
    spoilt = replace(held_out, uv_projector=torch.where(wrong[:, None], elsewhere, held_out.uv_projector))
    found = cross_validate(disturbed(small_rig, 0, **SMALL), small_rig, spoilt, small_maps, NOISE)
    assert found.better and found.before_px <= WIDTH


def test_a_rig_that_sees_nothing_is_the_worst(small_rig, small_maps, held_out):
    """Cameras look away, so no residual can be formed: that must not count as agreement."""
    away = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    blind = replace(small_rig, T_world_camera=small_rig.T_world_camera @ away)
    found = cross_validate(small_rig, blind, held_out, small_maps, NOISE)
    assert not found.better and found.after_px <= WIDTH


def test_a_difference_within_its_standard_error_decides_nothing(small_rig, small_maps, held_out):
    """Poses that differ by much less than the decoding noise: the old ones are kept, whichever chance favours."""
    noise = torch.randn(len(held_out.frame), 2, generator=torch.Generator().manual_seed(3)).double()
    noisy = replace(held_out, uv_projector=held_out.uv_projector + noise)
    nudges = [small_rig, *(disturbed(small_rig, seed, degrees=0.002, shift=0.00005) for seed in range(8))]
    found = [cross_validate(small_rig, nudge, noisy, small_maps, NOISE) for nudge in nudges]
    assert found[0].before_px == found[0].after_px
    assert {f.difference < 0 for f in found} == {True, False}  # a comparison without a margin would keep some
    assert not any(f.better for f in found)


def test_a_gain_that_biased_decoding_could_explain_decides_nothing():
    """Beyond chance by ten standard errors, but by less than a hundredth of the mean square."""
    common = {"standard_error": 0.00005, "least_gain": 0.01}
    assert not CrossValidation(before_px=0.3, after_px=0.2992, difference=-0.0005, **common).better
    assert CrossValidation(before_px=0.3, after_px=0.298, difference=-0.0012, **common).better


def test_the_standard_error_is_that_of_independent_blocks():
    """Values that are the same throughout a block count as one; checked against the spread over many draws."""
    generator = torch.Generator().manual_seed(0)
    block = torch.arange(40).repeat_interleave(25)
    draws = [
        mean_and_error(torch.randn(40, generator=generator, dtype=torch.float64)[block], block) for _ in range(400)
    ]
    means, errors = torch.tensor(draws).T
    assert float(means.std()) == pytest.approx(float(errors.mean()), rel=0.1)
    assert mean_and_error(torch.ones(5, dtype=torch.float64), torch.zeros(5, dtype=torch.int64))[1] == float("inf")
