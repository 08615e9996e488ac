"""What a result is compared with: a true mesh, or reference points."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.alignment import Alignment, icp
from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.evaluation.observed import observable
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import Scan

_ICP_POINTS = 20_000
_SMOOTHED = 4  # number of reference points over which an error colour is averaged


@dataclass(frozen=True)
class MeshReference:
    """A true surface; `observed` are area-uniform points of the part that the scan could observe."""

    surface: IndexedMesh
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
        self, result: IndexedMesh, S_truth_result: Similarity, points: Float[ndarray, "n 3"]
    ) -> Float[ndarray, "n"]:
        """Signed distances, for colours, of `points` on the result (in the frame of the result) from the truth."""
        return self.signed_distance(S_truth_result.points(points))

    def align(
        self, result: IndexedMesh, samples: Float[ndarray, "n 3"], start: Similarity, with_scale: bool
    ) -> Alignment:
        """ICP of points of the result onto the true triangles."""
        return icp(_thinned(samples), self.surface, start, with_scale)


class PointReference:
    """Measured points, for example from another scanner: a reference, but not exact."""

    def __init__(self, points: Float[ndarray, "m 3"], description: str) -> None:
        self.observed = np.asarray(points, np.float64)
        self.description = description
        self.size = float(np.linalg.norm(np.ptp(self.observed, axis=0)))
        self._tree = KDTree(self.observed)

    def distance(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Distance from the nearest reference point; between the points it cannot fall below their spacing."""
        return np.asarray(self._tree.query(points, workers=-1)[0], np.float64)

    def surface_errors(
        self, result: IndexedMesh, S_truth_result: Similarity, points: Float[ndarray, "n 3"]
    ) -> Float[ndarray, "n"]:
        """Signed distances, for colours, of `points` on the result (in the frame of the result) from the reference.

        Each is a mean over the nearest reference points: how far the result is outside of *them*. The distance to the
        nearest reference point would mostly show the spacing of the points.
        """
        here = S_truth_result.inverse().points(self.observed)
        near = result.closest(here)
        outside = -np.copysign(near.distance, ((here - near.point) * near.normal).sum(1)) * S_truth_result.scale
        return outside[np.asarray(KDTree(here).query(points, k=_SMOOTHED)[1])].mean(1)

    def align(
        self, result: IndexedMesh, samples: Float[ndarray, "n 3"], start: Similarity, with_scale: bool
    ) -> Alignment:
        """ICP of the reference points onto the result's triangles, inverted."""
        found = icp(_thinned(self.observed), result, start.inverse(), with_scale)
        S = found.S_target_source.inverse()
        return Alignment(S, found.residual * S.scale)


Reference = MeshReference | PointReference
"""Something to measure a result against, in world axes and the scan's unit.

`observed` are the points that the result should reach, `size` is the diagonal of the bounding box, `description` is a
sentence for the report.
"""


def mesh_reference(mesh: Mesh, scan: Scan, poses: DevicePoses, samples: int = 100_000, seed: int = 0) -> MeshReference:
    """A true mesh with the part of it that `scan` could observe with `poses` (the true ones, if known).

    Raises UserError if nothing of it could be observed, or if it is probably inside out.
    """
    surface = IndexedMesh(mesh)
    points, normals = surface.sample(samples, seed + 1)
    frames = [
        (frame.camera, T_c, scan.projector, T_p)
        for frame, T_c, T_p in zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True)
    ]
    seen = observable(points, normals, surface, frames)
    # Almost nothing of a closed mesh is visible if it is inside out; with flipped normals, much more is.
    few = seen.mean() < 0.05
    if not seen.any() or (few and observable(points, -normals, surface, frames).mean() > 4 * seen.mean()):
        raise UserError(
            "no part of the reference mesh is both seen by a camera and lit by its projector\n"
            f"    cause:  it is inside out, in another unit than the scan ({scan.units}), or in other axes\n"
            "    remedy: give a mesh in the world axes and unit of transforms.json, triangles counter-clockwise "
            "from outside"
        )
    return MeshReference(
        surface,
        points[seen],
        f"true mesh; {seen.mean():.0%} of its area is seen by at least one camera while its projector lights it, "
        "and only that part counts for completeness",
    )


def _thinned(points: Float[ndarray, "n 3"]) -> Float[ndarray, "m 3"]:
    """At most `_ICP_POINTS` of the points, evenly spaced."""
    return points[:: max(1, -(-len(points) // _ICP_POINTS))]
