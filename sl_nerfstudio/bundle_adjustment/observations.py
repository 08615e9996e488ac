"""Which decoded pixels take part in the bundle adjustment, and in which other frames they are looked up."""

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps, seed_from
from sl_nerfstudio.bundle_adjustment.loops.groups import Groups
from sl_nerfstudio.bundle_adjustment.loops.visibility import choose_frames, count_chosen, mark_visible
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, array
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.devices import unproject
from sl_nerfstudio.geometry.se3 import rotate, transform
from sl_nerfstudio.geometry.triangulation import closest_approach

_ENTRIES_AT_ONCE = 2**28  # pairs of an anchor and a frame: bounds memory, to a byte each
_TRIED_ANCHORS = 24  # of each frame, that show which frames see the same surface
_LEAST_SHARED = 2  # of those, both ways, for two frames to be partners


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
    allowed: Bool[Tensor, "frames frames"] | None = None,
) -> Observations:
    """For every anchor, up to `per_anchor` other frames that decoded something near it, within `gate_px` of it.

    Frames whose camera or projector is behind the anchor's surface, or sees it at a cosine below `least_cosine`, are
    left out: they see, or light, another side of the object. `allowed[i, j]` says whether frame j may look up anchors
    of frame i; without it, every other frame may. Rows are ordered by anchor, then by frame.
    """
    allowed = every_other(rig.frames) if allowed is None else allowed
    seed, limits = seed_from(generator), (gate_px, least_cosine)
    parts = [
        _visible_rows(rig, anchors, maps, some, per_anchor, limits, allowed, seed)
        for some in _portions(len(anchors.frame), rig.frames)
    ]
    none = torch.zeros(0, dtype=torch.int64)
    return Observations(*(torch.cat([none, *part]) for part in ([p[k] for p in parts] for k in range(2))))


def away_from_borders(
    anchors: Anchors,
    rows: Observations,
    distances: tuple[Float[Tensor, "anchors"], Float[Tensor, "rows"]],
    least: float,
    frames: int,
) -> tuple[Anchors, Observations]:
    """Only anchors, and rows, that are at least so many pixels from the border of what was decoded.

    `distances` are those of anchors in their own frame and of rows in the frame that looks up. Of frames of thin
    things, which are all border, the better half remains.
    """
    own, seen = distances
    limit = torch.full((frames,), least, dtype=own.dtype)
    for frame in range(frames):
        mine = own[anchors.frame == frame]
        if len(mine):
            limit[frame] = min(least, float(mine.median()))
    kept = own >= limit[anchors.frame]
    number = torch.cumsum(kept, 0) - 1
    chosen = kept[rows.anchor] & (seen >= limit[rows.frame])
    return anchors.chosen(kept), Observations(number[rows.anchor[chosen]], rows.frame[chosen])


def every_other(frames: int) -> Bool[Tensor, "frames frames"]:
    """Every frame may look up anchors of every other."""
    return ~torch.eye(frames, dtype=torch.bool)


def involving(frame: int, frames: int) -> Bool[Tensor, "frames frames"]:
    """Only pairs of one frame and another."""
    involved = torch.arange(frames) == frame
    return every_other(frames) & (involved[:, None] | involved)


def partners(
    rig: Rig, anchors: Anchors, maps: CoordinateMaps, most: int, least_cosine: float, generator: torch.Generator
) -> Bool[Tensor, "frames frames"]:
    """For each frame about `most` others, at random from those that see the same surface; every other if there are few.

    Random partners hold the frames together better than neighbours do: no chain of frames is long.
    """
    n = rig.frames
    if n - 1 <= most:
        return every_other(n)
    groups = Groups.of(array(anchors.frame), n)
    tried = [groups.entries[first:last][:_TRIED_ANCHORS] for first, last in pairwise(groups.first)]
    some = anchors.chosen(torch.from_numpy(np.concatenate(tried)))
    shared = np.zeros((n, n))
    for part in _portions(len(some.frame), n):
        mine = some.chosen(part)
        visible = _visible(rig, mine, maps, (float("inf"), least_cosine), every_other(n))
        frame = array(mine.frame)  # ascends
        starts = np.flatnonzero(np.diff(frame, prepend=-1))
        shared[frame[starts]] += np.add.reduceat(visible, starts, axis=1, dtype=np.float64).T
    overlap = torch.from_numpy(shared + shared.T >= _LEAST_SHARED)
    rank = torch.where(overlap, torch.rand(n, n, generator=generator), torch.inf)
    half = (most + 1) // 2
    chosen = overlap & (rank <= rank.sort(1).values[:, half - 1 : half])
    return chosen | chosen.T


def _portions(anchors: int, frames: int) -> list[Int[Tensor, "_"]]:
    """Numbers of all anchors, as many at once as memory allows."""
    return list(torch.arange(anchors).split(max(_ENTRIES_AT_ONCE // frames, 1))) if anchors else []


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
    n, counts = len(number), np.empty(len(number), dtype=np.int64)
    visible = _visible(rig, anchors.chosen(number), maps, limits, allowed)
    count_chosen(n, visible, per_anchor, counts)
    starts = np.concatenate([[0], np.cumsum(counts)])
    frames = np.empty(starts[-1], dtype=np.int64)
    choose_frames(n, visible, starts, seed, array(number), frames)
    return torch.repeat_interleave(number, torch.from_numpy(counts)), torch.from_numpy(frames)


def _visible(
    rig: Rig,
    anchors: Anchors,
    maps: CoordinateMaps,
    limits: tuple[float, float],
    allowed: Bool[Tensor, "frames frames"],
) -> Bool[ndarray, "frames anchors"]:
    """Which frames decoded something near which anchors."""
    T, n = rig.T_world_camera[anchors.frame], len(anchors.frame)
    p_world, normal = transform(T, anchors.depth[:, None] * anchors.d_camera), rotate(T, anchors.normal)
    centres = torch.stack([rig.T_world_camera[:, :3, 3], rig.T_world_projector[:, :3, 3]])
    visible = np.empty((rig.frames, n), dtype=np.bool_)
    mark_visible(
        rig.frames, rig.arrays, maps.arrays, array(anchors.frame), array(p_world), array(normal), array(centres),
        array(allowed), limits, visible,
    )  # fmt: skip
    return visible
