"""A mesh whose vertices say whether they were observed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from sl_nerfstudio.meshing.mesh import Mesh


@dataclass(frozen=True)
class MarkedMesh:
    """A surface, part of which may be the field's own continuation."""

    mesh: Mesh
    invented: Bool[ndarray, "v"]  # no frame observed the vertex

    def with_faces(self, keep: Bool[ndarray, "f"]) -> "MarkedMesh":
        """The chosen triangles, with the vertices that they use."""
        return MarkedMesh(self.mesh.with_faces(keep), self.invented[self.mesh.corners_of(keep)])

    def invented_share(self) -> float:
        """Share of the area whose triangles have a corner that no frame observed."""
        areas = self.mesh.face_areas()
        return float(areas[self.invented[self.mesh.faces].any(1)].sum() / max(areas.sum(), 1e-300))

    def largest_component(self) -> "MarkedMesh":
        """The connected piece with the largest area."""
        piece = self.mesh.component_of_faces()
        return self.with_faces(piece == int(np.argmax(np.bincount(piece, self.mesh.face_areas()))))
