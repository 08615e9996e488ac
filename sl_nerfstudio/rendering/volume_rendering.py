"""Volume rendering of a signed distance field as projector coordinates and pattern intensity.

    alpha_i = max((Phi(f_i) - Phi(f_{i+1})) / Phi(f_i), 0),  Phi(f) = 1 / (1 + exp(-kappa f))
    C = sum_i T_i alpha_i c(p_i),  P = sum_i T_i alpha_i pattern(c(p_i)),  T_i = prod_{j<i} (1 - alpha_j)

(NeuS, Wang et al. 2021, eq. 13; the paper, section 3.3.) `c` is taken at the middle of an interval.

What is lit: a point behind the projector has no pattern coordinate, so it has no weight, and the rest is
divided by the remaining weight. Outside the pattern the coordinate continues, and the intensity is 0. Occlusion
between projector and point is ignored here: training pixels are inside the mask, where the pattern was seen.
For images see `Renderer.is_lit`.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from sl_nerfstudio.geometry.devices import Intrinsics, project
from sl_nerfstudio.geometry.se3 import transform
from sl_nerfstudio.rendering.compiled_rendering import EPSILON, compiled_serves, render_rays


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
