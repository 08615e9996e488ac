"""The object of a scan apart from its surroundings.

Planes are found in the points of all frames, and each is judged (`plane_judgement`). What is part of a plane of the
surroundings, or behind one, is left out; of the rest, the connected part on which the cameras look is the object.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

from sl_nerfstudio.object_separation.frame_planes import (
    BarePlaces,
    FramePlane,
    find_bare_places,
    on_plane,
    plane_in_frame,
)
from sl_nerfstudio.object_separation.frame_points import (
    DecodedFrame,
    FramePoints,
    cross_frame_noise,
    normals_of,
    points_of,
)
from sl_nerfstudio.object_separation.parts import ObjectVoxels, find_object
from sl_nerfstudio.object_separation.plane_judgement import PlaneFinding, judge_plane
from sl_nerfstudio.object_separation.plane_search import PointPool, find_planes
from sl_nerfstudio.object_separation.settings import SEPARATION_DEFAULTS, SeparationSettings
from sl_nerfstudio.object_separation.silhouette import silhouette
from sl_nerfstudio.object_separation.viewed_region import ViewedRegion, viewed_region


class Part(IntEnum):
    """What a pixel shows."""

    NOTHING = 0  # the pattern was not seen
    OBJECT = 1
    PLANE = 2  # part of a plane of the surroundings, or behind one
    BEYOND = 3  # not connected to the object


@dataclass(frozen=True)
class Surroundings:
    """A plane of the surroundings, in all frames together and in each frame."""

    finding: PlaneFinding
    bare: BarePlaces
    frames: tuple[FramePlane, ...]
    tolerance: float  # height that belongs to the plane, where single frames cannot be told apart


@dataclass(frozen=True)
class Separation:
    """Which pixels and points belong to the object."""

    region: ViewedRegion
    findings: tuple[PlaneFinding, ...]  # all planes that were judged
    surroundings: tuple[Surroundings, ...]  # those that are left out
    voxels: ObjectVoxels
    p_object: Float64[ndarray, "n 3"]  # points of the object from all frames

    def parts(self, index: int, frame: DecodedFrame) -> UInt8[ndarray, "h w"]:
        """The `Part` at every pixel of a frame, with any stride; `index` counts the frames that were separated.

        Pixels that saw the pattern, but were not decoded, show the object where its points from all frames are; the
        others are of the same part as the nearest decoded pixel of the surroundings.
        """
        points = points_of(frame)
        label = np.full(frame.seen.shape, Part.NOTHING, dtype=np.uint8)
        label[points.row, points.column] = self._of_points(index, points)
        gap = frame.seen & (label == Part.NOTHING)
        covered = gap & silhouette(frame, self.p_object, self.voxels.size)
        others = label > Part.OBJECT
        if others.any():
            near = np.asarray(distance_transform_edt(~others, return_distances=False, return_indices=True))
            label[gap] = label[near[0][gap], near[1][gap]]
            label[covered] = Part.OBJECT
        else:
            label[gap] = Part.OBJECT
        return label

    def keeps(self, p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether points of a surface (a mesh) belong to the object."""
        kept = self.voxels.contain(p_world)
        for plane in self.surroundings:
            kept &= plane.finding.plane.heights(p_world) > plane.tolerance
        return kept

    def _of_points(self, index: int, points: FramePoints) -> UInt8[ndarray, "n"]:
        label = np.where(self.voxels.contain(points.p_world), Part.OBJECT, Part.BEYOND).astype(np.uint8)
        for plane in self.surroundings:
            label[on_plane(points, plane.frames[index], plane.bare)] = Part.PLANE
        return label


def separate(
    frames: Sequence[DecodedFrame], seed: int = 0, settings: SeparationSettings = SEPARATION_DEFAULTS
) -> Separation:
    """Find the object. The same frames and seed give the same result.

    If hardly anything would be left, no plane counts as surroundings.
    """
    rng = np.random.default_rng(seed)
    thin = [frame.thinned(settings.pixels_per_frame) for frame in frames]
    points = [points_of(frame) for frame in thin]
    few = [p.chosen(_spread(len(p), settings.points // len(points), rng)) for p in points]
    normals = [normals_of(p, settings.neighbours) for p in few]
    pose_noise = cross_frame_noise(few, normals)
    pool = PointPool.of([p.scaled_noise(pose_noise) for p in few], normals)
    region = viewed_region(thin, pool.points.p_world)
    size = _voxel_size(points, region, settings)
    findings = tuple(
        judge_plane(plane, share, pool, thin, points, region, settings)
        for plane, share in find_planes(pool, region.radius, rng, settings)
    )
    outside = [_surroundings(f, points, pose_noise, region, size, settings) for f in findings if f.is_surroundings]
    rest = [_without(outside, k, p) for k, p in enumerate(points)]
    voxels = find_object(rest, [s.finding.plane for s in outside], region, size, settings)
    held = sum(int(voxels.contain(p).sum()) for p in rest)
    if held < settings.least_object * sum(map(len, points)):
        outside, rest = [], [p.p_world for p in points]
        voxels = find_object(rest, [], region, size, settings)
    p_object = np.concatenate([p[voxels.contain(p)] for p in rest])
    p_object = p_object[_spread(len(p_object), settings.silhouette_points, rng)]
    return Separation(region, findings, tuple(outside), voxels, p_object)


def _spread(count: int, most: int, rng: np.random.Generator) -> ndarray:
    """Indices of all, or of a random choice of `most`, in order."""
    return np.arange(count) if count <= most else np.sort(rng.choice(count, most, replace=False))


def _voxel_size(points: Sequence[FramePoints], region: ViewedRegion, settings: SeparationSettings) -> float:
    """Small beside the viewed region, but with several points of a frame on a surface through it."""
    inside = [int(region.contains(p.p_world).sum()) for p in points]
    spacing = region.radius * float(np.sqrt(np.pi / max(np.median(inside), 1.0)))
    return max(region.radius / settings.voxels, 3 * spacing)


def _surroundings(
    finding: PlaneFinding,
    points: Sequence[FramePoints],
    pose_noise: float,
    region: ViewedRegion,
    size: float,
    settings: SeparationSettings,
) -> Surroundings:
    plane = finding.plane
    own = tuple(plane_in_frame(plane, p, pose_noise, region.radius, settings) for p in points)
    bare = find_bare_places(plane, list(zip(points, own, strict=True)), size / 2, settings)
    heights = [
        f.noise * float(np.median(p.sigma_along(plane.normal))) for f, p in zip(own, points, strict=True) if len(p)
    ]
    return Surroundings(finding, bare, own, bare.near * float(np.median(heights)))


def _without(outside: Sequence[Surroundings], index: int, points: FramePoints) -> Float[ndarray, "n 3"]:
    """The points of a frame that are not part of surroundings."""
    keep = np.ones(len(points), dtype=bool)
    for plane in outside:
        keep &= ~on_plane(points, plane.frames[index], plane.bare)
    return points.p_world[keep]
