"""How far a frame's points are from those of all other frames, without a search tree for every frame."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial import KDTree

_FEWEST_POINTS = 10


class OtherClouds:
    """Point clouds of frames, to be searched without the cloud of one frame.

    Two numbers differ in at least one binary digit. So the clouds whose number differs from k are those that differ
    in the first digit, in the second, and so on: two trees for each digit serve all frames.
    """

    def __init__(self, clouds: Sequence[Float64[ndarray, "_ 3"]]) -> None:
        """`clouds` are numbered in their order."""
        points = np.concatenate([np.empty((0, 3)), *clouds])
        number = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
        self._sizes = [len(cloud) for cloud in clouds]
        self._total = len(points)
        digits = range(max(1, (len(clouds) - 1).bit_length()))
        self._trees = [[KDTree(points[number >> digit & 1 == value]) for value in (0, 1)] for digit in digits]

    def distance(self, cloud: Float64[ndarray, "n 3"], index: int) -> float:
        """Median distance from the points of `cloud` to the nearest one of any cloud but number `index`.

        Infinite where either side has too few points.
        """
        if len(cloud) < _FEWEST_POINTS or self._total - self._sizes[index] < _FEWEST_POINTS:
            return np.inf
        trees = [pair[1 - (index >> digit & 1)] for digit, pair in enumerate(self._trees)]
        nearest = np.min([tree.query(cloud)[0] for tree in trees if tree.n], axis=0)
        return float(np.median(nearest))
