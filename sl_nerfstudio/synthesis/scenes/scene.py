"""A scene: a surface in millimetres, with what rendering and paths need to know about it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray


@dataclass(frozen=True)
class Scene:
    """A triangle mesh; z is up, and the object is near the origin. All lengths in millimetres.

    `vertex_normals` (unit) make the shading smooth; with None it is flat. `elevation_deg` is the range of elevations
    from which cameras look at it.
    """

    name: str
    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]
    vertex_normals: Float[ndarray, "v 3"] | None = None
    elevation_deg: tuple[float, float] = (25.0, 65.0)

    @cached_property
    def centre(self) -> Float[ndarray, "3"]:
        """Middle of the bounding box: what the devices look at."""
        return (self.vertices.min(0) + self.vertices.max(0)) / 2

    @cached_property
    def radius(self) -> float:
        """Radius of the sphere around `centre` that contains the object."""
        return float(np.linalg.norm(self.vertices - self.centre, axis=1).max())

    @cached_property
    def size(self) -> float:
        """Longest side of the bounding box."""
        return float(np.ptp(self.vertices, axis=0).max())

    @cached_property
    def face_normals(self) -> Float[ndarray, "f 3"]:
        """Unit normals of the faces, outwards for a closed mesh."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
