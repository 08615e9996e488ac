"""A field whose zero level is closed: it ends at the box, and at planes on which the object stands."""

from collections.abc import Sequence

import torch
from jaxtyping import Float64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.meshing.sparse_grid import Field

_MARGIN = 2e-3  # of the box's half side: what is nearer to its walls is outside


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
