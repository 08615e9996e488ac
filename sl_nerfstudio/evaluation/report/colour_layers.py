"""What the interactive view of the surface can be coloured by."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.evaluation.report.charts import nice_limit
from sl_nerfstudio.evaluation.report.pictures import ColourScale
from sl_nerfstudio.meshing.vertex_quality import VertexQuality


@dataclass(frozen=True)
class ColourLayer:
    """A value of every vertex with its colours."""

    name: str
    values: Float[ndarray, "v"]
    scale: ColourScale
    units: str


def colour_layers(
    error: Float[ndarray, "v"] | None,
    error_scale: ColourScale | None,
    quality: VertexQuality | None,
    units: str,
    error_units: str,
) -> list[ColourLayer]:
    """The error, where the truth is known, and what the mesh file says of its vertices, where it does.

    Vertices that no frame confirms have no sigma and no residual: they get the colour of the worst.
    """
    layers = []
    if error is not None and error_scale is not None:
        layers.append(ColourLayer("error", error, error_scale, error_units))
    if quality is not None and (quality.views > 0).any():
        most_views = ColourScale("viridis", 0.0, float(quality.views.max()))
        layers += [
            _from_zero("uncertainty (1 sigma)", quality.sigma, units),
            ColourLayer("views", quality.views.astype(np.float64), most_views, "frames"),
            _from_zero("residual", quality.residual, "px"),
            ColourLayer("ray angle", np.nan_to_num(quality.ray_angle), _angles(quality.ray_angle), "degrees"),
        ]
    return layers


def _from_zero(name: str, values: Float[ndarray, "v"], units: str) -> ColourLayer:
    """Dark is small and good; values that are not known lie beyond the scale."""
    limit = nice_limit(float(np.nanpercentile(values, 95)))
    return ColourLayer(name, np.nan_to_num(values, nan=2 * limit), ColourScale("inferno", 0.0, limit), units)


def _angles(values: Float[ndarray, "v"]) -> ColourScale:
    return ColourScale("viridis", 0.0, nice_limit(float(np.nanpercentile(values, 95))))
