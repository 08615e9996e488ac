"""Planes in the world, and their least-squares fit."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray


@dataclass(frozen=True)
class Plane:
    """All points with `normal . p = offset`; heights are positive on the side that the unit normal points to."""

    normal: Float64[ndarray, "3"]
    offset: float

    def heights(self, p_world: Float[ndarray, "n 3"]) -> Float64[ndarray, "n"]:
        """Signed distances of points."""
        return p_world @ self.normal - self.offset

    def flipped(self) -> "Plane":
        """The same plane with the other side up."""
        return Plane(-self.normal, -self.offset)

    def axes(self) -> Float64[ndarray, "2 3"]:
        """Two unit vectors in the plane, perpendicular to each other."""
        least = np.eye(3)[np.argmin(np.abs(self.normal))]
        first = np.cross(self.normal, least)
        first = first / np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first)])


def fit_plane(p_world: Float[ndarray, "n 3"], weight: Float[ndarray, "n"]) -> Plane:
    """The plane with the least weighted sum of squared distances; at least three points not on a line."""
    centre = (weight[:, None] * p_world).sum(0) / weight.sum()
    offset = p_world - centre
    _, vectors = np.linalg.eigh((weight[:, None] * offset).T @ offset)
    normal = vectors[:, 0]
    return Plane(normal, float(normal @ centre))
