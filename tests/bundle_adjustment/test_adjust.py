"""The adjustment recovers true poses, keeps fixed what is not free, and withstands wrong decodings."""

from dataclasses import dataclass, replace
from math import degrees, radians

import numpy as np
import pytest
import torch
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.adjust import Adjustment, adjust
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps, MapSample
from sl_nerfstudio.bundle_adjustment.covariance import joint_of_prior
from sl_nerfstudio.bundle_adjustment.parameters import (
    PosePrior,
    PriorTerm,
    by_kind,
    constrained,
    free_parameters,
    prior_equations,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.geometry.lie import (
    exp_se3,
    fit_similarity,
    inverse,
    log_se3,
    log_so3,
)

from .analytic import ExactMaps, disturbed, images_of, matrix_by_kind, rig_of, static_rig

FRAMES, SIZE = 6, 100
QUICK = AdjustmentSettings(anchors_per_frame=80, frames_per_anchor=3, max_iterations=16)


def prior_of(frames: int, relative: float = 0.1) -> PosePrior:
    """As loose as the disturbance of these tests is large."""
    sigmas = (0.03, radians(1.0), 0.03 * relative, radians(1.0) * relative)
    return PosePrior(*(torch.full((frames,), s, dtype=torch.float64) for s in sigmas))


def errors(found: Rig, true: Rig) -> tuple[float, float]:
    """Largest error of relative rotations between cameras (degree) and of aligned positions (scene units)."""
    R, Q = found.T_world_camera[:, :3, :3], true.T_world_camera[:, :3, :3]
    turns = (R.transpose(1, 2)[:, None] @ R[None]) @ (Q.transpose(1, 2)[:, None] @ Q[None]).transpose(-1, -2)
    at, expected = (
        torch.cat([r.T_world_camera[:, :3, 3], r.T_world_projector[:, :3, 3]]).numpy() for r in (found, true)
    )
    aligned = fit_similarity(at, expected).points(at)
    return degrees(float(log_so3(turns).norm(dim=-1).max())), float(np.abs(aligned - expected).max())


@pytest.fixture(scope="module")
def true() -> Rig:
    return rig_of(FRAMES, SIZE)


@pytest.fixture(scope="module")
def maps(true) -> CoordinateMaps:
    return CoordinateMaps.of(images_of(true, SIZE))


@pytest.fixture(scope="module")
def known_rig(true) -> Adjustment:
    return adjust(disturbed(true), ExactMaps.around(true, SIZE), prior_of(FRAMES), "known-rig", QUICK)


def test_disturbed_frames_are_recovered(true, known_rig):
    assert errors(disturbed(true), true)[0] > 1 and errors(disturbed(true), true)[1] > 0.03
    turn, shift = errors(known_rig.rig, true)
    assert turn < 1e-2 and shift < 1e-3
    assert known_rig.median_before_px > 0.5 and known_rig.median_after_px < 1e-3


def test_disturbed_projectors_are_recovered_from_exact_look_ups(true):
    """Frames and projectors are disturbed; without pixels, only rounding separates the result from the truth."""
    start = disturbed(true, 1, relative=0.1)
    found = adjust(start, ExactMaps.around(true, SIZE), prior_of(FRAMES), "free", replace(QUICK, max_iterations=24))
    turn, shift = errors(found.rig, true)
    assert turn < 1e-2 and shift < 1e-3
    assert found.median_after_px < 0.02


def test_a_known_rig_keeps_every_relative_pose_bit_for_bit(true, known_rig):
    assert torch.equal(known_rig.rig.T_camera_projector, true.T_camera_projector)


def test_a_rigid_rig_moves_all_projectors_alike(true, maps):
    common = exp_se3(torch.tensor([0.01, -0.01, 0.005, 0.002, -0.003, 0.004], dtype=torch.float64))
    start = disturbed(true, 2, degrees=0.3, shift=0.01)
    start = replace(start, T_camera_projector=common @ start.T_camera_projector)
    found = adjust(
        start, maps, prior_of(FRAMES, 0.5), "rigid-rig", replace(QUICK, max_iterations=8, rigid_iterations=3)
    ).rig
    moved = found.T_camera_projector @ inverse(start.T_camera_projector)
    assert torch.allclose(moved, moved[:1].expand_as(moved), rtol=0, atol=1e-12)
    assert not torch.allclose(moved[0], torch.eye(4, dtype=torch.float64), atol=1e-4)


def test_a_static_projector_stays_in_one_place_while_cameras_are_recovered():
    true = static_rig(FRAMES, SIZE)
    start = constrained("static-projector", disturbed(true, 3, relative=0.1))
    there = start.T_world_projector
    assert torch.allclose(there, there[:1].expand_as(there), rtol=0, atol=1e-12)
    found = adjust(start, ExactMaps.around(true, SIZE), prior_of(FRAMES), "static-projector", QUICK)
    assert torch.allclose(found.rig.T_world_projector, there, rtol=0, atol=1e-9)
    assert errors(start, true)[0] > 0.1
    turn, shift = errors(found.rig, true)
    assert turn < 1e-2 and shift < 1e-3


def test_off_moves_nothing(true, maps):
    start = disturbed(true)
    found = adjust(start, maps, prior_of(FRAMES), "off", replace(QUICK, max_iterations=2))
    assert torch.equal(found.rig.T_world_camera, start.T_world_camera)
    assert torch.equal(found.rig.T_camera_projector, start.T_camera_projector)
    assert torch.equal(found.covariance, torch.zeros_like(found.covariance))


def test_exact_starts_stay_where_they_are(true):
    found = adjust(true, ExactMaps.around(true, SIZE), prior_of(FRAMES), "free", replace(QUICK, max_iterations=3))
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


def test_wrong_cells_do_not_spoil_it(true):
    """3 % of the cells of 5 x 5 pixels."""
    cells = torch.rand(FRAMES, SIZE // 5, SIZE // 5, generator=torch.Generator().manual_seed(0)) < 0.03
    m = ExactMaps.around(true, SIZE)
    wrong = cells.repeat_interleave(5, 1).repeat_interleave(5, 2)
    maps = SpoiltMaps(m.values, m.index, m.settings, m.max_roughness, true, wrong)
    turn, shift = errors(
        adjust(disturbed(true), maps, prior_of(FRAMES), "known-rig", replace(QUICK, max_iterations=30)).rig, true
    )
    assert turn < 1e-2 and shift < 1e-3


def test_one_seed_one_result(true, maps):
    brief = replace(QUICK, anchors_per_frame=30, max_iterations=3)
    a, b, c = (
        adjust(disturbed(true), maps, prior_of(FRAMES), "free", replace(brief, seed=seed)).rig for seed in (5, 5, 6)
    )
    assert torch.equal(a.T_world_camera, b.T_world_camera) and torch.equal(a.T_camera_projector, b.T_camera_projector)
    assert not torch.equal(a.T_world_camera, c.T_world_camera)


def test_frames_that_share_nothing_do_not_move(true, maps):
    """A single frame, and frames of which one decoded nothing: no exception, no NaN."""
    one = Rig(true.camera[:1], true.projector, true.T_world_camera[:1], true.T_camera_projector[:1])
    alone = adjust(one, CoordinateMaps.of(images_of(one, SIZE)), prior_of(1), "free", QUICK)
    assert torch.equal(alone.rig.T_world_camera, one.T_world_camera)
    assert torch.equal(alone.rig.T_camera_projector, one.T_camera_projector)
    assert alone.covariance.isfinite().all() and alone.noise_px > 0
    none = adjust(disturbed(true), maps, prior_of(FRAMES), "free", replace(QUICK, max_iterations=0))
    assert torch.equal(none.rig.T_world_camera, disturbed(true).T_world_camera) and none.iterations == 0
    images = images_of(true, SIZE)
    images[2] = torch.full_like(images[2], float("nan"))
    found = adjust(true, CoordinateMaps.of(images), prior_of(FRAMES), "free", replace(QUICK, max_iterations=3)).rig
    assert found.T_world_camera.isfinite().all() and found.T_camera_projector.isfinite().all()
    assert torch.allclose(found.T_world_camera[2], true.T_world_camera[2], atol=1e-9)


def test_the_covariance_is_one(known_rig):
    C = known_rig.covariance
    assert torch.allclose(C, C.T, atol=1e-12) and torch.linalg.eigvalsh(C).min() > -1e-12
    assert (C.diagonal()[: 6 * FRAMES] > 0).all()


@pytest.mark.parametrize(
    "mode, columns", [("free", 36), ("rigid-rig", 24), ("known-rig", 18), ("static-projector", 18), ("off", 0)]
)
def test_free_directions_of_each_mode(mode, columns):
    rig = rig_of(3, SIZE)
    free = free_parameters(mode, rig)
    assert free.count == columns
    B = free.steps(torch.eye(columns, dtype=torch.float64)).flatten(0, 1)
    generator = torch.Generator().manual_seed(0)
    A, y = torch.randn(36, 36, dtype=torch.float64, generator=generator), torch.randn(36, generator=generator).double()
    assert torch.allclose(free.matrix(A + A.T), B.T @ (A + A.T) @ B, rtol=0, atol=1e-12)
    assert torch.allclose(free.vector(y.reshape(3, 12)), B.T @ y, rtol=0, atol=1e-12)
    x = torch.randn(columns, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    step = free.step(x)
    assert torch.allclose(step.flatten(), B @ x, rtol=0, atol=1e-12)
    delta, rho = step[:, :6], step[:, 6:]
    if columns:
        assert torch.linalg.matrix_rank(B) == columns and (delta != 0).all()
    if mode == "rigid-rig":
        assert torch.equal(rho, rho[:1].expand_as(rho)) and (rho != 0).all()
    if mode in ("known-rig", "off"):
        assert torch.equal(rho, torch.zeros_like(rho))
    if mode == "static-projector":
        stays = rig.moved(delta, rho).T_world_projector
        assert torch.allclose(stays, rig.T_world_projector, rtol=0, atol=1e-9)


def test_prior_equations_are_derivatives_of_the_weighted_difference():
    """To first order in the difference from the start, which is what a Gauss-Newton step needs."""
    n = 2
    true = rig_of(n, SIZE)
    sigmas = [torch.rand(n, dtype=torch.float64, generator=torch.Generator().manual_seed(s)) + 0.1 for s in range(4)]
    prior = PosePrior(*sigmas)
    rig = disturbed(true, 7, degrees=0.05, shift=0.001, relative=1.0)

    def half_cost(r: Rig) -> float:
        delta = log_se3(r.T_world_camera @ inverse(true.T_world_camera))
        t = r.T_camera_projector[:, :3, 3] - true.T_camera_projector[:, :3, 3]
        w = log_so3(r.T_camera_projector[:, :3, :3] @ true.T_camera_projector[:, :3, :3].transpose(1, 2))
        parts = (delta[:, :3], delta[:, 3:], t, w)
        return sum(float((p.pow(2).sum(-1) / s**2).sum()) / 2 for p, s in zip(parts, sigmas, strict=True))

    H, g = prior_equations(prior, true, rig)
    g = by_kind(g)
    step, expected = 1e-5, torch.zeros_like(g)
    for k in range(len(g)):
        x = torch.zeros(12 * n, dtype=torch.float64)
        x[k] = step
        plus, minus = (rig.moved(*(s * x).reshape(2, n, 6)) for s in (1, -1))
        expected[k] = (half_cost(plus) - half_cost(minus)) / (2 * step)
    assert (g - expected).abs().max() < 5e-3 * expected.abs().max()
    assert torch.allclose(H, H.transpose(1, 2)) and torch.linalg.eigvalsh(H).min() > 0
    term = PriorTerm(prior, true, 3.0)
    assert term.energy(rig) == pytest.approx(6 * half_cost(rig), rel=1e-12)
    assert torch.equal(term.equations(rig)[0], 3 * H) and torch.equal(by_kind(term.equations(rig)[1]), 3 * g)
    factor = joint_of_prior(prior, rig)
    inverse_H = torch.linalg.inv(matrix_by_kind(torch.block_diag(*H), n))
    wanted = torch.block_diag(inverse_H, prior.intrinsics_sigma.square().diag())
    assert torch.allclose(factor @ factor.T, wanted, rtol=0, atol=1e-12)
    at_start = prior_equations(prior, true, true)[1]
    assert at_start.abs().max() < 1e-12 * float(H.abs().max())


def test_errors_that_all_frames_share_near_borders_do_not_turn_the_cameras():
    """Within three pixels of the border of what is decoded, coordinates are off in the same sense in every frame."""
    true, generator = rig_of(FRAMES, 2 * SIZE), torch.Generator().manual_seed(5)
    noisy = []
    for image in images_of(true, 2 * SIZE):
        outside = 1 - torch.isfinite(image[..., 0]).float()
        near = torch.nn.functional.max_pool2d(outside[None], 7, 1, 3)[0]
        noisy.append(image + 0.1 * torch.randn(image.shape, generator=generator) + 0.6 * near[..., None])
    maps, start, settings = CoordinateMaps.of(noisy), disturbed(true), replace(QUICK, anchors_per_frame=300)
    all_of_them = replace(settings, kernel=replace(settings.kernel, most_border_noise=float("inf")))
    turn, other = (
        errors(adjust(start, maps, prior_of(FRAMES), "known-rig", s).rig, true)[0] for s in (settings, all_of_them)
    )
    assert turn < 0.7 * other
