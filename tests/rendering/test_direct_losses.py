"""Losses on triangulated points, with an analytic sphere in place of the field; where rays meet, in a compiled loop."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import exp_se3, inverse, pose, transform
from sl_nerfstudio.rendering.direct_losses import (
    DecodingNoise,
    MeasuredRays,
    _measured,
    direct_losses,
    field_losses,
    random_points,
)
from sl_nerfstudio.rendering.losses import LossConfig, surface_width_at

RADIUS = 0.5
NOISE = DecodingNoise(px=0.3, px_per_length=150.0)
PROJECTOR = Intrinsics.of(Device(400, 400, 520.0, 520.0, 200.0, 200.0), torch.float64)


class Sphere:
    """A signed distance field of slope one, or its negative."""

    def __init__(self, radius: float = RADIUS, sign: float = 1.0) -> None:
        self.radius, self.sign = radius, sign

    def sdf(self, p: Tensor) -> Tensor:
        return self.sign * (p.norm(dim=-1) - self.radius)

    def sdf_and_gradient(self, p: Tensor) -> tuple[Tensor, Tensor]:
        return self.sdf(p), self.sign * p / p.norm(dim=-1, keepdim=True)


def projector_pose() -> Tensor:
    back = torch.tensor([1.0, 0.2, 2.8], dtype=torch.float64)
    t, back = back, back / back.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), back)
    right = right / right.norm()
    return pose(torch.stack([right, torch.linalg.cross(back, right), back], 1), t)


@pytest.fixture
def rays() -> MeasuredRays:
    """Rays from (0, 0, 3) that meet the sphere, and the output of a perfect decoder there."""
    axis = torch.linspace(-0.25, 0.25, 12, dtype=torch.float64)
    aim = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    o = torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64).expand(len(aim), 3)
    d = torch.cat([aim, torch.zeros(len(aim), 1, dtype=torch.float64)], 1) - o
    d = d / d.norm(dim=-1, keepdim=True)
    b = (o * d).sum(-1)
    p = o + (-b - (b**2 - (o * o).sum(-1) + RADIUS**2).sqrt())[:, None] * d
    T = projector_pose()
    coords, lit = project(PROJECTOR, transform(inverse(T), p))
    assert lit.all()
    return MeasuredRays(o, d, T.expand(len(o), 4, 4), coords)


def losses(field: Sphere, rays: MeasuredRays, step: int = 500) -> dict[str, Tensor]:
    torch.manual_seed(0)
    points = random_points(1024, torch.device("cpu")).double()
    return direct_losses(field, rays, PROJECTOR, NOISE, points, LossConfig(), surface_width_at(step, 1000))


def kernel(distance: float, step: int) -> float:
    width = 0.2 * (0.02 / 0.2) ** (step / 1000)
    return width * (1 - torch.tensor(-distance / width).exp().item())


def test_the_true_field_costs_nothing_and_one_inside_out_costs_in_its_signs_but_not_at_the_surface(rays):
    for name, value in losses(Sphere(), rays).items():
        assert float(value) < 1e-9, name
    inside_out = losses(Sphere(sign=-1.0), rays)
    assert float(inside_out["free_space"]) > 0.01 and float(inside_out["surface"]) < 1e-9


@pytest.mark.parametrize("step", [0, 500, 1000])
def test_a_field_with_a_constant_error_costs_the_kernel_of_that_error(rays, step):
    found = losses(Sphere(RADIUS + 0.02), rays, step)["surface"]
    assert float(found) == pytest.approx(kernel(0.02, step), rel=1e-6)


class Folded(Sphere):
    """Three sheets, `half` apart: the middle one at the sphere, inside out; slope one everywhere, and no sign wrong
    farther than `half` from the sphere."""

    def __init__(self, half: float) -> None:
        super().__init__()
        self.half = half

    def _fold(self, p: Tensor) -> tuple[Tensor, Tensor]:
        x = super().sdf(p)
        return x, x.abs() < 0.5 * self.half

    def sdf(self, p: Tensor) -> Tensor:
        x, middle = self._fold(p)
        return torch.where(middle, -x, x - self.half * x.sign())

    def sdf_and_gradient(self, p: Tensor) -> tuple[Tensor, Tensor]:
        _, middle = self._fold(p)
        slope = torch.where(middle, -1.0, 1.0)[:, None] * p / p.norm(dim=-1, keepdim=True)
        return self.sdf(p), slope


@pytest.mark.parametrize("half", [0.002, 0.01, 0.02])
def test_a_surface_that_is_folded_around_the_measured_points_costs_in_its_signs(rays, half):
    found = losses(Folded(half), rays)
    assert float(found["surface"]) < 1e-9 and float(found["eikonal"]) < 1e-9
    assert float(found["free_space"]) > 0.05


def test_wrong_and_missing_decodings_do_not_count(rays):
    coords, decoded = rays.uv_projector.clone(), torch.ones(len(rays.origins), dtype=torch.bool)
    coords[::3, 1] += 25.0  # across the epipolar lines, which run along x here
    coords[1::5], decoded[1::5] = float("nan"), False
    field, spoilt = Sphere(RADIUS + 0.02), replace(rays, uv_projector=coords)
    for found in (losses(field, spoilt), losses(field, spoilt.chosen(decoded))):  # left in, as on a GPU, or taken out
        assert float(found["surface"]) == pytest.approx(kernel(0.02, 500), rel=1e-6)
        assert float(found["eikonal"]) < 1e-9


def test_without_direct_terms_only_the_slope_counts():
    points = random_points(1024, torch.device("cpu")).double()
    assert points.norm(dim=-1).max() <= 1 and 0.7 < float(points.norm(dim=-1).mean()) < 0.8  # uniform in the ball: 3/4
    found = field_losses(Sphere(RADIUS + 0.1), points, LossConfig(surface=0.0, free_space=0.0))
    assert list(found) == ["eikonal"] and float(found["eikonal"]) < 1e-9
    assert not LossConfig(surface=0.0, free_space=0.0).direct and LossConfig().direct


def test_the_gradient_by_the_pose_of_the_projector_is_a_central_difference(rays):
    """Also with missing decodings among the rays."""
    coords = rays.uv_projector.clone()
    coords[1::5] = float("nan")

    def surface(xi: Tensor) -> Tensor:
        T = exp_se3(xi) @ projector_pose()
        turned = replace(rays, uv_projector=coords, T_scene_projector=T.expand(len(rays.origins), 4, 4))
        return losses(Sphere(RADIUS + 0.02), turned)["surface"]

    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(surface(xi), xi)
    step = 1e-6
    for k, axis in enumerate(torch.eye(6, dtype=torch.float64)):
        central = (surface(step * axis) - surface(-step * axis)).item() / (2 * step)
        assert float(gradient[k]) == pytest.approx(central, abs=2e-5 * float(gradient.abs().max()) + 1e-9)


TENSOR_NOISE = DecodingNoise(px=torch.tensor(0.3), px_per_length=torch.tensor(150.0))
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
    depth, sigma, weight = _measured(rays, decoded, projector, TENSOR_NOISE)
    monkeypatch.setattr("sl_nerfstudio.rendering.direct_losses.compiled_measures", lambda *_: False)
    exact = MeasuredRays(*(x.double() for x in vars(rays).values()))
    in_torch = _measured(exact, decoded, Intrinsics.of(device, torch.float64), TENSOR_NOISE)
    counts = in_torch[2] > 0
    assert 300 < counts.sum() < 460 and not counts[50:60].any() and not counts[80]
    assert torch.equal(weight > 0, counts)
    for found, expected in zip((depth, sigma, weight), in_torch, strict=True):
        assert found.dtype == torch.float32
        assert torch.allclose(found[counts].double(), expected[counts], rtol=2e-4)
    assert (depth[80], sigma[80], weight[80]) == (1.0, 0.0, 0.0)


def test_missing_decodings_leave_the_gradient_of_poses_finite(rays):
    coords = rays.uv_projector.clone()
    coords[1::5] = float("nan")
    T = rays.T_scene_projector.clone().requires_grad_()
    sum(losses(Sphere(0.4), replace(rays, uv_projector=coords, T_scene_projector=T)).values()).backward()
    assert T.grad is not None and T.grad.isfinite().all()
    assert T.grad[0].abs().max() > 0 and T.grad[1::5].abs().max() == 0


def test_poses_that_learn_are_measured_with_gradients():
    projector = Intrinsics.of(PINHOLE)
    rays = some_rays(projector, 0).chosen(torch.arange(500) > 80)
    rays.T_scene_projector.requires_grad_()
    depth = _measured(rays, rays.uv_projector.isfinite().all(-1), projector, TENSOR_NOISE)[0]
    (gradient,) = torch.autograd.grad(depth.sum(), rays.T_scene_projector)
    assert (gradient.abs().amax((1, 2)) > 0).all()
