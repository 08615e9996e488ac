"""The renderer on two balls: what rays see and which places are lit, against intersections in closed form."""

import math
from typing import Literal

import pytest
import torch
from torch import Tensor

from sl_nerfstudio.field.field import CachedGrid
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import inverse, transform
from sl_nerfstudio.rendering.renderer import Renderer, SamplingConfig
from tests.meshing.ray_cast_scan import look_at

BALLS = torch.tensor([[0.0, 0.0, 0.0, 0.4], [0.45, 0.0, 0.5, 0.15]])  # centre and radius: the second shades the first
PROJECTOR = Intrinsics.of(Device(64, 48, 100.0, 100.0, 32.0, 24.0), torch.float32)
PROJECTOR_CENTRE = torch.tensor([1.5, 0.0, 2.0])


class Balls:
    """Exact distances of their union."""

    def sdf(self, p: Tensor) -> Tensor:
        return ((p[:, None] - BALLS[:, :3]).norm(dim=-1) - BALLS[:, 3]).amin(-1)

    def sdf_and_gradient(self, p: Tensor) -> tuple[Tensor, Tensor]:
        p = p.detach().requires_grad_()
        f = self.sdf(p)
        return f.detach(), torch.autograd.grad(f.sum(), p)[0]


def renderer(strategy: Literal["surface", "uniform"], kappa: float = 2000.0) -> Renderer:
    cache = CachedGrid(96)
    cache.refresh(Balls())
    pattern = torch.ones(48, 64)
    return Renderer(Balls(), cache, PROJECTOR, pattern, SamplingConfig(strategy=strategy), kappa)


def hit(o: Tensor, d: Tensor) -> Tensor:
    """Distance to the first ball along unit rays, infinite where none is met; float64."""
    to_centre = o[:, None] - BALLS[:, :3].double()
    b = (to_centre * d[:, None]).sum(-1)
    root = b * b - to_centre.square().sum(-1) + BALLS[:, 3].double() ** 2
    t = -b - root.clamp_min(0).sqrt()
    return torch.where((root > 0) & (t > 1e-6), t, math.inf).amin(-1)


def rays(n: int = 60) -> tuple[Tensor, Tensor]:
    x, y = torch.meshgrid(*(torch.linspace(-0.22, 0.22, n, dtype=torch.float64),) * 2, indexing="ij")
    d = torch.stack([x, y, -torch.ones_like(x)], -1).reshape(-1, 3)
    return torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64).expand_as(d), d / d.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize(("strategy", "samples"), [("surface", 64), ("uniform", 2000)])
@pytest.mark.parametrize("jitter", [False, True])
def test_rays_see_the_first_surface_and_its_coordinates(strategy, samples, jitter):
    torch.manual_seed(0)
    o, d = rays(30)
    t = hit(o, d)
    p = o + t[:, None].clamp_max(9) * d
    rim = ((p[:, None] - BALLS[:, :3]).norm(dim=-1) - BALLS[:, 3] < 0.002) & (
        -((p[:, None] - BALLS[:, :3]) * d[:, None]).sum(-1) < 0.35 * BALLS[:, 3]
    )
    met = t.isfinite() & ~rim.any(-1)  # along an outline, one sample decides
    T = inverse(torch.from_numpy(look_at(PROJECTOR_CENTRE.tolist())).float()).expand(len(o), 4, 4)
    seen = renderer(strategy).render(o.float(), d.float(), T, samples, jitter)
    nearest = Balls().sdf((o[:, None] + torch.linspace(2, 4, 400)[:, None] * d[:, None]).reshape(-1, 3).float())
    clear = nearest.reshape(len(o), -1).amin(-1) > 0.03
    assert met.sum() > 200 and clear.sum() > 200
    assert (seen.accumulation[met] > 0.99).all() and (seen.accumulation[clear] < 0.01).all()
    torch.testing.assert_close(seen.depth[met], t[met].float(), rtol=0, atol=2e-3)
    uv, _ = project(PROJECTOR.to(torch.float64), transform(T.double(), p))
    assert (seen.coordinates[met] - uv[met]).norm(dim=-1).quantile(0.95) < 0.1


def test_lit_is_what_faces_the_projector_with_nothing_between() -> None:
    o, d = rays()
    t = hit(o, d)
    p = (o + t[:, None] * d)[t.isfinite()]
    f = Balls()
    normal = f.sdf_and_gradient(p.float())[1]
    to_projector = PROJECTOR_CENTRE.double() - p
    way = to_projector / to_projector.norm(dim=-1, keepdim=True)
    cosine = (normal * way).sum(-1)
    shaded = hit(p + 1e-5 * normal, way).isfinite()
    expected = (cosine > 0) & ~shaded
    other = BALLS[((p[:, None] - BALLS[:, :3]).norm(dim=-1) - BALLS[:, 3]).argmax(-1)].double()
    miss = torch.linalg.cross(other[:, :3] - p, way).norm(dim=-1) - other[:, 3]
    grazing = miss.abs() < 0.04  # near the edge of the other ball's shadow
    certain = (cosine.abs() > 0.15) & ~grazing
    assert (expected & certain).sum() > 200 and (shaded & (cosine > 0.15) & certain).sum() > 20
    lit = renderer("surface").is_lit(p.float(), normal, PROJECTOR_CENTRE.expand(len(p), 3))
    assert torch.equal(lit[certain], expected[certain])


class Plane:
    """Distance from a plane across the view."""

    def __init__(self, height: float) -> None:
        self.height = height

    def sdf(self, p: Tensor) -> Tensor:
        return p[:, 2] - self.height

    def sdf_and_gradient(self, p: Tensor) -> tuple[Tensor, Tensor]:
        return self.sdf(p), torch.tensor([0.0, 0.0, 1.0]).expand_as(p)


@pytest.mark.parametrize("kappa", [32.0, 400.0, 3000.0])
def test_images_have_samples_enough_for_the_depth_at_any_sharpness(kappa: float) -> None:
    """Wherever the samples are beside the surface: the cached grid is wrong by up to half of its cell."""
    o, d = torch.tensor([[0.1, 0.0, 0.9]]), torch.tensor([[0.3, 0.0, -(0.91**0.5)]])
    T = inverse(torch.from_numpy(look_at(PROJECTOR_CENTRE.tolist())).float())[None]
    errors = []
    for share in torch.linspace(-0.5, 0.5, 41).tolist():
        cache = CachedGrid(96)
        cache.refresh(Plane(0.123 + share * cache.cell))
        r = Renderer(Plane(0.123), cache, PROJECTOR, torch.ones(48, 64), SamplingConfig(), kappa)
        with torch.no_grad():
            depths = [float(r.render(o, d, T, count, jitter=False).depth) for count in (r.image_samples, 1000)]
        errors.append(depths[0] - depths[1])
    assert max(map(abs, errors)) * kappa < 0.02
    assert r.image_samples <= 12 + kappa * cache.cell
