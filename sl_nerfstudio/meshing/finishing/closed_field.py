"""A field whose zero level is closed: it ends at the walls of its box, and at planes."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from sl_nerfstudio.meshing.sparse_grid import Field

_MARGIN = 2e-3  # of the box's half side: what is nearer to its walls is outside

_FACETS = 64  # of a convex hull, the largest ones: the many small ones are where the surface was observed

Planes = list[tuple[Float64[ndarray, "3"], float]]
"""Unit normals n and offsets d: points with n . p > d are above."""


class ClosedField:
    """The solid of a field within the box [-1, 1]^3 and above planes.

    A point is inside if it is inside the field's surface, inside the box, and above every plane: the largest of these
    signed distances, so walls and planes cut the solid with flat faces.
    """

    def __init__(
        self, field: Field, planes: Sequence[tuple[Float64[ndarray, "3"], float]], device: torch.device
    ) -> None:
        """`planes` are unit normals n and offsets d in the box's frame: points with n . p > d are above."""
        self._field = field
        self._normals = [(torch.as_tensor(n, dtype=torch.float32, device=device), d) for n, d in planes]

    def __call__(self, p: Tensor) -> Tensor:
        """Signed distance of points (n, 3), at least approximately; negative inside."""
        found = torch.maximum(self._field(p), p.abs().amax(-1) - (1 - _MARGIN))
        for normal, offset in self._normals:
            found = torch.maximum(found, offset - p @ normal)
        return found


def hull_planes(points: Float[ndarray, "n 3"], margin: float) -> Planes:
    """The largest faces of the convex hull of points, moved out by `margin`, with the points above them.

    None if the points have no volume.
    """
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return []
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    facet, of_facet = np.unique(hull.equations.round(6), axis=0, return_inverse=True)
    area = np.bincount(of_facet.reshape(-1), np.linalg.norm(np.cross(b - a, c - a), axis=1), len(facet))
    return [(-row[:3], float(row[3]) - margin) for row in facet[np.argsort(-area)[:_FACETS]]]
