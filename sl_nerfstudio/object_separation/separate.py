"""The object of a scan apart from its surroundings.

Planes are found in the points of all frames, and each is judged (`planes`). What is part of a plane of the
surroundings, or behind one, is left out; of the rest, the connected part on which the cameras look is the object.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from numpy import ndarray
from scipy.ndimage import binary_closing, distance_transform_edt
from scipy.spatial import Delaunay, KDTree

from sl_nerfstudio.geometry.devices import Intrinsics, project
from sl_nerfstudio.geometry.numerics import component_labels, geman_mcclure_weight
from sl_nerfstudio.object_separation.planes import (
    BarePlaces,
    DecodedFrame,
    FramePlane,
    FramePoints,
    Plane,
    PlaneFinding,
    PointPool,
    ViewedRegion,
    cross_frame_noise,
    find_bare_places,
    find_planes,
    judge_plane,
    normals_of,
    on_plane,
    plane_in_frame,
    points_of,
    viewed_region,
)

PIXELS_PER_FRAME = 40_000  # decoded pixels of each frame that the search looks at, at most
_POINTS = 30_000  # of all frames together from which planes are found, at most
_SILHOUETTE_POINTS = 200_000  # points of the object that show which pixels that were not decoded belong to it, at most
_LEAST_OBJECT = 0.01  # share of the points that the object must hold; with less, nothing is left out


def silhouette(frame: DecodedFrame, p_object: Float[ndarray, "n 3"], gap: float) -> Bool[ndarray, "h w"]:
    """Pixels of a frame in which points of the object are, hidden or not; gaps up to `gap` wide are closed."""
    h, w = frame.seen.shape
    inside = np.zeros((h, w), dtype=bool)
    p_camera = (p_object - frame.T_world_camera[:3, 3]) @ frame.T_world_camera[:3, :3]
    uv, in_front = project(Intrinsics.of(frame.camera, torch.float64), torch.from_numpy(p_camera))
    column, row = np.floor(uv.numpy() / frame.stride).T
    shown = in_front.numpy() & (row >= 0) & (row < h) & (column >= 0) & (column < w)
    inside[row[shown].astype(np.int64), column[shown].astype(np.int64)] = True
    if not shown.any():
        return inside
    depth = float(np.median(-p_camera[shown, 2]))
    steps = max(1, round(gap * frame.camera.fl_x / depth / frame.stride / 2))
    padded = np.pad(inside, steps)
    return binary_closing(padded, iterations=steps)[steps:-steps, steps:-steps]


# Connected parts of a point cloud in voxels, and which of them are the object.

_VOXELS = 40  # along the radius of the viewed region
_LEAST_FRAMES, _LEAST_POINTS = 2, 4  # frames that must have seen a voxel, or points in it, for it to count
_LEAST_VOXELS = 5  # of the smallest part that is kept beside the main part
_GAP = 0.15  # distance from the main part within which other parts are kept, as a share of its size
_REACH = 2  # voxels: how far apart connected ones may be
_TOUCHES = 3.0  # voxels: what comes so near to a plane stands on it
_WITHIN = 0.5  # share of a part that must lie in the main part's outline in the plane


@dataclass(frozen=True)
class ObjectVoxels:
    """The voxels of the object."""

    size: float
    centres: Float64[ndarray, "v 3"]

    def contain(self, p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether points are in a voxel of the object or within a voxel of one."""
        if not len(self.centres) or not len(p_world):
            return np.zeros(len(p_world), dtype=bool)
        limit = 1.3 * self.size
        return np.isfinite(KDTree(self.centres).query(p_world, distance_upper_bound=limit)[0])


def find_object(
    frames: Sequence[Float[ndarray, "_n 3"]], planes: Sequence[Plane], region: ViewedRegion, size: float
) -> ObjectVoxels:
    """The part on which most cameras look, and what belongs to it.

    `frames` are points without surroundings, `planes` those of the surroundings. A part that is not connected to the
    main one, because what is between them was not decoded, belongs to it if the gap is short, and if it floats or is
    below or above the main one; what stands on a plane beside it does not.
    """
    voxels = _occupied(frames, size)
    centres = (voxels + 0.5) * size
    if not len(voxels):
        return ObjectVoxels(size, centres)
    label = _connected(voxels)
    distance = np.linalg.norm(centres - region.focus, axis=1) / region.radius
    main = int(np.argmax(np.bincount(label, geman_mcclure_weight(distance**2))))
    kept = _near_main(centres, label, main, _candidates(centres, label, main, planes, size))
    return ObjectVoxels(size, centres[kept[label]])


def _occupied(frames: Sequence[Float[ndarray, "_n 3"]], size: float) -> Int64[ndarray, "v 3"]:
    """Voxels that several frames saw, or one saw clearly."""
    each = [np.unique(np.floor(p / size).astype(np.int64), axis=0, return_counts=True) for p in frames if len(p)]
    if not each:
        return np.zeros((0, 3), dtype=np.int64)
    voxel, place = np.unique(np.concatenate([v for v, _ in each]), axis=0, return_inverse=True)
    place = place.reshape(-1)
    seen_by = np.bincount(place, minlength=len(voxel))
    points = np.bincount(place, np.concatenate([n for _, n in each]), len(voxel))
    return voxel[(seen_by >= _LEAST_FRAMES) | (points >= _LEAST_POINTS)]


def _connected(voxels: Int64[ndarray, "v 3"]) -> Int64[ndarray, "v"]:
    """The connected part of each voxel, by its number."""
    a, b = KDTree(voxels).query_pairs(_REACH, p=np.inf, output_type="ndarray").T
    return component_labels(a, b, len(voxels))


def _candidates(
    centres: Float[ndarray, "v 3"], label: Int64[ndarray, "v"], main: int, planes: Sequence[Plane], size: float
) -> Bool[ndarray, "parts"]:
    """Parts that are large enough, and do not stand on a plane beside the main part."""
    members = np.bincount(label)
    fits = members >= _LEAST_VOXELS
    for plane in planes:
        touching = np.bincount(label, plane.heights(centres) < _TOUCHES * size) > 0
        flat = (centres - centres[label == main].mean(0)) @ plane.axes().T
        within, body = np.zeros(len(flat)), flat[label == main]
        if len(body) > 3 and np.linalg.svd(body - body.mean(0), compute_uv=False)[-1] > size:  # it spans an area
            within = (Delaunay(body).find_simplex(flat) >= 0).astype(float)
        fits &= ~touching | (np.bincount(label, within) > _WITHIN * members)
    return fits


def _near_main(
    centres: Float[ndarray, "v 3"], label: Int64[ndarray, "v"], main: int, candidates: Bool[ndarray, "parts"]
) -> Bool[ndarray, "parts"]:
    """The main part, and candidates that a short gap separates from it or from such a part."""
    body = centres[label == main]
    limit = _GAP * float(np.linalg.norm(np.percentile(body, 98, axis=0) - np.percentile(body, 2, axis=0)))
    kept = np.zeros(len(candidates), dtype=bool)
    kept[main] = True
    while True:
        rest = np.flatnonzero(~kept[label] & candidates[label])
        if not len(rest):
            return kept
        distance = KDTree(centres[kept[label]]).query(centres[rest], distance_upper_bound=limit)[0]
        near = np.unique(label[rest[np.isfinite(distance)]])
        if not len(near):
            return kept
        kept[near] = True


class Part(IntEnum):
    """Part of the scene that a pixel shows."""

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
    """Decision which pixels and points belong to the object."""

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
            gap = covered
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


def separate(frames: Sequence[DecodedFrame], seed: int = 0) -> Separation:
    """Find the object. The same frames and seed give the same result.

    If hardly anything would be left, no plane counts as surroundings.
    """
    rng = np.random.default_rng(seed)
    thin = [frame.thinned(PIXELS_PER_FRAME) for frame in frames]
    points = [points_of(frame) for frame in thin]
    few = [p.chosen(_spread(len(p), _POINTS // len(points), rng)) for p in points]
    normals = [normals_of(p) for p in few]
    pose_noise = cross_frame_noise(few, normals)
    pool = PointPool.of([replace(p, sigma=p.sigma * pose_noise) for p in few], normals)
    region = viewed_region(thin, pool.points.p_world)
    size = _voxel_size(points, region)
    findings = tuple(
        judge_plane(plane, share, pool, thin, points, region) for plane, share in find_planes(pool, region.radius, rng)
    )
    outside = [_surroundings(f, points, pose_noise, region, size) for f in findings if f.is_surroundings]
    rest = [_without(outside, k, p) for k, p in enumerate(points)]
    voxels = find_object(rest, [s.finding.plane for s in outside], region, size)
    held = sum(int(voxels.contain(p).sum()) for p in rest)
    if held < _LEAST_OBJECT * sum(map(len, points)):
        outside, rest = [], [p.p_world for p in points]
        voxels = find_object(rest, [], region, size)
    p_object = np.concatenate([p[voxels.contain(p)] for p in rest])
    p_object = p_object[_spread(len(p_object), _SILHOUETTE_POINTS, rng)]
    return Separation(findings, tuple(outside), voxels, p_object)


def _spread(count: int, most: int, rng: np.random.Generator) -> ndarray:
    """Indices of all, or of a random choice of `most`, in order."""
    return np.arange(count) if count <= most else np.sort(rng.choice(count, most, replace=False))


def _voxel_size(points: Sequence[FramePoints], region: ViewedRegion) -> float:
    """Small beside the viewed region, but with several points of a frame on a surface through it."""
    inside = [int(region.contains(p.p_world).sum()) for p in points]
    spacing = region.radius * float(np.sqrt(np.pi / max(np.median(inside), 1.0)))
    return max(region.radius / _VOXELS, 3 * spacing)


def _surroundings(
    finding: PlaneFinding, points: Sequence[FramePoints], pose_noise: float, region: ViewedRegion, size: float
) -> Surroundings:
    plane = finding.plane
    own = tuple(plane_in_frame(plane, p, pose_noise, region.radius) for p in points)
    both = list(zip(points, own, strict=True))
    bare = find_bare_places(plane, both, size / 2)
    heights = [f.noise * float(np.median(p.sigma_along(plane.normal))) for p, f in both if len(p)]
    return Surroundings(finding, bare, own, bare.near * float(np.median(heights)))


def _without(outside: Sequence[Surroundings], index: int, points: FramePoints) -> Float[ndarray, "n 3"]:
    """The points of a frame that are not part of surroundings."""
    keep = np.ones(len(points), dtype=bool)
    for plane in outside:
        keep &= ~on_plane(points, plane.frames[index], plane.bare)
    return points.p_world[keep]
