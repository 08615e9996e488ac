"""The kernels of a training step, run on the CPU, against the plain operations in double precision."""

from dataclasses import dataclass, replace
from unittest import mock

import pytest
import torch
from torch import Tensor

from sl_nerfstudio.field.device_kernels import launches
from sl_nerfstudio.field.field import CachedGrid
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import exp_se3, inverse, transform
from sl_nerfstudio.geometry.triangulation import pixel_rays
from sl_nerfstudio.rendering.direct_losses import DecodingNoise, MeasuredRays, direct_losses, field_losses
from sl_nerfstudio.rendering.losses import LossConfig, coordinate_loss, pattern_loss
from sl_nerfstudio.rendering.renderer import Renderer, SamplingConfig
from sl_nerfstudio.rendering.triton_step import Pixels, Step, step_losses

PINHOLE = Device(64, 48, 80.0, 82.0, 32.0, 24.0)
PROJECTORS = {
    "pinhole": PINHOLE,
    "distorted": replace(PINHOLE, k1=-0.2, k2=0.05, p1=0.01, p2=-0.02),
    "DOE": replace(PINHOLE, model="DOE", k1=0.05),
}
RAYS, RENDERED, SAMPLES, OTHERS, FRAMES, TABLE = 60, 40, 16, 30, 3, 500
CAMERA = Device(40, 30, 50.0, 52.0, 20.0, 15.0, k1=-0.1, p2=0.01)
WIDTH, NOISE = 0.06, DecodingNoise(0.5, 40.0)


class Bumps:
    """A bumpy ball with two parameters, its radius and the height of the bumps."""

    def __init__(self, dtype: torch.dtype) -> None:
        self.shape = torch.tensor([0.5, 0.03], dtype=dtype, requires_grad=True)

    def sdf(self, p: Tensor) -> Tensor:
        return p.norm(dim=-1) - self.shape[0] + self.shape[1] * torch.sin(6 * p[:, 0]) * torch.cos(5 * p[:, 1])

    def sdf_and_gradient(self, p: Tensor) -> tuple[Tensor, Tensor]:
        q = p.detach()
        x, y = 6 * q[:, 0], 5 * q[:, 1]
        waves = torch.stack([6 * x.cos() * y.cos(), -5 * x.sin() * y.sin(), torch.zeros_like(x)], -1)
        return self.sdf(q), q / q.norm(dim=-1, keepdim=True) + self.shape[1] * waves

    def sdf_and_last_gradients(self, p: Tensor, first: int) -> tuple[Tensor, Tensor]:
        f, slopes = self.sdf_and_gradient(p[first:])
        return torch.cat([self.sdf(p[:first]), f]), slopes


def scene(name: str) -> dict[str, Tensor]:
    """Pixels, poses and a pattern: three cameras look at the ball from above, and projectors beside them light it."""
    generator = torch.Generator().manual_seed(3)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    twist = 0.1 * (rand(FRAMES, 6) - 0.5)
    T_camera = exp_se3(twist) @ exp_se3(torch.tensor([[0.0, 0, 2.2, 0, 0, 0]], dtype=torch.float64))
    T_projector = T_camera @ exp_se3(torch.tensor([[0.5, 0.1, 0, 0, 0.2, 0.1]], dtype=torch.float64))
    frame, row, column = (torch.randint(n, (TABLE,), generator=generator) for n in (FRAMES, 30, 40))
    uv = torch.stack([column, row], -1) + 0.5
    cameras = Intrinsics.of([CAMERA] * FRAMES, torch.float64)
    o, d = pixel_rays(cameras[frame], T_camera[frame], uv.double())
    b = (o * d).sum(-1)
    depth = -b - (b * b - (o * o).sum(-1) + 0.25).clamp_min(0.01).sqrt()
    projector = Intrinsics.of(PROJECTORS[name], torch.float64)
    coords, _ = project(projector, transform(inverse(T_projector)[frame], o + depth[:, None] * d))
    coords = (coords + 0.3 * (rand(TABLE, 2) - 0.5)).float()
    coords[::7] = float("nan")
    coords[3::11] += 9.0  # decoded wrongly
    return {
        "frame": frame.int(), "row": row.short(), "column": column.short(), "coords": coords,
        "captured": rand(TABLE).half(), "index": torch.randint(TABLE // 2, (RAYS,), generator=generator),
        "among": torch.randperm(TABLE, generator=generator)[: TABLE // 2].int(),
        "T_camera": T_camera.float(), "T_projector": T_projector.float(), "pattern": rand(48, 64).float(),
    }  # fmt: skip


def moving(x: dict[str, Tensor], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    return x["T_camera"].to(dtype).requires_grad_(), x["T_projector"].to(dtype).requires_grad_()


def weighted(terms: dict[str, Tensor]) -> Tensor:
    return torch.stack([w * term for w, term in zip((0.3, 2.0, 1.0, 0.7, 1.5), terms.values(), strict=False)]).sum()


Found = tuple[dict[str, Tensor], dict[str, Tensor], list[Tensor]]


def ours(name: str, step_of: "Settings", cache: Tensor) -> tuple[Found, list[str]]:
    """Losses, how well rays fit, gradients of the losses' sum by shape and poses; the kernels that were launched."""
    x, field = scene(name), Bumps(torch.float32)
    pixels = Pixels(x["index"], x["among"], x["frame"], x["row"], x["column"], x["coords"], x["captured"])
    devices = (Intrinsics.of([CAMERA] * FRAMES), Intrinsics.of(PROJECTORS[name]), x["pattern"])
    width = WIDTH if step_of.losses.direct else 0.0  # as in a training
    scalars = [torch.tensor(value, dtype=torch.float64) for value in (25.0, width)]
    scalars += [torch.tensor(value) for value in (NOISE.px, NOISE.px_per_length)]
    step = Step(pixels, *devices, *scalars, cache, step_of.sampling, step_of.losses, step_of.renders)
    poses = moving(x, torch.float32)
    torch.manual_seed(1)
    with launches() as kernels:
        terms, fit = step_losses(field, step, *poses)
        weighted(terms).backward()
    return (terms, fit, gradients_of(field, poses)), kernels


def gradients_of(field: Bumps, poses: tuple[Tensor, Tensor]) -> list[Tensor]:
    return [torch.zeros_like(y) if y.grad is None else y.grad for y in (field.shape, *poses)]


def plain(name: str, step_of: "Settings", cache: CachedGrid) -> Found:
    """The same by the plain operations in double precision, with the same random numbers."""
    x, field = scene(name), Bumps(torch.float64)
    index, sampling, weights = x["among"][x["index"]].long(), step_of.sampling, step_of.losses
    views, measured = x["frame"][index].long(), x["coords"][index].double()
    T_camera, T_projector = poses = moving(x, torch.float64)
    projector = Intrinsics.of(PROJECTORS[name], torch.float64)
    uv = torch.stack([x["column"], x["row"]], -1)[index] + 0.5
    o, d = pixel_rays(Intrinsics.of([CAMERA] * FRAMES, torch.float64)[views], T_camera[views], uv.double())
    n, r, direct = RAYS, RENDERED if step_of.renders else 0, RAYS if weights.direct else 0
    torch.manual_seed(1)
    noise = torch.rand(r * SAMPLES + 3 * direct + 3 * OTHERS).double()
    jitter, sides, others = noise.split([r * SAMPLES, 3 * direct, 3 * OTHERS])
    terms: dict[str, Tensor] = {}
    fit: dict[str, Tensor] = {}
    if r:
        with mock.patch.object(torch, "rand", lambda *_, **__: jitter.view(r, SAMPLES)):
            renderer = Renderer(field, cache, projector, x["pattern"].double(), sampling, 25.0)
            seen = renderer.render(o[:r], d[:r], inverse(T_projector)[views[:r]], SAMPLES, jitter=True)
        counts = measured[:r, 0].isfinite() & (seen.lit > 0.5)
        assert 10 < int(counts.sum()) < r
        scale = weights.coordinates_per_pixel or weights.coordinates / float(NOISE.px_per_length)
        terms["coordinates"] = scale * coordinate_loss(seen.coordinates, measured[:r], counts)
        terms["pattern"] = weights.pattern * pattern_loss(seen.pattern, x["captured"][index][:r].double())
        fit["coordinate_px"] = (seen.coordinates - measured[:r]).norm(dim=-1)[measured[:r, 0].isfinite()].median()
        captured = x["captured"][index][:r].double()
        fit["pattern_cosine"] = torch.nn.functional.cosine_similarity(seen.pattern, captured, dim=0)
    points = ball(others.view(-1, 3))
    if direct:
        decoded = measured[:, 0].isfinite()
        u, v, near = sides.view(n, 3)[decoded].T
        rays = MeasuredRays(o.detach(), d.detach(), T_projector[views].detach(), measured).chosen(decoded)
        with (
            mock.patch.object(torch, "rand", lambda *_, **__: torch.stack([u, v])),
            mock.patch.object(torch, "rand_like", lambda _: near),
        ):
            terms |= direct_losses(field, rays, projector, NOISE, points, weights, WIDTH)
    else:
        terms |= field_losses(field, points, weights)
    weighted(terms).backward()
    return terms, fit, gradients_of(field, poses)


def ball(noise: Tensor) -> Tensor:
    """Points uniform in the unit ball."""
    z, angle = 2 * noise[:, 0] - 1, 2 * torch.pi * noise[:, 1]
    around = (1 - z * z).sqrt()
    return noise[:, 2:] ** (1 / 3) * torch.stack([around * angle.cos(), around * angle.sin(), z], -1)


@dataclass(frozen=True)
class Settings:
    """A kind of step."""

    sampling: SamplingConfig
    losses: LossConfig
    renders: bool = True


def sampling(strategy: str) -> SamplingConfig:
    return SamplingConfig(strategy=strategy, samples=SAMPLES, render_rays=RENDERED, eikonal_points=OTHERS)


PAPER = LossConfig(coordinates=0.0, coordinates_per_pixel=0.02, pattern=0.05, eikonal=0.01, surface=0.0, free_space=0.0)
STEPS = {
    "default": Settings(sampling("surface"), LossConfig()),
    "before rendering": Settings(sampling("surface"), LossConfig(), renders=False),
    "paper": Settings(sampling("uniform"), PAPER),
}
LAUNCHES = {
    "default": "begin_rays render direct losses render_adjoint direct_adjoint",
    "before rendering": "begin_rays direct losses direct_adjoint",
    "paper": "begin_rays render direct losses render_adjoint direct_adjoint rays_adjoint",
}


CASES = [("default", "distorted"), ("default", "DOE"), ("before rendering", "pinhole"), ("paper", "pinhole")]


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_losses_and_gradients_of_a_step_are_those_of_the_plain_operations(kind: str, name: str) -> None:
    cache = CachedGrid(48).double()
    z, y, x = torch.meshgrid(*[torch.linspace(-1, 1, 48, dtype=torch.float64)] * 3, indexing="ij")
    cache.values.copy_(Bumps(torch.float64).sdf(torch.stack([x, y, z], -1).view(-1, 3)).detach().view(48, 48, 48))
    expected, fit, expected_gradients = plain(name, STEPS[kind], cache)
    (terms, found_fit, gradients), kernels = ours(name, STEPS[kind], cache.values.float())
    assert list(terms) == list(expected) and list(found_fit) == list(fit)
    for term, value in expected.items():
        assert float((terms[term] - value).abs().detach() / value.detach().abs()) < 2e-5, term
    for (measure, value), rtol in zip(fit.items(), (1e-4, 1e-5), strict=False):
        torch.testing.assert_close(found_fit[measure].double(), value.detach(), rtol=rtol, atol=0)
    for what, got, wanted in zip(("shape", "cameras", "projectors"), gradients, expected_gradients, strict=True):
        tolerance = 1e-4 if what == "shape" else 1e-3  # slopes of the pattern at coordinates in single precision
        assert float((got - wanted).abs().max()) <= tolerance * float(wanted.abs().max()), what
    assert bool(expected_gradients[1].any()) == STEPS[kind].renders
    assert [kernel for kernel in kernels if kernel != "rays_adjoint" or kind == "paper"] == LAUNCHES[kind].split()
