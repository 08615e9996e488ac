"""Where along a ray the field is evaluated."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def sphere_interval(
    origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], radius: float = 1.0
) -> tuple[Float[Tensor, "rays"], Float[Tensor, "rays"], Bool[Tensor, "rays"]]:
    """Distances at which unit rays enter and leave the scene's sphere, and whether they meet it in front.

    A ray that misses it, or grazes it on a chord shorter than the radius, gets an interval as long as the radius around
    its point closest to the centre (in front of the origin), so that everything stays finite.
    """
    b = (origins * directions).sum(-1)
    discriminant = b * b - (origins * origins).sum(-1) + radius * radius
    half = discriminant.clamp_min(0.25 * radius * radius).sqrt()
    near, far = (-b - half).clamp_min(0.0), (-b + half).clamp_min(1e-3)
    return near, far, (discriminant > 0) & (discriminant.clamp_min(0.0).sqrt() > b)


def uniform_samples(
    near: Float[Tensor, "rays"], far: Float[Tensor, "rays"], count: int, jitter: bool
) -> Float[Tensor, "rays count"]:
    """Distances in equal strata of [near, far]: their midpoints, or random positions in them."""
    steps = torch.arange(count, device=near.device, dtype=near.dtype)
    offset = torch.rand(len(near), count, device=near.device, dtype=near.dtype) if jitter else 0.5
    return near[:, None] + (far - near)[:, None] * (steps + offset) / count


def first_crossing(
    sdf: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]],
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    near: Float[Tensor, "rays"],
    far: Float[Tensor, "rays"],
    count: int,
) -> tuple[Float[Tensor, "rays"], Bool[Tensor, "rays"]]:
    """Distance at which a ray first passes from outside to inside, by linear interpolation, and whether it does."""
    t = uniform_samples(near, far, count, jitter=False)
    p = origins[:, None] + t[..., None] * directions[:, None]
    f = sdf(p.reshape(-1, 3)).reshape(t.shape)
    enters = (f[:, :-1] > 0) & (f[:, 1:] <= 0)
    found, index = enters.max(-1)
    a, b = f.gather(1, index[:, None])[:, 0], f.gather(1, index[:, None] + 1)[:, 0]
    share = torch.where(found, a / (a - b).clamp_min(1e-9), torch.zeros_like(a))
    step = (far - near) / count
    return t.gather(1, index[:, None])[:, 0] + share * step, found
