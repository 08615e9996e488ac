"""Poses as parameters: increments, derivatives, other base poses, and what each choice keeps fixed."""

from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.lie_groups import exp_map_SE3, exp_map_SO3xR3
from scipy.spatial.transform import Rotation

from sl_nerfstudio.bundle_adjustment.parameters import SelfCalibration
from sl_nerfstudio.geometry.lie import exp_se3, inverse
from sl_nerfstudio.model.model import SLModelConfig, pose_parameters
from sl_nerfstudio.model.poses import PoseOptimizerConfig, PoseParameters, increments

FRAMES = 3
KINDS = [
    {},
    {"shared_projector": True},
    {"projector_moves_by": "own pose", "about_scene": False},
    {"about_scene": False},
    {"projector_moves_by": "nothing", "refine_projector": False},
    {"projector_moves_by": "own pose", "about_scene": False, "modes": ("SO3xR3", "SO3xR3")},
    {"modes": ("SO3xR3", "SE3")},
    {"projector_moves_by": "own pose", "about_scene": False, "modes": ("off", "SO3xR3")},
]
ALL_KINDS = pytest.mark.parametrize("kind", KINDS)


def random_poses(seed: int) -> torch.Tensor:
    return exp_se3(torch.randn(FRAMES, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


def make(**kind: Any) -> PoseParameters:
    return PoseParameters(random_poses(0), random_poses(1), refine=True, **kind).double()


def set_steps(poses: PoseParameters, seed: int = 2) -> None:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for step in (poses.camera_step, poses.projector_step):
            step.copy_(0.1 * torch.randn(step.shape, generator=generator, dtype=torch.float64))


@ALL_KINDS
def test_gradients_are_central_differences(kind):
    poses = make(**kind)
    set_steps(poses)
    weight = torch.randn(2, FRAMES, 4, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def value() -> torch.Tensor:
        return (torch.stack(poses()) * weight).sum()

    value().backward()
    for step in (step for step in poses.parameters() if step.requires_grad):
        expected = torch.zeros_like(step)
        for i in range(step.numel()):
            with torch.no_grad():
                flat = step.view(-1)
                flat[i] += 1e-6
                plus = value()
                flat[i] -= 2e-6
                expected.view(-1)[i] = (plus - value()) / 2e-6
                flat[i] += 1e-6
        assert step.grad is not None and torch.allclose(step.grad, expected, atol=1e-7)


@ALL_KINDS
def test_poses_are_the_increments_of_each_kind_to_other_bases_and_a_checkpoint_has_them(kind):
    poses = make(**kind)
    set_steps(poses, 7)
    poses.rebase(random_poses(5), random_poses(6))
    base, light = random_poses(5), random_poses(6)
    for found, expected in zip(poses(), (base, light), strict=True):
        assert torch.allclose(found, expected, atol=1e-14)
    assert not poses.camera_step.any() and not poses.projector_step.any()
    set_steps(poses)
    modes = kind.get("modes", ("SE3", "SE3"))
    delta, rho = (increments(m, step) for m, step in zip(modes, (poses.camera_step, poses.projector_step), strict=True))
    camera = delta @ base if kind.get("about_scene", True) else base @ delta
    projector = {
        "nothing": light,
        "own pose": light @ rho,
        "relative pose": camera @ rho @ inverse(base) @ light,
    }[kind.get("projector_moves_by", "relative pose")]
    for found, expected in zip(poses(), (camera, projector), strict=True):
        assert found.dtype == torch.float64 and torch.allclose(found, expected, atol=1e-13)
    other = PoseParameters(random_poses(8), random_poses(9), refine=True, **kind).double()
    other.load_state_dict(poses.state_dict())
    assert all(torch.equal(a, b) for a, b in zip(poses(), other(), strict=True))
    assert torch.equal(other.start_camera, random_poses(0)) and torch.equal(other.start_projector, random_poses(1))
    assert other.sigma.isnan().all()


def rotation(w: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(w).as_matrix()


@pytest.mark.parametrize("size", [1e-9, 0.1, 1.0, 3.0])
def test_increments_by_other_formulas(size):
    """Rotations by scipy, and what nerfstudio itself computes; SE3 in tests/geometry/test_lie.py."""
    steps = size * torch.randn(5, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    found = {mode: increments(mode, steps) for mode in ("SE3", "SO3xR3", "off")}
    for i, step in enumerate(steps.numpy()):
        apart = np.block([[rotation(step[3:]), step[:3, None]], [np.eye(4)[3:]]])
        np.testing.assert_allclose(found["SO3xR3"][i], apart, atol=1e-14)
    assert torch.equal(found["off"], torch.eye(4, dtype=torch.float64).expand(5, 4, 4))
    if size > 1e-4:  # nerfstudio's formulas lose digits of small rotations
        np.testing.assert_allclose(found["SE3"][:, :3], exp_map_SE3(steps), atol=1e-7)
        np.testing.assert_allclose(found["SO3xR3"][:, :3], exp_map_SO3xR3(steps), atol=1e-7)
    largest = (found["SE3"] - found["SO3xR3"])[:, :3, 3].norm(dim=1).max()
    assert largest > 0.1 * size**2, "the two differ in the translation by half the product of rotation and translation"


@pytest.mark.parametrize("method", ["render", "render-independently"])
@pytest.mark.parametrize("off", ["camera", "projector", "both"])
def test_off_leaves_poses_bit_for_bit(method, off):
    """What is off has no gradient, and whatever the optimiser does to the numbers, its poses stay the same bits."""
    modes = {device: PoseOptimizerConfig("off") for device in ("camera", "projector") if off in (device, "both")}
    config = SLModelConfig(pose_method=method, **{f"{device}_optimizer": mode for device, mode in modes.items()})
    start, light = random_poses(0), random_poses(1)
    poses = pose_parameters(config, start, light).double()
    assert config.moved_by_rendering == ("camera" not in modes, "projector" not in modes)
    assert (poses.camera_step.requires_grad, poses.projector_step.requires_grad) == config.moved_by_rendering
    with torch.no_grad():
        for step in (p for p in poses.parameters() if p.requires_grad):
            step.add_(0.1)
    camera, projector = poses()
    same = camera.detach().numpy().tobytes() == start.numpy().tobytes()
    assert same == ("camera" in modes)
    if method == "render-independently" or off == "both":
        assert (projector.detach().numpy().tobytes() == light.numpy().tobytes()) == ("projector" in modes)
    elif off == "projector":  # of a rig: relative to its camera
        assert torch.allclose(inverse(camera) @ projector, inverse(start) @ light, atol=1e-13)
    assert config.adjusts_poses is False and config.renders_poses == (off != "both")


METHODS = ("adjust", "render", "render-independently")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("free", ["free", "rigid-rig", "known-rig", "static-projector", "off"])
def test_every_choice_moves_what_it_says_and_keeps_the_rest_fixed(free, method):
    """One choice of what is free and one of how it is refined: no combination contradicts itself."""
    settings = SLModelConfig(refine_poses=free, pose_method=method)
    start, light = random_poses(0), random_poses(1)
    poses = pose_parameters(settings, start, light).double()
    moves = free != "off" and method != "adjust"
    assert settings.renders_poses == moves and settings.adjusts_poses == (free != "off" and method == "adjust")
    assert poses.camera_step.requires_grad == moves
    assert poses.projector_step.requires_grad == (moves and free in ("free", "rigid-rig"))
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():  # one step of any optimiser moves what has a gradient
        for step in (p for p in poses.parameters() if p.requires_grad):
            step.copy_(0.1 * torch.randn(step.shape, generator=generator, dtype=torch.float64))
    camera, projector = poses()
    before, after = inverse(start) @ light, inverse(camera) @ projector
    assert torch.allclose(camera, start, atol=1e-12) == (not moves)
    if free == "static-projector":
        assert torch.allclose(projector, light, atol=1e-12)
    elif free in ("known-rig", "off") or not moves:
        assert torch.allclose(after, before, atol=1e-12)
    elif free == "rigid-rig":
        change = after @ inverse(before)
        assert torch.allclose(change, change[:1].expand_as(change), atol=1e-12)
        assert not torch.allclose(change[0], torch.eye(4, dtype=torch.float64), atol=1e-3)
    else:
        assert (after - before).abs().flatten(1).amax(1).min() > 1e-3  # every frame's own


def test_results_of_the_adjustment_are_saved_with_the_poses():
    poses = make()
    assert poses.self_calibration() is None
    sigma, found = torch.rand(FRAMES, 12), SelfCalibration(torch.rand(6).double(), torch.eye(6).double())
    factor = torch.randn(12 * FRAMES + 6, 12 * FRAMES + 6).double()
    assert poses.joint_covariance() is None
    poses.note(sigma, factor, found)
    other = make()
    other.load_state_dict(poses.state_dict())
    kept = other.self_calibration()
    assert torch.equal(kept.change, found.change) and torch.equal(kept.covariance, found.covariance)
    assert torch.equal(other.sigma, sigma.double())
    assert np.array_equal(other.joint_covariance().factor, factor.numpy())
    poses.note(sigma, torch.cat([factor, factor[:, :4]], 1), found)  # with the columns of other minima, say
    more = poses.joint_covariance()
    assert more.factor.shape == factor.shape
    wanted = factor @ factor.T + factor[:, :4] @ factor[:, :4].T
    np.testing.assert_allclose(more.matrix, wanted.numpy(), atol=1e-9)
