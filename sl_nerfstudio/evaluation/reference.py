"""What a result is compared with: a true mesh, or reference points."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.evaluation.alignment import Alignment, icp
from sl_nerfstudio.evaluation.surface import Surface
from sl_nerfstudio.geometry.similarity import Similarity

_ICP_POINTS = 20_000
_SMOOTHED = 4  # reference points that a colour is the mean of


@dataclass(frozen=True)
class MeshReference:
    """A true surface; `observed` are area-uniform points of the part that the scan could observe."""

    surface: Surface
    observed: Float[ndarray, "m 3"]
    description: str

    @property
    def size(self) -> float:
        """Diagonal of the bounding box."""
        return self.surface.diagonal

    def distance(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Distance from the nearest point on the triangles, observed or not."""
        return self.surface.distance(points)

    def signed_distance(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """The same, negative behind the nearest triangle (inside the object)."""
        near = self.surface.closest(points)
        behind = ((points - near.point) * near.normal).sum(1) < 0
        return np.where(behind, -near.distance, near.distance)

    def surface_errors(
        self, result: Surface, S_truth_result: Similarity, points: Float[ndarray, "n 3"]
    ) -> Float[ndarray, "n"]:
        """Signed distances, for colours, of `points` on the result (in its own frame) from the truth."""
        return self.signed_distance(S_truth_result.points(points))

    def align(self, result: Surface, samples: Float[ndarray, "n 3"], start: Similarity, with_scale: bool) -> Alignment:
        """ICP of points of the result onto the true triangles."""
        return icp(_thinned(samples), self.surface, start, with_scale)


class PointReference:
    """Measured points, for instance triangulated by other means: a reference, not a truth."""

    def __init__(self, points: Float[ndarray, "m 3"], description: str) -> None:
        self.observed = np.asarray(points, np.float64)
        self.description = description
        self.size = float(np.linalg.norm(np.ptp(self.observed, axis=0)))
        self._tree = KDTree(self.observed)

    def distance(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Distance from the nearest reference point: never below the points' own spacing between them."""
        return np.asarray(self._tree.query(points, workers=-1)[0], np.float64)

    def surface_errors(
        self, result: Surface, S_truth_result: Similarity, points: Float[ndarray, "n 3"]
    ) -> Float[ndarray, "n"]:
        """Signed distances, for colours, of `points` on the result (in its own frame) from the reference.

        Each is the mean over the nearest reference points of how far the result lies outside of *them*:
        the distance to the nearest point itself would mostly show the spacing of the points.
        """
        here = S_truth_result.inverse().points(self.observed)
        near = result.closest(here)
        outside = -np.copysign(near.distance, ((here - near.point) * near.normal).sum(1)) * S_truth_result.scale
        return outside[np.asarray(KDTree(here).query(points, k=_SMOOTHED)[1])].mean(1)

    def align(self, result: Surface, samples: Float[ndarray, "n 3"], start: Similarity, with_scale: bool) -> Alignment:
        """ICP of the reference points onto the result's triangles, turned round."""
        found = icp(_thinned(self.observed), result, start.inverse(), with_scale)
        S = found.S_target_source.inverse()
        return Alignment(S, found.residual * S.scale, found.iterations, found.converged)


Reference = MeshReference | PointReference
"""Something to measure a result against, in world axes and the scan's unit.

`observed` are the points of it that the result is expected to reach, `size` is the diagonal of its bounding box,
`description` a sentence for the report.
"""


def _thinned(points: Float[ndarray, "n 3"]) -> Float[ndarray, "m 3"]:
    """At most `_ICP_POINTS` of the points, evenly picked."""
    return points[:: max(1, -(-len(points) // _ICP_POINTS))]
