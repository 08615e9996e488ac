"""One training step, with our field and with nerfstudio's torch HashEncoding and the same MLP.

A step: sample rays, evaluate the field, render projector coordinates with SDF weights, L1 and Eikonal losses, backward
pass to table, MLP and poses, optimiser. Both sides do all of it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sl_nerfstudio.field.backend import BackendName
from sl_nerfstudio.field.field import FieldConfig, SDFField
from sl_nerfstudio.field.optimiser import RowAdam
from sl_nerfstudio.field.torch_backend import knee

KAPPA = 100.0
FRAMES = 22


@dataclass(frozen=True)
class Size:
    """Size of a step."""

    rays: int
    samples: int
    eikonal: int
    near_surface: bool
    """Samples in a band of 0.1 around the surface, or else from the near to the far side of the scene."""

    @property
    def points(self) -> int:
        """Number of points rendered."""
        return self.rays * self.samples


SIZES = {
    "paper": Size(rays=2024, samples=64, eikonal=4096, near_surface=False),
    "lean": Size(rays=1024, samples=16, eikonal=4096, near_surface=True),
}


class Job:
    """The part of a step that all variants share: rays onto a sphere seen from outside, poses, losses."""

    def __init__(self, size: Size, device: str = "cpu", seed: int = 0) -> None:
        self.size = size
        self.on: Any = {"generator": torch.Generator(device).manual_seed(seed), "device": device}
        self.shift = nn.Parameter(torch.zeros(FRAMES, 3, device=device))  # as poses do, it moves points
        self.frame = torch.randint(FRAMES, (size.rays,), **self.on)
        aim = F.normalize(torch.randn(size.rays, 3, **self.on), dim=-1) * 0.5
        eye = F.normalize(aim + 0.3 * torch.randn(size.rays, 3, **self.on), dim=-1) * 3.0
        self.direction = F.normalize(aim - eye, dim=-1)
        self.origin = eye
        self.hit = (aim - eye).norm(dim=-1)
        self.target = self._coordinates(aim) + 0.002 * torch.randn(size.rays, 2, **self.on)

    @staticmethod
    def _coordinates(p: Tensor) -> Tensor:
        """Coordinates in a pinhole projector at (0, 0, 4)."""
        return p[..., :2] / (4.0 - p[..., 2:])

    def rays(self) -> Tensor:
        """Points along the rays, [rays, samples, 3]."""
        half = 0.05 if self.size.near_surface else 1.0
        steps = torch.rand(self.size.rays, self.size.samples, **self.on)
        steps = (torch.arange(self.size.samples, device=steps.device) + steps) / self.size.samples
        t = self.hit[:, None] - half + 2 * half * steps
        return self.origin[:, None] + self.shift[self.frame][:, None] + t[..., None] * self.direction[:, None]

    def eikonal_points(self) -> Tensor:
        """Points for the Eikonal term: half anywhere, half near the surface."""
        p = torch.rand(self.size.eikonal, 3, **self.on) * 2 - 1
        p[::2] = F.normalize(p[::2], dim=-1) * (0.5 + 0.02 * torch.randn(len(p[::2]), 1, **self.on))
        return p

    def loss(self, sdf: Tensor, points: Tensor, gradient: Tensor) -> Tensor:
        """L1 error of the rendered coordinates, and the Eikonal term."""
        phi = torch.sigmoid(KAPPA * sdf.view(self.size.rays, self.size.samples))
        alpha = ((phi[:, :-1] - phi[:, 1:]) / phi[:, :-1].clamp_min(1e-12)).clamp(0, 1)
        light = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha + 1e-7], -1), -1)[:, :-1]
        rendered = ((light * alpha)[..., None] * self._coordinates(points[:, :-1])).sum(1)
        return (rendered - self.target).abs().mean() + 0.1 * ((gradient.norm(dim=-1) - 1) ** 2).mean()


class Ours:
    """Our field, with the optimisers that the methods use."""

    def __init__(self, size: Size, device: str = "cpu", backend: BackendName = "auto") -> None:
        torch.manual_seed(0)
        self.job = Job(size, device)
        self.field = SDFField(FieldConfig(backend=backend)).to(device)
        self.optimisers = [
            RowAdam([self.field.encoding.table], lr=1e-3),
            torch.optim.Adam([*self.field.mlp.parameters(), self.job.shift], lr=1e-4, fused=True),
        ]

    def step(self) -> Tensor:
        """Do one step, and return the loss before it."""
        for optimiser in self.optimisers:
            optimiser.zero_grad()
        points = self.job.rays()
        sdf = self.field.sdf(points.reshape(-1, 3))
        _, gradient = self.field.sdf_and_gradient(self.job.eikonal_points())
        loss = self.job.loss(sdf, points, gradient)
        loss.backward()
        for optimiser in self.optimisers:
            optimiser.step()
        return loss.detach()


class Theirs:
    """nerfstudio's encoding in torch, gradients by double backward, torch's default Adam for all parameters."""

    def __init__(
        self, size: Size, activation: Callable[[Tensor], Tensor], device: str = "cpu",
        implementation: Literal["torch", "tcnn"] = "torch",
    ) -> None:  # fmt: skip
        from nerfstudio.field_components.encodings import HashEncoding

        torch.manual_seed(0)
        self.job = Job(size, device)
        self.activation = activation
        self.encoding = HashEncoding(
            num_levels=5,
            min_res=16,
            max_res=256,
            log2_hashmap_size=19,
            features_per_level=8,
            implementation=implementation,
        ).to(device)
        self.mlp = SDFField(FieldConfig()).mlp.to(device)
        parameters = [*self.encoding.parameters(), *self.mlp.parameters(), self.job.shift]
        self.optimiser = torch.optim.Adam(parameters, lr=1e-3)

    def sdf(self, p: Tensor) -> Tensor:
        """The same network on nerfstudio's features, which expect points in [0, 1]^3."""
        h = torch.cat([p, self.encoding((p + 1) / 2)], -1)
        for layer in list(self.mlp)[:-1]:
            h = self.activation(layer(h))
        return self.mlp[-1](h)[:, 0]

    def step(self) -> Tensor:
        """Do one step, and return the loss before it."""
        self.optimiser.zero_grad()
        points = self.job.rays()
        sdf = self.sdf(points.reshape(-1, 3))
        p = self.job.eikonal_points().requires_grad_()
        (gradient,) = torch.autograd.grad(self.sdf(p).sum(), p, create_graph=True)
        loss = self.job.loss(sdf, points, gradient)
        loss.backward()
        self.optimiser.step()
        return loss.detach()


def softplus(z: Tensor) -> Tensor:
    """nerfstudio's activation of signed distance fields."""
    return F.softplus(z, beta=100)


VARIANTS: dict[str, Callable[[Size], Ours | Theirs]] = {
    "ours": Ours,
    "nerfstudio": lambda size: Theirs(size, softplus),
    "nerfstudio, our activation": lambda size: Theirs(size, lambda z: knee(z, 0.02)),
    "nerfstudio, ReLU": lambda size: Theirs(size, F.relu),
}
"""Softplus with beta 100 is nerfstudio's own choice for SDFs; ReLU is cheapest, but its gradient cannot be trained."""
