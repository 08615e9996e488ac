"""A whole step by kernels for GPUs, run on the CPU: poses from their parameters, and trainings of a tiny scan."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks.common.training import Training, settings
from sl_nerfstudio.field.device_kernels import launches
from sl_nerfstudio.geometry.lie import exp_se3
from sl_nerfstudio.model.kernel_step import device_poses
from sl_nerfstudio.model.poses import PoseParameters
from tests.model.test_poses import KINDS

FRAMES = 5


MOVING = [kind for kind in KINDS if "off" not in kind.get("modes", ())]


@pytest.mark.parametrize("size", [1e-6, 0.05, 1.0])  # series below 0.3 rad
@pytest.mark.parametrize("kind", [*MOVING, {"about_scene": False, "shared_projector": True}])
@pytest.mark.slow
def test_poses_and_adjoints_of_all_parametrisations_are_torchs(kind: dict[str, Any], size: float) -> None:
    torch.manual_seed(0)
    bases = exp_se3(torch.randn(2, FRAMES, 6, dtype=torch.float64))
    moves = kind.get("refine_projector", True)
    poses = PoseParameters(*bases, refine=True, **kind)
    with torch.no_grad():
        poses.camera_step.copy_(size * torch.randn_like(poses.camera_step))
        poses.projector_step.copy_(size * torch.randn_like(poses.projector_step))
    upstream = torch.randn(2, FRAMES, 4, 4)
    expected, found = poses(), device_poses(poses)
    for got, wanted in zip(found, expected, strict=True):
        torch.testing.assert_close(got.double(), wanted, atol=3e-7, rtol=0)

    def pulled(T: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
        steps = [poses.camera_step, poses.projector_step][: 1 + moves]
        return torch.autograd.grad(sum((a * b).sum() for a, b in zip(T, upstream, strict=True)), steps)

    for got, wanted in zip(pulled(found), pulled(expected), strict=True):
        torch.testing.assert_close(got, wanted, atol=1e-5, rtol=1e-5)


def training(method: str, backend: str, scan_root: Path, folder: Path) -> Training:
    config = settings(method, scan_root, folder / backend, "cpu", 40)
    c = config.pipeline.model
    c.sdf.backend, c.sdf.log2_table_size, c.sdf.max_resolution, c.sdf.hidden = backend, 12, 64, 32
    c.sampling.render_rays, c.sampling.eikonal_points = 100, 150
    config.pipeline.datamanager.train_num_rays_per_batch = 128
    torch.manual_seed(0)
    return Training(config)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["sl-neus", "sl-neus-paper"])
def test_a_training_by_kernels_goes_as_one_by_plain_operations(method: str, scan_root: Path, tmp_path: Path) -> None:
    """Other random numbers, but the same start and the same pixels: after 25 steps, losses are alike."""
    terms = []
    for backend in ("numba", "triton"):
        run = training(method, backend, scan_root, tmp_path)
        seen = []
        for _ in range(25):
            with launches() as kernels:
                seen.append(run.step())
        assert bool(kernels) == (backend == "triton") and len(kernels) <= 30
        last = {name: sum(float(step[1][name]) for step in seen[-8:]) for name in seen[-1][1]}
        last["px"] = sum(float(step[2]["coordinate_px"]) for step in seen[-8:])
        terms.append((last, float(run.model.device_poses.camera_step.detach().abs().sum())))
    (plain, moved), (ours, moved_too) = terms
    assert list(plain) == list(ours)
    for name, value in plain.items():
        assert ours[name] == pytest.approx(value, rel=0.25), name
    assert (moved > 0) == (method == "sl-neus-paper") and moved_too == pytest.approx(moved, rel=0.25)


def test_triangulated_points_from_which_poses_learn_have_no_kernels(scan_root: Path, tmp_path: Path) -> None:
    config = settings("sl-neus", scan_root, tmp_path, "cpu", 5)
    config.pipeline.model.sdf.backend, config.pipeline.model.pose_method = "triton", "render"
    config.pipeline.model.sdf.log2_table_size, config.pipeline.datamanager.train_num_rays_per_batch = 10, 64
    run = Training(config)
    assert not run.model.has_kernels
    run.step()  # by plain operations around the field's own kernels
    assert bool(run.model.device_poses.camera_step.grad.any())
