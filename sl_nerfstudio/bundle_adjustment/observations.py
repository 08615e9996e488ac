"""Which decoded pixels take part in the bundle adjustment, and in which other frames they are looked up."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps, seed_from
from sl_nerfstudio.bundle_adjustment.loops.visibility import choose_frames, count_chosen, mark_visible
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, array
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.devices import unproject
from sl_nerfstudio.geometry.se3 import rotate, transform
from sl_nerfstudio.geometry.triangulation import closest_approach

_ENTRIES_AT_ONCE = 2**23  # pairs of an anchor and a frame: bounds memory


def place_anchors(rig: Rig, maps: CoordinateMaps, per_frame: int, generator: torch.Generator) -> Anchors:
    """Random decoded pixels whose neighbourhood is smooth and whose rays meet in front of both devices."""
    drawn = maps.draw(torch.arange(rig.frames), per_frame, generator)
    frame, uv = drawn.frame, drawn.uv_camera
    seen = maps.look_up(frame, uv)
    p, good = _meet(rig, frame, uv, seen.uv_projector)
    edges = []
    for axis in range(2):
        beside, there = uv + torch.eye(2, dtype=uv.dtype)[axis], seen.uv_projector + seen.jacobian[..., axis]
        edges.append(_meet(rig, frame, beside, there)[0] - p)
    normal = torch.nn.functional.normalize(torch.linalg.cross(edges[0], edges[1]), dim=-1)
    normal = -normal * (normal * p).sum(-1, keepdim=True).sign()
    depth = p.norm(dim=-1)
    return Anchors(frame, p / depth[:, None], seen.uv_projector, depth, normal).chosen(seen.valid & good)


def _meet(
    rig: Rig, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"], uv_projector: Float[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Points on camera rays nearest to their projector rays, in camera axes; whether in front of both devices."""
    d_camera = unproject(rig.camera[frame], uv_camera)
    T = rig.T_camera_projector[frame]
    d_projector = rotate(T, unproject(rig.projector, uv_projector))
    depth, depth_projector = closest_approach(torch.zeros_like(d_camera), d_camera, T[:, :3, 3], d_projector)
    return depth[..., None] * d_camera, (depth > 0) & (depth_projector > 0)


def observe(
    rig: Rig,
    anchors: Anchors,
    maps: CoordinateMaps,
    per_anchor: int,
    gate_px: float,
    least_cosine: float,
    generator: torch.Generator,
    around: int | None = None,
) -> Observations:
    """For every anchor, up to `per_anchor` other frames that decoded something near it, within `gate_px` of it.

    Frames whose camera or projector is behind the anchor's surface, or sees it at a cosine below `least_cosine`, are
    left out: they see, or light, another side of the object. With `around`, only observations that involve one frame.
    Rows are ordered by anchor, then by frame.
    """
    allowed = ~torch.eye(rig.frames, dtype=torch.bool)
    if around is not None:
        involved = torch.arange(rig.frames) == around
        allowed &= involved[:, None] | involved
    seed = seed_from(generator)
    step = max(_ENTRIES_AT_ONCE // rig.frames, 1)
    parts = [
        _visible_rows(rig, anchors, maps, torch.arange(first, min(first + step, len(anchors.frame))), per_anchor,
                      (gate_px, least_cosine), allowed, seed)
        for first in range(0, len(anchors.frame), step)
    ]  # fmt: skip
    none = torch.zeros(0, dtype=torch.int64)
    return Observations(*(torch.cat([none, *part]) for part in ([p[k] for p in parts] for k in range(2))))


def _visible_rows(
    rig: Rig,
    anchors: Anchors,
    maps: CoordinateMaps,
    number: Int[Tensor, "n"],
    per_anchor: int,
    limits: tuple[float, float],
    allowed: Bool[Tensor, "frames frames"],
    seed: int,
) -> tuple[Int[Tensor, "rows"], Int[Tensor, "rows"]]:
    """The rows of some anchors: numbers of anchors and frames."""
    mine = anchors.chosen(number)
    T, n = rig.T_world_camera[mine.frame], len(number)
    p_world, normal = transform(T, mine.depth[:, None] * mine.d_camera), rotate(T, mine.normal)
    centres = torch.stack([rig.T_world_camera[:, :3, 3], rig.T_world_projector[:, :3, 3]])
    visible, counts = np.empty((rig.frames, n), dtype=np.bool_), np.empty(n, dtype=np.int64)
    mark_visible(
        rig.frames, rig.arrays, maps.arrays, array(mine.frame), array(p_world), array(normal), array(centres),
        array(allowed), limits, visible,
    )  # fmt: skip
    count_chosen(n, visible, per_anchor, counts)
    starts = np.concatenate([[0], np.cumsum(counts)])
    frames = np.empty(starts[-1], dtype=np.int64)
    choose_frames(n, visible, starts, seed, array(number), frames)
    return torch.repeat_interleave(number, torch.from_numpy(counts)), torch.from_numpy(frames)
