"""The compiled loop finds what the torch operations find, for both projector models, bad rays included."""

import pytest
import torch

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import exp_se3, inverse, transform
from sl_nerfstudio.rendering import direct_losses
from sl_nerfstudio.rendering.direct_losses import DecodingNoise, MeasuredRays, _measured

NOISE = DecodingNoise(px=torch.tensor(0.3), px_per_length=torch.tensor(150.0))
PINHOLE = Device(400, 300, 420.0, 430.0, 210.0, 140.0, k1=-0.1, k2=0.02, p1=0.001, p2=-0.002)
DOE = Device(400, 300, 420.0, 430.0, 210.0, 140.0, model="DOE")


def some_rays(projector: Intrinsics, seed: int) -> MeasuredRays:
    """Points near the origin seen from devices about 3 away; coordinates with noise, some of them wrong."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    p = 0.3 * normal(500, 3)
    T = exp_se3(torch.cat([torch.tensor([0.5, 0.2, 3.0]) + 0.1 * normal(500, 3), 0.1 * normal(500, 3)], 1))
    o = torch.tensor([-0.4, 0.1, 3.0]) + 0.1 * normal(500, 3)
    uv = project(projector, transform(inverse(T), p))[0] + 0.3 * normal(500, 2)
    uv[:50] += 40 * normal(50, 2)
    uv[50:60] = torch.nan
    d = p - o
    d[60:80] *= -1  # meet behind the camera
    T[80] = torch.eye(4)
    o[80], d[80], uv[80] = 0.0, torch.tensor([0.0, 0.0, -1.0]), torch.tensor([210.0, 140.0])  # the same ray
    return MeasuredRays(o, d / d.norm(dim=-1, keepdim=True), T, uv)


@pytest.mark.parametrize("device", [PINHOLE, DOE], ids=["pinhole", "DOE"])
@pytest.mark.parametrize("seed", range(5))
def test_the_loop_measures_what_torch_does(monkeypatch, device, seed):
    projector = Intrinsics.of(device)
    rays = some_rays(projector, seed)
    decoded = rays.uv_projector.isfinite().all(-1)
    depth, sigma, weight = _measured(rays, decoded, projector, NOISE)
    monkeypatch.setattr(direct_losses, "compiled_measures", lambda *_: False)
    exact = MeasuredRays(*(x.double() for x in vars(rays).values()))
    in_torch = _measured(exact, decoded, Intrinsics.of(device, torch.float64), NOISE)
    counts = in_torch[2] > 0
    assert 300 < counts.sum() < 460 and not counts[50:60].any() and not counts[80]
    assert torch.equal(weight > 0, counts)
    for found, expected in zip((depth, sigma, weight), in_torch, strict=True):
        assert found.dtype == torch.float32
        assert torch.allclose(found[counts].double(), expected[counts], rtol=2e-4)
    assert (depth[80], sigma[80], weight[80]) == (1.0, 0.0, 0.0)


def test_poses_that_learn_are_measured_with_gradients():
    projector = Intrinsics.of(PINHOLE)
    rays = some_rays(projector, 0).chosen(torch.arange(500) > 80)
    rays.T_scene_projector.requires_grad_()
    depth = _measured(rays, rays.uv_projector.isfinite().all(-1), projector, NOISE)[0]
    (gradient,) = torch.autograd.grad(depth.sum(), rays.T_scene_projector)
    assert (gradient.abs().amax((1, 2)) > 0).all()
