"""Volume rendering of a signed distance field as projector coordinates and pattern intensity.

    alpha_i = max((Phi(f_i) - Phi(f_{i+1})) / Phi(f_i), 0),  Phi(f) = 1 / (1 + exp(-kappa f))
    C = sum_i T_i alpha_i c(p_i),  P = sum_i T_i alpha_i pattern(c(p_i)),  T_i = prod_{j<i} (1 - alpha_j)

(NeuS, Wang et al. 2021, eq. 13; the paper, section 3.3.) `c` is taken at the middle of an interval.

What is lit: a point behind the projector has no pattern coordinate, so it has no weight, and the rest is
divided by the remaining weight. Outside the pattern the coordinate continues, and the intensity is 0. Occlusion
between projector and point is ignored here: training pixels are inside the mask, where the pattern was seen.
For images see `Renderer.is_lit`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from sl_nerfstudio.geometry.devices import MODELS, Intrinsics, project, view_of
from sl_nerfstudio.geometry.lie import transform
from sl_nerfstudio.parallel import compiled, compiled_range

# Where along a ray the field is evaluated.


def sphere_interval(
    origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]
) -> tuple[Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    """Distances at which unit rays enter and leave the scene's unit sphere.

    A ray that misses it, or grazes it on a chord shorter than the radius, gets an interval as long as the radius around
    its point closest to the centre (in front of the origin), so that everything stays finite.
    """
    b = (origins * directions).sum(-1)
    half = (b * b - (origins * origins).sum(-1) + 1).clamp_min(0.25).sqrt()
    return (-b - half).clamp_min(0.0), (-b + half).clamp_min(1e-3)


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


# Rendering without gradients on the CPU: the formulas of `render` and of the cached grid, compiled.
#
# An image has a hundred times the samples of a training step. As torch operations, each of which writes an array as
# large as all samples, they take ten times as long.

EPSILON = 1e-6  # beside the weights that a ray's values are divided by


def compiled_serves(*tensors: Tensor) -> bool:
    """Whether tensors are on the CPU, and nobody asks for gradients."""
    return not torch.is_grad_enabled() and all(tensor.device.type == "cpu" for tensor in tensors)


def render_rays(
    sdf: Float[Tensor, "rays samples"],
    t: Float[Tensor, "rays samples"],
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    T_projector_scene: Float[Tensor, "rays 4 4"],
    projector: Intrinsics,
    pattern: Float[Tensor, "h w"],
    kappa: Float[Tensor, ""] | float,
) -> Float[Tensor, "rays 6"]:
    """Accumulation, depth, both coordinates, pattern and lit share, as `render` defines them."""
    found = sdf.new_zeros(len(sdf), 6)
    arrays = [tensor.detach().contiguous().numpy() for tensor in (sdf, t, origins, directions, T_projector_scene)]
    device = MODELS[projector.model].code, projector.params.detach().double().numpy()
    _render(len(sdf), *arrays, *device, pattern.contiguous().numpy(), float(kappa), found.numpy())
    return found


def comes_below(
    grid: Float[Tensor, "n n n"],
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    near: Float[Tensor, "rays"],
    far: Float[Tensor, "rays"],
    count: int,
    limit: Float[Tensor, "rays"],
) -> Bool[Tensor, "rays"]:
    """Whether a cached grid's value is at most the limit in the middle of any of `count` equal parts of each ray."""
    found = torch.zeros(len(near), dtype=torch.bool)
    arrays = [tensor.detach().contiguous().numpy() for tensor in (grid, origins, directions, near, far, limit)]
    _come_below(len(near), *arrays, count, found.numpy())
    return found


def first_crossings(
    grid: Float[Tensor, "n n n"],
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    near: Float[Tensor, "rays"],
    far: Float[Tensor, "rays"],
    count: int,
) -> tuple[Float[Tensor, "rays"], Bool[Tensor, "rays"]]:
    """As `first_crossing`, for a cached grid: the distances, and whether there is one."""
    t, found = torch.empty_like(near), torch.zeros(len(near), dtype=torch.bool)
    arrays = [tensor.detach().contiguous().numpy() for tensor in (grid, origins, directions, near, far)]
    _cross(len(near), *arrays, count, t.numpy(), found.numpy())
    return t, found


@compiled
def _log_sigmoid(x):
    return -math.log1p(math.exp(-x)) if x > 0 else x - math.log1p(math.exp(x))


@compiled
def _bilinear(pattern, u, v):
    """Intensity at a coordinate; pixels beyond the pattern are 0."""
    h, w = pattern.shape
    if not (-0.5 < u < w + 0.5 and -0.5 < v < h + 0.5):
        return 0.0
    column, row = math.floor(u - 0.5), math.floor(v - 0.5)
    x, y, total = u - 0.5 - column, v - 0.5 - row, 0.0
    for dy in range(2):
        for dx in range(2):
            if 0 <= row + dy < h and 0 <= column + dx < w:
                total += (x if dx else 1 - x) * (y if dy else 1 - y) * pattern[row + dy, column + dx]
    return total


@compiled_range
def _render(first, last, sdf, t, origins, directions, T, code, parameters, pattern, kappa, found):
    for k in range(first, last):
        passed, before = 0.0, _log_sigmoid(kappa * sdf[k, 0])
        accumulation, depth, lit, u_sum, v_sum, intensity = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(t.shape[1] - 1):
            after = _log_sigmoid(kappa * sdf[k, i + 1])
            transparency = min(after - before, 0.0)
            weight = -math.expm1(transparency) * math.exp(passed)
            passed, before = passed + transparency, after
            if weight == 0.0:
                continue
            middle = 0.5 * (t[k, i] + t[k, i + 1])
            accumulation += weight
            depth += weight * middle
            x = origins[k, 0] + middle * directions[k, 0]
            y = origins[k, 1] + middle * directions[k, 1]
            z = origins[k, 2] + middle * directions[k, 2]
            view = view_of(
                code,
                T[k, 0, 0] * x + T[k, 0, 1] * y + T[k, 0, 2] * z + T[k, 0, 3],
                T[k, 1, 0] * x + T[k, 1, 1] * y + T[k, 1, 2] * z + T[k, 1, 3],
                T[k, 2, 0] * x + T[k, 2, 1] * y + T[k, 2, 2] * z + T[k, 2, 3],
                parameters,
            )
            if view[2]:
                lit += weight
                u_sum += weight * view[0]
                v_sum += weight * view[1]
                intensity += weight * _bilinear(pattern, view[0], view[1])
        found[k, 0] = accumulation
        found[k, 1] = depth / (accumulation + EPSILON)
        found[k, 2], found[k, 3] = u_sum / (lit + EPSILON), v_sum / (lit + EPSILON)
        found[k, 4] = intensity
        found[k, 5] = lit / (accumulation + EPSILON)


@compiled
def _cell(x, n):
    """Of n vertices over [-1, 1], the one before x, and how far x is behind it."""
    a = min(max((x + 1) * (0.5 * (n - 1)), 0.0), n - 1.0)
    i = min(int(a), n - 2)
    return i, a - i


@compiled
def _trilinear(grid, x, y, z):
    """The value at a point of the box [-1, 1]^3; outside, that at its border."""
    (i, a), (j, b), (k, c) = _cell(x, len(grid)), _cell(y, len(grid)), _cell(z, len(grid))
    near = (1 - b) * ((1 - a) * grid[k, j, i] + a * grid[k, j, i + 1]) + b * (
        (1 - a) * grid[k, j + 1, i] + a * grid[k, j + 1, i + 1]
    )
    far = (1 - b) * ((1 - a) * grid[k + 1, j, i] + a * grid[k + 1, j, i + 1]) + b * (
        (1 - a) * grid[k + 1, j + 1, i] + a * grid[k + 1, j + 1, i + 1]
    )
    return (1 - c) * near + c * far


@compiled
def _value_at(grid, origin, direction, t):
    return _trilinear(grid, origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])


@compiled_range
def _come_below(first, last, grid, origins, directions, near, far, limit, count, found):
    for k in range(first, last):
        step = (far[k] - near[k]) / count
        for i in range(count):
            if _value_at(grid, origins[k], directions[k], near[k] + step * (i + 0.5)) <= limit[k]:
                found[k] = True
                break


@compiled_range
def _cross(first, last, grid, origins, directions, near, far, count, t, found):
    for k in range(first, last):
        step = (far[k] - near[k]) / count
        t[k] = near[k] + 0.5 * step  # where the surface is not met
        before = _value_at(grid, origins[k], directions[k], t[k])
        for i in range(1, count):
            after = _value_at(grid, origins[k], directions[k], near[k] + step * (i + 0.5))
            if before > 0 and after <= 0:
                t[k] = near[k] + step * (i - 0.5 + before / (before - after))
                found[k] = True
                break
            before = after


@dataclass(frozen=True)
class Rendered:
    """What a ray sees."""

    accumulation: Float[Tensor, "rays"]
    depth: Float[Tensor, "rays"]  # distance along the unit ray, scene units
    coordinates: Float[Tensor, "rays 2"]  # pattern pixels
    pattern: Float[Tensor, "rays"]  # [0, 1]
    lit: Float[Tensor, "rays"]  # share of the weight that has a pattern coordinate


def interval_weights(
    sdf: Float[Tensor, "rays samples"], kappa: Float[Tensor, ""] | float
) -> Float[Tensor, "rays intervals"]:
    """`T_i alpha_i` of the intervals between neighbouring samples."""
    # (Phi(a) - Phi(b)) / Phi(a) = 1 - (1 + exp(-kappa a)) / (1 + exp(-kappa b)), in logarithms against overflow
    log_phi = F.logsigmoid(kappa * sdf)
    log_transparency = (log_phi[:, 1:] - log_phi[:, :-1]).clamp_max(0.0)
    alpha = -torch.expm1(log_transparency)
    before = F.pad(torch.cumsum(log_transparency[:, :-1], -1), (1, 0))  # never above 0, with any rounding
    return alpha * before.exp()


def render(
    sdf: Float[Tensor, "rays samples"],
    t: Float[Tensor, "rays samples"],
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    T_projector_scene: Float[Tensor, "rays 4 4"],
    projector: Intrinsics,
    pattern: Float[Tensor, "h w"],
    kappa: Float[Tensor, ""] | float,
) -> Rendered:
    """Render rays whose SDF is known at distances `t` (ascending)."""
    if compiled_serves(sdf, pattern):
        found = render_rays(sdf, t, origins, directions, T_projector_scene, projector, pattern, kappa)
        return Rendered(found[:, 0], found[:, 1], found[:, 2:4], found[:, 4], found[:, 5])
    weights = interval_weights(sdf, kappa)
    middle = 0.5 * (t[:, 1:] + t[:, :-1])
    accumulation = weights.sum(-1)
    p_scene = origins[:, None] + middle[..., None] * directions[:, None]
    uv, in_front = project(projector, transform(T_projector_scene[:, None], p_scene))
    lit_weights = weights * in_front
    lit = lit_weights.sum(-1)
    share = lit_weights / (lit[:, None] + EPSILON)
    return Rendered(
        accumulation=accumulation,
        depth=(weights * middle).sum(-1) / (accumulation + EPSILON),
        coordinates=(share[..., None] * uv).sum(1),
        pattern=(lit_weights * look_up(pattern, uv)).sum(-1),
        lit=lit / (accumulation + EPSILON),
    )


def look_up(pattern: Float[Tensor, "h w"], uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """Bilinear intensity at continuous pattern coordinates (first pixel's centre at 0.5); 0 outside."""
    h, w = pattern.shape
    grid = torch.stack([uv[..., 0] * (2 / w) - 1, uv[..., 1] * (2 / h) - 1], -1)
    found = F.grid_sample(
        pattern[None, None], grid.reshape(1, 1, -1, 2), mode="bilinear", padding_mode="zeros", align_corners=False
    )
    return found.reshape(uv.shape[:-1])
