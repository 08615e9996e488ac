"""Rays through a field: where they are sampled, what they see, and which surface points the projector lights."""

from dataclasses import dataclass
from math import ceil
from typing import Literal

import torch
import tyro
from jaxtyping import Bool, Float
from torch import Tensor

from sl_nerfstudio.field.field import CachedGrid
from sl_nerfstudio.field.hash_grid import SignedDistance
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.rendering.volume_rendering import (
    Rendered,
    comes_below,
    compiled_serves,
    first_crossing,
    first_crossings,
    render,
    sphere_interval,
    uniform_samples,
)

HALF_WIDTH = 4.0  # half the interval sampled around the surface, times 1 / kappa; plus one cell of the cached grid
CACHE_SAMPLES = 64  # along a ray, to find the surface
_SHADOW_SAMPLES = 32
_NEAR_SAMPLES = 32  # along a ray, to find out whether it passes the surface
_FEWEST_SAMPLES = 6
_ALONG_RAYS = 24  # samples of images, where they do not follow the surface
_AROUND_SURFACE = 12  # likewise, where they do: the fewest

Ends = tuple[Float[Tensor, "rays"], Float[Tensor, "rays"]]
"""Distances at which rays begin and end, for textures and cropped views."""


@dataclass
class SamplingConfig:
    """Where the field is evaluated in a training step."""

    render_rays: int = 256
    """Rays of a batch that are volume rendered; the direct terms use all of the batch's decoded rays."""
    eikonal_points: int = 1024
    """Random points of the scene at which the Eikonal term is evaluated, besides the surface points."""
    strategy: tyro.conf.Suppress[Literal["surface", "uniform"]] = "surface"
    """`surface`: around the crossing found in a cached coarse grid; `uniform`: along the whole ray (the paper's)."""
    samples: tyro.conf.Suppress[int] = 16
    """Samples per ray for volume rendering."""


@dataclass(frozen=True)
class Renderer:
    """A field lit by one projector. Its cached grid must be up to date if samples follow the surface."""

    field: SignedDistance
    cache: CachedGrid
    projector: Intrinsics  # batch ()
    pattern: Float[Tensor, "h w"]
    sampling: SamplingConfig
    kappa: Float[Tensor, ""] | float  # sharpness, per scene unit

    @property
    def image_samples(self) -> int:
        """Samples per ray of images, which have no jitter.

        Around the surface they are at most 2 / kappa apart: the weights are differences of a logistic curve at equal
        distances, and already with these the depth of a plane is within 0.02 / kappa of its limit.
        """
        if self.sampling.strategy == "uniform":
            return max(self.sampling.samples, _ALONG_RAYS)
        return max(_AROUND_SURFACE, ceil(self._reach * self.kappa))

    def render(
        self,
        origins: Float[Tensor, "rays 3"],
        directions: Float[Tensor, "rays 3"],
        T_projector_scene: Float[Tensor, "rays 4 4"],
        samples: int,
        jitter: bool,
        ends: Ends | None = None,
    ) -> Rendered:
        """Volume render rays as projector coordinates and pattern, with `samples` samples per ray.

        Rays with `ends` are sampled only between them; short ones with fewer samples, which are as dense.
        """
        if ends is not None:
            samples = min(samples, max(_FEWEST_SAMPLES, ceil(samples * _longest(ends) / (2 * self._reach))))
        t = self._distances(origins, directions, samples, jitter, ends)
        p = origins[:, None] + t[..., None] * directions[:, None]
        sdf = self.field.sdf(p.reshape(-1, 3)).reshape(t.shape)
        return render(sdf, t, origins, directions, T_projector_scene, self.projector, self.pattern, self.kappa)

    @torch.no_grad()
    def near_surface(
        self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], ends: Ends | None = None
    ) -> Bool[Tensor, "rays"]:
        """Whether rays come so close to the surface, by the cached grid, that they see anything."""
        near, far = _interval(origins, directions, ends)
        count = _NEAR_SAMPLES if ends is None else min(_NEAR_SAMPLES, max(2, ceil(_longest(ends) / self.cache.cell)))
        between = 0.5 * (far - near) / count  # the surface may be this much closer than at the samples
        return self._comes_below(origins, directions, near, far, count, self._reach + between) & (far > near)

    @property
    def _reach(self) -> Float[Tensor, ""] | float:
        """How far from the surface a sample still counts, with the error of the cached grid."""
        return HALF_WIDTH / self.kappa + self.cache.cell

    @torch.no_grad()
    def _distances(
        self,
        origins: Float[Tensor, "rays 3"],
        directions: Float[Tensor, "rays 3"],
        samples: int,
        jitter: bool,
        ends: Ends | None,
    ) -> Float[Tensor, "rays samples"]:
        near, far = _interval(origins, directions, ends)
        if self.sampling.strategy == "uniform" or (ends is not None and _longest(ends) <= 2 * self._reach):
            return uniform_samples(near, far, samples, jitter)
        if compiled_serves(origins):
            t, found = first_crossings(self.cache.values, origins, directions, near, far, CACHE_SAMPLES)
        else:
            t, found = first_crossing(self.cache.look_up, origins, directions, near, far, CACHE_SAMPLES)
        low, high = torch.where(found, t - self._reach, near), torch.where(found, t + self._reach, far)
        if ends is not None:
            low, high = torch.maximum(low, near), torch.minimum(high, far)
        return uniform_samples(low, high, samples, jitter)

    @torch.no_grad()
    def is_lit(
        self, p: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"], projector_centre: Float[Tensor, "n 3"]
    ) -> Bool[Tensor, "n"]:
        """Whether surface points are lit by the projector: nothing is in between, and the surface faces it."""
        to_projector = torch.nn.functional.normalize(projector_centre - p, dim=-1)
        start = p + 2 * self.cache.cell * normal
        _, far = sphere_interval(start, to_projector)
        zero = torch.zeros_like(far)
        shaded = self._comes_below(start, to_projector, zero, far, _SHADOW_SAMPLES, zero)
        return ~shaded & ((normal * to_projector).sum(-1) > 0)

    def _comes_below(
        self,
        origins: Float[Tensor, "rays 3"],
        directions: Float[Tensor, "rays 3"],
        near: Float[Tensor, "rays"],
        far: Float[Tensor, "rays"],
        count: int,
        limit: Float[Tensor, "rays"],
    ) -> Bool[Tensor, "rays"]:
        """Whether one of the cached grid's values between the ends of rays is at most the limit."""
        if compiled_serves(origins):
            return comes_below(self.cache.values, origins, directions, near, far, count, limit)
        t = uniform_samples(near, far, count, jitter=False)
        f = self.cache.look_up((origins[:, None] + t[..., None] * directions[:, None]).reshape(-1, 3))
        return f.reshape(t.shape).amin(-1) <= limit


def _interval(
    origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], ends: Ends | None
) -> tuple[Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    near, far = sphere_interval(origins, directions)
    return (near, far) if ends is None else (torch.maximum(near, ends[0]), torch.minimum(far, ends[1]))


def _longest(ends: Ends) -> float:
    return float((ends[1] - ends[0]).amax()) if len(ends[0]) else 0.0
