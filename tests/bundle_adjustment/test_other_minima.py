"""Where captures do not hold the frames, stated sigma covers how far other minima are; elsewhere nothing changes."""

from dataclasses import replace
from math import radians

import pytest
import torch
from torch import Tensor

from sl_nerfstudio.bundle_adjustment import adjust as adjustment
from sl_nerfstudio.bundle_adjustment.adjust import adjust, find_minimum
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import (
    departure_of,
    drawn_start,
    farthest_frame,
    shake,
    widened,
    with_frames_of,
)
from sl_nerfstudio.bundle_adjustment.parameters import PosePrior
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings, OtherMinimaSettings
from sl_nerfstudio.geometry.lie import (
    exp_se3,
    inverse,
    log_se3,
    log_so3,
)

from . import analytic
from .analytic import disturbed, images_of, rig_of

FRAMES, SIZE = 4, 100
SIGMAS = (0.03, radians(1.0), 0.003, radians(0.1))
PRIOR = PosePrior(*(torch.full((FRAMES,), s, dtype=torch.float64) for s in SIGMAS), intrinsics=0.0)
SETTINGS = AdjustmentSettings(anchors_per_frame=150, frames_per_anchor=3, max_iterations=30)
ONE_SEARCH = replace(SETTINGS, other_minima=OtherMinimaSettings(searches=0))


def noisy_maps(seed: int, noise: float, size: int = SIZE) -> CoordinateMaps:
    """Of the scene as it is now."""
    generator = torch.Generator().manual_seed(seed)
    images = images_of(rig_of(FRAMES, size), size)
    return CoordinateMaps.of([image + noise * torch.randn(size, size, 2, generator=generator) for image in images])


def test_frames_that_slide_on_a_plane_have_a_sigma_that_covers_their_error(monkeypatch):
    monkeypatch.setattr(analytic, "BALLS", ())
    true = rig_of(FRAMES, SIZE)
    start, maps, rms = disturbed(true, 0), noisy_maps(0, 0.02), []
    for settings in (ONE_SEARCH, SETTINGS):
        found = adjust(start, maps, PRIOR, "known-rig", settings)
        error = departure_of(true, found.rig)[: 6 * FRAMES]
        rms.append(float((error / found.covariance.diagonal()[: 6 * FRAMES].sqrt()).pow(2).mean().sqrt()))
    one, several = rms
    assert several < 1.5 < one


def test_a_scene_that_holds_its_frames_is_searched_once():
    size = 240
    start, maps = disturbed(rig_of(FRAMES, size), 1), noisy_maps(1, 0.3, size)
    one, several = (
        adjust(start, maps, PRIOR, "known-rig", replace(s, anchors_per_frame=300)) for s in (ONE_SEARCH, SETTINGS)
    )
    assert torch.equal(one.factor, several.factor)
    assert torch.equal(one.rig.T_world_camera, several.rig.T_world_camera)


def test_a_frame_of_another_scene_asks_for_no_searches_and_widens_nothing(monkeypatch):
    """It agrees with nothing anywhere, which says nothing about where the others are."""
    stranger, searches = 2, []
    maps = noisy_maps(1, 0.3)
    monkeypatch.setattr(analytic, "BALLS", analytic.BALLS[:1])
    strange = noisy_maps(2, 0.3).image(stranger).reshape(-1, 2).roll(SIZE // 5, 0).reshape(SIZE, SIZE, 2)
    images = [strange if frame == stranger else maps.image(frame) for frame in range(FRAMES)]
    maps = CoordinateMaps.of(images)
    start = disturbed(rig_of(FRAMES, SIZE), 1)
    search = adjustment.search
    monkeypatch.setattr(adjustment, "search", lambda *a: searches.append(a) or search(*a))
    one, several = (adjust(start, maps, PRIOR, "free", s) for s in (ONE_SEARCH, SETTINGS))
    assert one.unplaced == several.unplaced == (stranger,)
    assert len(searches) == 2 and torch.equal(one.factor, several.factor)


def test_frames_of_another_rig_are_where_it_has_them():
    rig, other = rig_of(FRAMES, SIZE), disturbed(rig_of(FRAMES, SIZE), 3, relative=0.5)
    mixed = with_frames_of(rig, other, (1, 3))
    for part in ("T_world_camera", "T_camera_projector"):
        for k in range(FRAMES):
            assert torch.equal(getattr(mixed, part)[k], getattr(other if k in (1, 3) else rig, part)[k])
    assert torch.equal(with_frames_of(rig, other, ()).T_world_camera, rig.T_world_camera)


def test_the_minimum_alone_is_an_adjustment_without_the_question_which_can_be_asked_later(monkeypatch):
    monkeypatch.setattr(analytic, "BALLS", ())
    true = rig_of(FRAMES, SIZE)
    start, maps = disturbed(true, 0), noisy_maps(0, 0.02)
    one, several = (adjust(start, maps, PRIOR, "known-rig", s) for s in (ONE_SEARCH, SETTINGS))
    minimum = find_minimum(start, maps, PRIOR, "known-rig", SETTINGS)
    asked = minimum.with_other_minima()
    assert torch.equal(minimum.adjustment.factor, one.factor) and torch.equal(asked.factor, several.factor)
    assert float((asked.sigma / one.sigma)[:, :6].max()) > 1.5
    for found in (minimum.adjustment, asked, several):
        assert torch.equal(found.rig.T_world_camera, one.rig.T_world_camera)


def random_factor(seed: int) -> Tensor:
    A = torch.randn(12 * FRAMES + 6, 80, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return A / 80**0.5


def test_a_shake_has_the_covariance_of_the_poses_given_the_intrinsics():
    factor, generator, k = random_factor(0), torch.Generator().manual_seed(1), 12 * FRAMES
    draws = torch.stack([shake(factor, 2.0, generator) for _ in range(1000)])
    wanted = torch.linalg.inv(torch.linalg.inv(factor @ factor.T)[:k, :k])  # precision of the poses alone
    assert float(((draws.T @ draws / 1000 / 4 - wanted) / wanted.diagonal().max()).abs().max()) < 0.2


def test_intrinsics_that_are_exact_change_nothing():
    factor, k = random_factor(0), 12 * FRAMES
    factor[k:] = 0
    alone = shake(factor, 1.0, torch.Generator().manual_seed(2))
    assert alone.isfinite().all() and float(alone.abs().max()) > 0.1
    assert farthest_frame(factor, torch.zeros(k, dtype=torch.float64)) == 0
    one = torch.zeros(k, dtype=torch.float64)
    one[6:12] = 3 * factor[6:12].norm(dim=1)
    assert farthest_frame(factor, one) == pytest.approx(3)


def test_moving_and_scaling_all_frames_is_no_departure():
    rig = rig_of(FRAMES, SIZE)
    motion = exp_se3(torch.tensor([0.2, -0.1, 0.3, 0.5, -0.4, 0.3], dtype=torch.float64))
    moved = replace(rig.scaled(1.7), T_world_camera=motion @ rig.scaled(1.7).T_world_camera)
    assert float(departure_of(moved, rig).abs().max()) < 1e-9
    own = torch.zeros(FRAMES, 6, dtype=torch.float64)
    own[2, 4] = 1e-3
    assert float(departure_of(rig.moved(own, 0 * own), rig).norm()) > 5e-4


@pytest.mark.parametrize("with_projectors", [False, True])
def test_drawn_starts_scatter_as_the_prior_states(with_projectors):
    rig, generator = rig_of(FRAMES, SIZE), torch.Generator().manual_seed(0)
    starts = [drawn_start(rig, PRIOR, with_projectors, generator) for _ in range(300)]
    delta = torch.stack([log_se3(s.T_world_camera @ inverse(rig.T_world_camera)) for s in starts])
    T, there = rig.T_camera_projector, torch.stack([s.T_camera_projector for s in starts])
    shift = there[..., :3, 3] - T[:, :3, 3]
    turn = log_so3(there[..., :3, :3] @ T[:, :3, :3].transpose(1, 2))
    found = [part.pow(2).mean().sqrt() for part in (delta[..., :3], delta[..., 3:], shift, turn)]
    wanted = [s if with_projectors or k < 2 else 0 for k, s in enumerate(SIGMAS)]
    assert torch.stack(found).tolist() == pytest.approx(wanted, rel=0.1, abs=1e-12)


def test_widening_adds_the_mean_square_to_poses_alone():
    factor, k = random_factor(3), 12 * FRAMES
    a, b = torch.randn(2, k, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    wide = widened(factor, [a, b])
    more = wide @ wide.T - factor @ factor.T
    assert torch.allclose(more[:k, :k], (torch.outer(a, a) + torch.outer(b, b)) / 2)
    assert float(more[k:].abs().max()) < 1e-12
    assert torch.equal(widened(factor, []), factor)
