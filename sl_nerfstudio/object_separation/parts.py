"""Connected parts of a point cloud in voxels, and which of them are the object."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from numpy import ndarray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sl_nerfstudio.object_separation.settings import SeparationSettings
from sl_nerfstudio.object_separation.viewed_region import ViewedRegion

_REACH = 2  # voxels: how far apart connected ones may be


@dataclass(frozen=True)
class ObjectVoxels:
    """The voxels of the object."""

    size: float
    centres: Float64[ndarray, "v 3"]

    def contain(self, p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether points are in a voxel of the object or within a voxel of one."""
        if not len(self.centres) or not len(p_world):
            return np.zeros(len(p_world), dtype=bool)
        limit = 2.0 * self.size
        return np.isfinite(cKDTree(self.centres).query(p_world, distance_upper_bound=limit)[0])


def find_object(
    frames: Sequence[Float[ndarray, "_n 3"]], region: ViewedRegion, size: float, settings: SeparationSettings
) -> ObjectVoxels:
    """The part on which most cameras look, and what is close to it; `frames` are points without surroundings."""
    voxels = _occupied(frames, size, settings)
    centres = (voxels + 0.5) * size
    if not len(voxels):
        return ObjectVoxels(size, centres)
    count, label = _connected(voxels)
    distance = np.linalg.norm(centres - region.focus, axis=1) / region.radius
    main = int(np.argmax(np.bincount(label, 1 / (1 + distance**2) ** 2, count)))
    kept = _near_main(centres, label, main, settings)
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
    n = len(voxels)
    count, label = connected_components(coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(n, n)), directed=False)
    return int(count), label.astype(np.int64)


def _near_main(
    centres: Float[ndarray, "v 3"], label: Int64[ndarray, "v"], main: int, settings: SeparationSettings
) -> Bool[ndarray, "parts"]:
    """The main part, and parts that a short gap separates from it or from such a part."""
    body = centres[label == main]
    limit = settings.gap * float(np.linalg.norm(np.percentile(body, 98, axis=0) - np.percentile(body, 2, axis=0)))
    count = int(label.max()) + 1
    large = np.bincount(label, minlength=count) >= settings.least_voxels
    kept = np.zeros(count, dtype=bool)
    kept[main] = True
    while True:
        rest = np.flatnonzero(~kept[label] & large[label])
        if not len(rest):
            return kept
        distance = cKDTree(centres[kept[label]]).query(centres[rest], distance_upper_bound=limit)[0]
        near = np.unique(label[rest[np.isfinite(distance)]])
        if not len(near):
            return kept
        kept[near] = True
