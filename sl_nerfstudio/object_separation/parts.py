"""Connected parts of a point cloud in voxels, and which of them are the object."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from numpy import ndarray
from scipy.spatial import Delaunay, KDTree

from sl_nerfstudio.geometry.connectivity import component_labels
from sl_nerfstudio.geometry.robust import geman_mcclure_weight
from sl_nerfstudio.object_separation.plane import Plane
from sl_nerfstudio.object_separation.settings import SeparationSettings
from sl_nerfstudio.object_separation.viewed_region import ViewedRegion

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
    frames: Sequence[Float[ndarray, "_n 3"]],
    planes: Sequence[Plane],
    region: ViewedRegion,
    size: float,
    settings: SeparationSettings,
) -> ObjectVoxels:
    """The part on which most cameras look, and what belongs to it.

    `frames` are points without surroundings, `planes` those of the surroundings. A part that is not connected to the
    main one, because what is between them was not decoded, belongs to it if the gap is short, and if it floats or is
    below or above the main one; what stands on a plane beside it does not.
    """
    voxels = _occupied(frames, size, settings)
    centres = (voxels + 0.5) * size
    if not len(voxels):
        return ObjectVoxels(size, centres)
    count, label = _connected(voxels)
    distance = np.linalg.norm(centres - region.focus, axis=1) / region.radius
    main = int(np.argmax(np.bincount(label, geman_mcclure_weight(distance**2), count)))
    kept = _near_main(centres, label, main, _candidates(centres, label, main, planes, size, settings), settings)
    return ObjectVoxels(size, centres[kept[label]])


def _occupied(
    frames: Sequence[Float[ndarray, "_n 3"]], size: float, settings: SeparationSettings
) -> Int64[ndarray, "v 3"]:
    """Voxels that several frames saw, or one saw clearly."""
    each = [np.unique(np.floor(p / size).astype(np.int64), axis=0, return_counts=True) for p in frames if len(p)]
    if not each:
        return np.zeros((0, 3), dtype=np.int64)
    voxel, place = np.unique(np.concatenate([v for v, _ in each]), axis=0, return_inverse=True)
    place = place.reshape(-1)
    seen_by = np.bincount(place, minlength=len(voxel))
    points = np.bincount(place, np.concatenate([n for _, n in each]), len(voxel))
    return voxel[(seen_by >= settings.least_frames) | (points >= settings.least_points)]


def _connected(voxels: Int64[ndarray, "v 3"]) -> tuple[int, Int64[ndarray, "v"]]:
    """Number of connected parts, and the part of each voxel."""
    low, span = voxels.min(0) - _REACH, np.ptp(voxels, axis=0) + 2 * _REACH + 1

    def key(v: Int64[ndarray, "v 3"]) -> Int64[ndarray, "v"]:
        x, y, z = (v - low).T
        return (x * span[1] + y) * span[2] + z

    order = np.argsort(key(voxels))
    keys = key(voxels)[order]
    pairs = []
    for step in product(range(-_REACH, _REACH + 1), repeat=3):
        if step <= (0, 0, 0):
            continue  # each pair once
        there = key(voxels + np.array(step))
        place = np.searchsorted(keys, there).clip(max=len(keys) - 1)
        found = keys[place] == there
        pairs.append(np.stack([np.flatnonzero(found), order[place[found]]]))
    a, b = np.concatenate(pairs, 1)
    label = component_labels(a, b, len(voxels))
    return int(label.max(initial=-1)) + 1, label


def _candidates(
    centres: Float[ndarray, "v 3"],
    label: Int64[ndarray, "v"],
    main: int,
    planes: Sequence[Plane],
    size: float,
    settings: SeparationSettings,
) -> Bool[ndarray, "parts"]:
    """Parts that are large enough, and do not stand on a plane beside the main part."""
    count = int(label.max(initial=-1)) + 1
    members = np.bincount(label, minlength=count)
    fits = members >= settings.least_voxels
    for plane in planes:
        touching = np.bincount(label, plane.heights(centres) < _TOUCHES * size, count) > 0
        flat = (centres - centres[label == main].mean(0)) @ plane.axes().T
        outline = Delaunay(flat[label == main]) if _has_area(flat[label == main], size) else None
        within = np.zeros(len(flat)) if outline is None else (outline.find_simplex(flat) >= 0).astype(float)
        fits &= ~touching | (np.bincount(label, within, count) > _WITHIN * members)
    return fits


def _has_area(flat: Float[ndarray, "v 2"], size: float) -> bool:
    """Whether places span an area, so that they have an outline."""
    return len(flat) > 3 and float(np.linalg.svd(flat - flat.mean(0), compute_uv=False)[-1]) > size


def _near_main(
    centres: Float[ndarray, "v 3"],
    label: Int64[ndarray, "v"],
    main: int,
    candidates: Bool[ndarray, "parts"],
    settings: SeparationSettings,
) -> Bool[ndarray, "parts"]:
    """The main part, and candidates that a short gap separates from it or from such a part."""
    body = centres[label == main]
    limit = settings.gap * float(np.linalg.norm(np.percentile(body, 98, axis=0) - np.percentile(body, 2, axis=0)))
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
