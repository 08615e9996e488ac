"""Whether a plane is what the object stands on or stands before, or a part of the object itself."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.object_separation.frame_points import DecodedFrame, FramePoints
from sl_nerfstudio.object_separation.plane import Plane
from sl_nerfstudio.object_separation.plane_search import PointPool
from sl_nerfstudio.object_separation.settings import SeparationSettings
from sl_nerfstudio.object_separation.viewed_region import ViewedRegion

Verdict = Literal[
    "leaves the views", "object stands on it", "cameras on both sides", "surface behind it", "nothing on it",
    "edges seen",
]  # fmt: skip
"""Why a plane is surroundings (the first two), or why it may be a part of the object and is kept."""

_CELLS = 20  # of the grid in the plane, along the radius of the viewed region
_POINTS_IN_CELL = 3
_BEYOND_EDGE = (
    1.04,
    1.1,
    1.2,
    1.35,
)  # where past the edge to look, as distances from the middle in distances of the edge
_AROUND = 0.75  # share of the directions in which a support extends beyond what stands on it


@dataclass(frozen=True, eq=False)
class PlaneFinding:
    """A plane, facing the cameras, and what is known about it; shares are between 0 and 1."""

    plane: Plane
    share: float  # of all points that lie on it
    cameras_in_front: float  # of the cameras
    behind: float  # of the points in the viewed region
    above: float  # the same, in front of it
    continues: float  # of the directions, those in which no frame looks past its edge
    area_ratio: float  # its bare area, in areas of what stands on it
    height_ratio: float  # height of what stands on it, in roots of its area
    around: float  # share of the directions in which it extends beyond what stands on it
    verdict: Verdict

    @property
    def is_surroundings(self) -> bool:
        """Whether the plane is not part of the object."""
        return self.verdict in ("leaves the views", "object stands on it")


def judge_plane(
    plane: Plane,
    share: float,
    pool: PointPool,
    frames: Sequence[DecodedFrame],
    points: Sequence[FramePoints],
    region: ViewedRegion,
    settings: SeparationSettings,
) -> PlaneFinding:
    """Judge one plane. `pool` has points of all frames, `points` are those of each frame.

    Surroundings have all cameras in front of them and nothing of the object behind them, carry something, and either
    extend beyond the views (no frame looks past their edge), or are far larger than what rises from them.
    """
    centres = np.stack([frame.T_world_camera[:3, 3] for frame in frames])
    if (plane.heights(centres) > 0).mean() < 0.5:
        plane = plane.flipped()
    in_front = float((plane.heights(centres) > 0).mean())
    p = pool.points.p_world
    height, clear = plane.heights(p), settings.clear_sigmas * pool.points.sigma_along(plane.normal)
    inside = region.contains(p)
    behind, above = (float((side & inside).sum() / max(inside.sum(), 1)) for side in (height < -clear, height > clear))
    on = pool.on(plane, settings)
    continues = _continues(plane, p[on], frames, points, settings)
    area, tall, around = _what_stands_on_it(plane, p[on], p[inside & (height > clear)], region)
    return PlaneFinding(
        plane, share, in_front, behind, above, continues, area, tall, around,
        _verdict(in_front, behind, above, continues, (area, tall, around), settings),
    )  # fmt: skip


def _verdict(
    in_front: float,
    behind: float,
    above: float,
    continues: float,
    support: tuple[float, float, float],
    settings: SeparationSettings,
) -> Verdict:
    area, tall, around = support
    if in_front < settings.cameras_in_front:
        return "cameras on both sides"
    if behind > settings.most_behind:
        return "surface behind it"
    if above < settings.least_above:
        return "nothing on it"
    if continues >= settings.continues:
        return "leaves the views"
    if area >= settings.support_area and tall >= settings.support_height and around >= _AROUND:
        return "object stands on it"
    return "edges seen"


def _continues(
    plane: Plane,
    on: Float[ndarray, "n 3"],
    frames: Sequence[DecodedFrame],
    points: Sequence[FramePoints],
    settings: SeparationSettings,
) -> float:
    """Share of the directions in the plane in which no more than a few frames look past its edge."""
    if not len(on):
        return 0.0
    centre = np.median(on, axis=0)
    flat = (on - centre) @ plane.axes().T
    distance = np.linalg.norm(flat, axis=1)
    sector = _sectors(flat, settings.directions)
    probes = []
    for k in range(settings.directions):
        if (sector == k).sum() < _POINTS_IN_CELL:
            continue
        reach = np.percentile(distance[sector == k], 98) * np.array(_BEYOND_EDGE)
        angle = 2 * np.pi * (k + 0.5) / settings.directions - np.pi
        outward = np.array([np.cos(angle), np.sin(angle)]) @ plane.axes()
        probes.append(centre + reach[:, None] * outward)
    if not probes:
        return 0.0
    places = np.concatenate(probes)
    past = sum(
        _looks_past(plane, places, frame, own, settings).astype(int) for frame, own in zip(frames, points, strict=True)
    )
    # A rim may stand on the edge, so that only places farther out show that nothing follows.
    most = np.reshape(past, (len(probes), -1)).max(1)
    return float((most <= settings.edge_frames * len(frames)).mean())


def _looks_past(
    plane: Plane,
    probes: Float[ndarray, "m 3"],
    frame: DecodedFrame,
    points: FramePoints,
    settings: SeparationSettings,
) -> Bool[ndarray, "m"]:
    """Places where a frame looks past the plane: well inside its view, it saw something behind it or nothing at all."""
    uv, inside = _well_inside(frame.camera, frame.T_world_camera, probes, settings.view_margin)
    _, lit = _well_inside(frame.projector, frame.T_world_projector, probes, settings.view_margin)
    looked = inside & lit
    nothing, beyond = ~frame.seen, np.zeros_like(frame.seen)
    below = plane.heights(points.p_world) < -settings.clear_sigmas * points.sigma_along(plane.normal)
    beyond[points.row[below], points.column[below]] = True
    past = np.zeros(len(probes), dtype=bool)
    for k in np.flatnonzero(looked):
        column, row = (uv[k] / frame.stride).astype(int)
        window = slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2)
        past[k] = (nothing[window] | beyond[window]).all()
    return past


def _well_inside(
    device: Device, T_world_device: Float[ndarray, "4 4"], p_world: Float[ndarray, "m 3"], margin: float
) -> tuple[Float[ndarray, "m 2"], Bool[ndarray, "m"]]:
    """Pixels of points, and whether they are in the image without a strip along its borders."""
    p_device = (p_world - T_world_device[:3, 3]) @ T_world_device[:3, :3]
    found, in_front = project(Intrinsics.of(device, torch.float64), torch.from_numpy(np.ascontiguousarray(p_device)))
    uv = found.numpy()
    share = uv / (device.w, device.h)
    return uv, in_front.numpy() & (share > margin).all(1) & (share < 1 - margin).all(1)


def _what_stands_on_it(
    plane: Plane, on: Float[ndarray, "n 3"], above: Float[ndarray, "m 3"], region: ViewedRegion
) -> tuple[float, float, float]:
    """How much more than what rises from it a plane is.

    Returns its bare area in areas of what rises, the height of that in roots of its area, and the share of the
    directions in which the plane extends beyond it.
    """
    size = region.radius / _CELLS
    axes = plane.axes()

    def cells(p: Float[ndarray, "k 3"]) -> Int64[ndarray, "c 2"]:
        cell, count = np.unique(
            np.floor((p - region.focus) @ axes.T / size).astype(np.int64), axis=0, return_counts=True
        )
        return cell[count >= _POINTS_IN_CELL]

    standing, bare = cells(above), cells(on)
    if not len(standing) or not len(bare):
        return 0.0, 0.0, 0.0
    bare = bare[~(bare[:, None] == standing[None]).all(-1).any(1)]
    tall = float(np.percentile(plane.heights(above), 95)) / (size * np.sqrt(len(standing)))
    middle = standing.mean(0)
    beyond = []
    own, others = (_sectors(c - middle, 12) for c in (standing, bare))
    for k in range(12):
        edge = np.linalg.norm(standing[own == k] - middle, axis=1).max(initial=0.0)
        beyond.append(np.linalg.norm(bare[others == k] - middle, axis=1).max(initial=0.0) > edge + 1)
    return len(bare) / len(standing), tall, float(np.mean(beyond))


def _sectors(flat: Float[ndarray, "n 2"], count: int) -> Int64[ndarray, "n"]:
    """Number of the angular sector of each place."""
    turn = (np.arctan2(flat[:, 1], flat[:, 0]) + np.pi) / (2 * np.pi)
    return np.minimum((count * turn).astype(np.int64), count - 1)
