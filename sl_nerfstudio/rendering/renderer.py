"""Rays through a field: where they are sampled, what they see, and which surface points the projector lights."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sl_nerfstudio.field.cached_grid import CachedGrid
from sl_nerfstudio.field.signed_distance import SignedDistance
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.rendering.ray_samples import first_crossing, sphere_interval, uniform_samples
from sl_nerfstudio.rendering.settings import SamplingConfig
from sl_nerfstudio.rendering.volume_rendering import Rendered, render

_SHADOW_SAMPLES = 32
_NEAR_SAMPLES = 32  # along a ray, to find out whether it passes the surface


@dataclass(frozen=True)
class Renderer:
    """A field lit by one projector. Its cached grid must be up to date if samples follow the surface."""

    field: SignedDistance
    cache: CachedGrid
    projector: Intrinsics  # batch ()
    pattern: Float[Tensor, "h w"]
    sampling: SamplingConfig
    kappa: float  # sharpness, per scene unit

    def render(
        self,
        origins: Float[Tensor, "rays 3"],
        directions: Float[Tensor, "rays 3"],
        T_projector_scene: Float[Tensor, "rays 4 4"],
        samples: int,
        jitter: bool,
    ) -> Rendered:
        """Volume render rays as projector coordinates and pattern, with `samples` samples per ray."""
        t = self._distances(origins, directions, samples, jitter)
        p = origins[:, None] + t[..., None] * directions[:, None]
        sdf = self.field.sdf(p.reshape(-1, 3)).reshape(t.shape)
        return render(sdf, t, origins, directions, T_projector_scene, self.projector, self.pattern, self.kappa)

    @torch.no_grad()
    def near_surface(
        self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]
    ) -> Bool[Tensor, "rays"]:
        """Whether rays come so close to the surface, by the cached grid, that they see anything."""
        near, far, _ = sphere_interval(origins, directions)
        t = uniform_samples(near, far, _NEAR_SAMPLES, jitter=False)
        f = self.cache.look_up((origins[:, None] + t[..., None] * directions[:, None]).reshape(-1, 3))
        between = 0.5 * (far - near) / _NEAR_SAMPLES  # the surface may be this much closer than at the samples
        return f.reshape(t.shape).amin(-1) < self._reach + between

    @property
    def _reach(self) -> float:
        """How far from the surface a sample still counts, with the error of the cached grid."""
        return self.sampling.half_width / self.kappa + self.cache.cell

    @torch.no_grad()
    def _distances(
        self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], samples: int, jitter: bool
    ) -> Float[Tensor, "rays samples"]:
        near, far, _ = sphere_interval(origins, directions)
        if self.sampling.strategy == "uniform":
            return uniform_samples(near, far, samples, jitter)
        t, found = first_crossing(self.cache.look_up, origins, directions, near, far)
        low, high = torch.where(found, t - self._reach, near), torch.where(found, t + self._reach, far)
        return uniform_samples(low, high, samples, jitter)

    @torch.no_grad()
    def is_lit(
        self, p: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"], projector_centre: Float[Tensor, "n 3"]
    ) -> Bool[Tensor, "n"]:
        """Whether surface points are lit by the projector: nothing is in between, and the surface faces it."""
        to_projector = torch.nn.functional.normalize(projector_centre - p, dim=-1)
        start = p + 2 * self.cache.cell * normal
        _, far, _ = sphere_interval(start, to_projector)
        t = uniform_samples(torch.zeros_like(far), far, _SHADOW_SAMPLES, jitter=False)
        between = self.cache.look_up((start[:, None] + t[..., None] * to_projector[:, None]).reshape(-1, 3))
        return (between.reshape(t.shape).amin(-1) > 0) & ((normal * to_projector).sum(-1) > 0)
