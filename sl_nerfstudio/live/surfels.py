"""The surface so far as small cells: how often each was seen, how well it is known, and which way it looks."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.surfaces import SurfaceMap

CELLS = 24.0  # along the RMS radius of what the first frame saw
LEAST_FILLED = 0.3  # points of a cell, relative to the median
ENOUGH = 3  # kept views of a cell
_SHIFT = 1 << 19  # cells on each side of the origin that a key has room for


@dataclass(frozen=True)
class Surfels:
    """Cells that kept frames have seen; lengths in the model's unit."""

    key: Int64[ndarray, "n"]  # sorted
    sums: Float64[ndarray, "n 6"]  # of positions and normals
    points: Int64[ndarray, "n"]  # that were summed up
    views: Int64[ndarray, "n"]
    information: Float64[ndarray, "n"]  # inverse variance along the normal
    size: float  # of a cell

    @staticmethod
    def none(size: float) -> "Surfels":
        """Nothing seen yet."""
        count = np.zeros(0, dtype=np.int64)
        return Surfels(count, np.zeros((0, 6)), count, count, np.zeros(0), size)

    @property
    def position(self) -> Float64[ndarray, "n 3"]:
        """Mean of the points in each cell."""
        return self.sums[:, :3] / self.points[:, None]

    @property
    def normal(self) -> Float64[ndarray, "n 3"]:
        """Mean direction, unit length."""
        n = self.sums[:, 3:]
        return n / np.linalg.norm(n, axis=1, keepdims=True).clip(1e-300)

    @property
    def solid(self) -> Bool[ndarray, "n"]:
        """Cells through whose middle the surface goes; those whose corners it cuts hold few points."""
        return self.points >= LEAST_FILLED * np.median(self.points) if len(self) else np.zeros(0, dtype=bool)

    @property
    def sigma(self) -> Float64[ndarray, "n"]:
        """One standard deviation along the normal."""
        return 1 / np.sqrt(self.information)

    def __len__(self) -> int:
        """Number of cells."""
        return len(self.key)

    def with_frame(self, seen: SurfaceMap, S_world_camera: Similarity, sigma_pose: float) -> "Surfels":
        """Add what one more frame sees; `sigma_pose` is how far its surface may be off as a whole."""
        p, n = _in_world(seen, S_world_camera)
        key = _keys(p, self.size)
        sigma = np.hypot(S_world_camera.scale * seen.sigma[seen.valid], sigma_pose)
        own, index, points = np.unique(key, return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(index, column) for column in np.concatenate([p, n], 1).T], 1)
        # points of one cell share the decoder's errors: together they are worth one of them
        information = np.bincount(index, 1 / sigma**2) / points
        every = np.union1d(self.key, own)
        old, new = np.searchsorted(every, self.key), np.searchsorted(every, own)
        total, count, views = np.zeros((len(every), 6)), *np.zeros((2, len(every)), dtype=np.int64)
        known = np.zeros(len(every))
        total[old], count[old], views[old], known[old] = self.sums, self.points, self.views, self.information
        total[new] += sums
        count[new] += points
        views[new] += 1
        known[new] += information
        return Surfels(every, total, count, views, known, self.size)

    def thin_share(self, seen: SurfaceMap, S_world_camera: Similarity) -> float:
        """Share of what a frame sees that too few kept frames have seen."""
        key = _keys(_in_world(seen, S_world_camera)[0], self.size)
        if not len(key):
            return 0.0
        at = np.searchsorted(self.key, key).clip(max=max(len(self) - 1, 0))
        known: Bool[ndarray, m] = (self.key[at] == key) & (self.views[at] >= ENOUGH) if len(self) else key < 0
        return float(1 - known.mean())


def _in_world(seen: SurfaceMap, S: Similarity) -> tuple[Float64[ndarray, "m 3"], Float64[ndarray, "m 3"]]:
    return S.points(seen.point[seen.valid]), seen.normal[seen.valid] @ S.R.T


def _keys(p: Float64[ndarray, "m 3"], size: float) -> Int64[ndarray, "m"]:
    x, y, z = (np.floor(p / size).astype(np.int64) + _SHIFT).clip(0, 2 * _SHIFT - 1).T
    return (x * 2 * _SHIFT + y) * 2 * _SHIFT + z
