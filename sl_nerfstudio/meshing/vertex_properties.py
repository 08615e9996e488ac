"""Everything that is written with a vertex beside its place."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from sl_nerfstudio.meshing.vertex_quality import VertexQuality

GREY = 128
"""Of vertices whose colour no capture shows."""


@dataclass(frozen=True)
class VertexProperties:
    """Properties of every vertex of a mesh."""

    quality: VertexQuality
    invented: Bool[ndarray, "v"]  # no frame observed the surface there: it is the field's own continuation
    colour: UInt8[ndarray, "v 3"] | None = None  # sRGB; None: no frame was also captured without the pattern

    def chosen(self, index: Int[ndarray, "n"] | Bool[ndarray, "v"]) -> "VertexProperties":
        """Those of the chosen vertices, in that order."""
        quality = VertexQuality(**{name: values[index] for name, values in vars(self.quality).items()})
        return VertexProperties(quality, self.invented[index], None if self.colour is None else self.colour[index])

    def moved(self, distance: Float[ndarray, "v"]) -> "VertexProperties":
        """Those of vertices that were moved away from the surface: a further error in their uncertainty."""
        q = self.quality
        sigma, independent = (np.hypot(values, distance) for values in (q.sigma, q.sigma_independent))
        return replace(self, quality=replace(q, sigma=sigma, sigma_independent=independent))
