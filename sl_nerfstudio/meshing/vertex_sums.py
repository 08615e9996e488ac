"""What all frames say of every vertex of a mesh, added up frame by frame: memory does not depend on their number."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8
from numpy import ndarray

from sl_nerfstudio.meshing.vertex_views import FrameViews, correlation_of


@dataclass(frozen=True)
class VertexSums:
    """Sums over the frames that confirm each vertex."""

    number: Int64[ndarray, "v"]  # of the frames
    distance: Float[ndarray, "v"]  # lengths of the residuals, projector pixels
    ray_angle: Float[ndarray, "v"]  # the largest, radian; NaN without a frame
    weight: Float[ndarray, "v"]  # pixels per area, times the square of their residuals' slope along the normal
    variance: Float[ndarray, "v"]  # the same times the variance of a pixel's coordinate
    pull: Float[ndarray, "v"]  # pixels per area times slope times residual
    correlation: float  # how many neighbouring pixels share an error: 1 if their errors are independent
    bits: UInt8[ndarray, "frames eighth"]  # which frames confirm which vertices, eight in a byte

    def confirmed(self, vertices: Int64[ndarray, "n"]) -> Bool[ndarray, "n frames"]:
        """Which frames confirm some vertices."""
        return (self.bits[:, vertices // 8].T >> (7 - vertices % 8)[:, None]) & 1 > 0


def sum_views(views: Iterable[FrameViews], vertices: int) -> VertexSums:
    """Of a mesh with a number of vertices, from the views of all frames in order."""
    number, (distance, weight, variance, unknown, pull) = np.zeros(vertices, dtype=np.int64), np.zeros((5, vertices))
    ray_angle, noises, ratios, bits = np.full(vertices, np.nan), [], [], []
    for one in views:
        v = one.vertex
        number[v] += 1
        distance[v] += np.linalg.norm(one.residual, axis=1)
        ray_angle[v] = np.fmax(ray_angle[v], one.ray_angle)
        mine = one.pixels_per_area * (one.slope**2).sum(1)
        weight[v] += mine
        pull[v] += one.pixels_per_area * (one.slope * one.residual).sum(1)
        if np.isfinite(one.noise_px):
            variance[v] += mine * one.noise_px**2
        else:
            unknown[v] += mine
        noises.append(one.noise_px)
        ratios.append(one.window_ratio)
        mask = np.zeros(vertices, dtype=bool)
        mask[v] = True
        bits.append(np.packbits(mask))
    if unknown.any():  # a frame that confirms too few vertices has the noise of the others
        variance += unknown * (np.nanmedian(noises) ** 2 if np.isfinite(noises).any() else np.nan)
    return VertexSums(
        number,
        distance,
        ray_angle,
        weight,
        variance,
        pull,
        correlation_of(ratios),
        np.stack(bits),
    )
