"""What is known about each vertex of a mesh."""

from dataclasses import dataclass

from jaxtyping import Float64, Int64
from numpy import ndarray


@dataclass(frozen=True)
class VertexQuality:
    """Quality of every vertex; lengths in the scan's unit. NaN where no frame confirms the vertex."""

    sigma: Float64[ndarray, "v"]  # 1 sigma along the normal
    sigma_independent: Float64[ndarray, "v"]  # the part that distant vertices do not share
    views: Int64[ndarray, "v"]  # frames that saw, lit and confirmed it; 0: invented or interpolated surface
    residual: Float64[ndarray, "v"]  # mean distance of predicted and decoded coordinates, projector pixels
    ray_angle: Float64[ndarray, "v"]  # largest angle between camera ray and projector ray, degrees
