"""The model's outputs outside training: images for viewer, exporters and evaluation."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.geometry.se3 import inverse
from sl_nerfstudio.rendering.renderer import Ends, Renderer

_OPAQUE = 0.5
_MODULO = 128.0  # pattern pixels of one cycle of the coordinate colours
_RESIDUAL_WHITE_PX = 5.0
_NOTHING = {"depth": 1e3, "normals": 0.5}  # outputs of a ray that sees nothing; the others are 0


@torch.no_grad()
def ray_outputs(
    renderer: Renderer,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    T_scene_projector: Float[Tensor, "frames 4 4"],
    view: Int[Tensor, "rays"],
    ends: Ends | None = None,
) -> dict[str, Tensor]:
    """Float images of 1 or 3 channels: those that nerfstudio's viewer, renderer and exporters need, and our own.

    `view` is the frame whose projector lights each ray. `depth` is the distance along the unit ray, in scene units, and
    1000 where there is no object. Rays that pass the surface at a distance are not rendered: in most images they are
    most rays.
    """
    near = renderer.near_surface(origins, directions, ends)
    if near.all():
        return _rendered(renderer, origins, directions, T_scene_projector, view, ends)
    some_ends = None if ends is None else (ends[0][near], ends[1][near])
    some = _rendered(renderer, origins[near], directions[near], T_scene_projector, view[near], some_ends)
    return {name: _spread(values, near, _NOTHING.get(name, 0.0)) for name, values in some.items()}


def _spread(values: Float[Tensor, "some c"], where: Bool[Tensor, "rays"], elsewhere: float) -> Float[Tensor, "rays c"]:
    result = values.new_full((len(where), values.shape[1]), elsewhere)
    result[where] = values
    return result


def _rendered(
    renderer: Renderer,
    o: Float[Tensor, "rays 3"],
    d: Float[Tensor, "rays 3"],
    T_scene_projector: Float[Tensor, "frames 4 4"],
    view: Int[Tensor, "rays"],
    ends: Ends | None,
) -> dict[str, Tensor]:
    seen = renderer.render(o, d, inverse(T_scene_projector)[view], renderer.image_samples, jitter=False, ends=ends)
    p = o + seen.depth[:, None] * d
    normal = torch.nn.functional.normalize(renderer.field.sdf_and_gradient(p)[1].detach(), dim=-1)
    opaque = seen.accumulation > _OPAQUE
    lit = renderer.is_lit(p, normal, T_scene_projector[view, :3, 3]) & opaque
    facing = (-(normal * d).sum(-1)).clamp(0, 1)
    shade = (0.15 + 0.35 * facing + 0.5 * facing * torch.where(lit, seen.pattern, 0.0)) * opaque
    return {
        "rgb": shade[:, None].expand(-1, 3).contiguous(),
        "accumulation": seen.accumulation[:, None],
        "depth": torch.where(opaque, seen.depth, 1e3)[:, None],
        "normals": torch.where(opaque[:, None], 0.5 * normal + 0.5, 0.5),
        "pattern": torch.where(lit, seen.pattern, 0.0)[:, None],
        "coordinates": coordinate_colours(seen.coordinates, lit),
        "coordinate_x": torch.where(opaque, seen.coordinates[:, 0], 0.0)[:, None],
        "coordinate_y": torch.where(opaque, seen.coordinates[:, 1], 0.0)[:, None],
    }


def picture_outputs(outputs: dict[str, Tensor], measured: Float[Tensor, "rays 2"]) -> dict[str, Tensor]:
    """The outputs of an image's rays as pictures, with the residual to measured coordinates.

    Grey pictures have three equal channels: nerfstudio would give a single one false colours. The coordinates
    themselves, in pattern pixels, are no picture and are left out.
    """
    pictures = {name: values for name, values in outputs.items() if name not in ("coordinate_x", "coordinate_y")}
    grey = {"pattern": outputs["pattern"], "residual": residual_output(outputs, measured)}
    return pictures | {name: values.expand(-1, 3).contiguous() for name, values in grey.items()}


def residual_output(outputs: dict[str, Tensor], measured: Float[Tensor, "rays 2"]) -> Float[Tensor, "rays 1"]:
    """Distance between rendered and measured coordinates as brightness; 0 beside the object and where not decoded."""
    rendered = torch.cat([outputs["coordinate_x"], outputs["coordinate_y"]], -1)
    share = torch.nan_to_num((rendered - measured).norm(dim=-1) / _RESIDUAL_WHITE_PX, nan=0.0)
    opaque = outputs["accumulation"][:, 0] > _OPAQUE
    return torch.where(opaque, share, 0.0).clamp(0, 1)[:, None]


def coordinate_colours(uv: Float[Tensor, "n 2"], valid: Tensor) -> Float[Tensor, "n 3"]:
    """The usual colours of a coordinate image: x modulo 128 in red, y modulo 128 in green."""
    turn = uv.remainder(_MODULO) / _MODULO
    colour = torch.cat([turn, torch.full_like(turn[:, :1], 0.2)], -1)
    return torch.where(valid[:, None], colour, 0.0)


@torch.no_grad()
def fit_metrics(outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Median coordinate residual (pattern pixels) and cosine of rendered and captured pattern."""
    if "rendered" in outputs:
        coordinates, pattern = outputs["rendered"].coordinates, outputs["rendered"].pattern
    elif "coordinate_x" in outputs:
        coordinates = torch.cat([outputs["coordinate_x"], outputs["coordinate_y"]], -1)
        pattern = outputs["pattern"][:, 0]
    else:
        return {}
    n = len(pattern)
    error = (coordinates - batch["coords"][:n]).norm(dim=-1)
    return {
        "coordinate_px": _median(error, batch["decoded"][:n, 0]),
        "pattern_cosine": torch.nn.functional.cosine_similarity(pattern, batch["pattern"][:n, 0], dim=0),
    }


def _median(values: Float[Tensor, "n"], counts: Bool[Tensor, "n"]) -> Float[Tensor, ""]:
    """The lower median of the values that count, NaN if there is none; on a GPU the host need not know how many."""
    last = torch.where(counts, values, torch.inf).sort().values
    number = counts.sum()
    middle = last.gather(0, ((number - 1) // 2).clamp_min(0)[None])[0]
    return torch.where(number > 0, middle, torch.nan)


@torch.no_grad()
def image_metrics_and_images(
    outputs: dict[str, Tensor], batch: dict[str, Any]
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Captured and rendered image side by side, [H, 2 W, 3], and the images of the other outputs."""
    captured = batch["image"].to(outputs["rgb"].device)[..., :3]
    h, w = outputs["rgb"].shape[:2]
    captured = captured[:h, :w]
    images = {
        "img": torch.cat([captured, outputs["rgb"]], 1),
        "coordinates": outputs["coordinates"],
        "normals": outputs["normals"],
        "pattern": outputs["pattern"].expand(-1, -1, 3),
    }
    return {"accumulation_mean": float(outputs["accumulation"].mean())}, images
