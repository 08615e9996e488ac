"""Planes grown from single points: a compiled loop over hypotheses."""

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled, compiled_range
from sl_nerfstudio.object_separation.frame_points import LEAST_COSINE, FramePoints

GROWTH = (0.2, 0.5, np.inf)  # of the radius: a plane is fitted near its seed first, and then to more and more points
FEWEST = 6  # points that a plane is fitted to


def grown_planes(
    points: FramePoints,
    normal: Float64[ndarray, "n 3"],
    seeds: Int64[ndarray, "s"],
    radius: float,
    sigmas: float,
    cosine: float,
) -> tuple[Float64[ndarray, "s 4"], Int64[ndarray, "s"]]:
    """Planes (unit normal, offset) through points along their normals, fitted to more and more points around them.

    Points within `sigmas` of a plane, whose normals' cosine is greater than `cosine`, are part of it. Returns the
    planes, and the number of points that are part of each.
    """
    planes, counts = np.zeros((len(seeds), 4)), np.zeros(len(seeds), dtype=np.int64)
    arrays = [np.ascontiguousarray(x) for x in (points.p_world, points.ray, points.sigma, normal)]
    reaches = np.array([reach * radius for reach in GROWTH])
    _grow(len(seeds), seeds, *arrays, reaches, sigmas, cosine, planes, counts)
    return planes, counts


@compiled_range
def _grow(first, last, seeds, p, ray, sigma, normal, reaches, sigmas, cosine, planes, counts):
    for k in range(first, last):
        seed, plane = seeds[k], planes[k]
        plane[:3] = normal[seed]
        plane[3] = normal[seed] @ p[seed]
        moments = np.empty((4, 4))
        for reach in reaches:
            if _moments(p, ray, sigma, normal, p[seed], reach, sigmas, cosine, plane, moments) >= FEWEST:
                _fit(moments, p[seed], plane)
        counts[k] = _moments(p, ray, sigma, normal, p[seed], np.inf, sigmas, cosine, plane, moments)


@compiled
def _moments(p, ray, sigma, normal, about, reach, sigmas, cosine, plane, moments):
    """Weighted sums of (1, x, y, z) (1, x, y, z)^T about a point, and the number of points that are part of a plane."""
    a, b, c, offset = plane
    count, here = 0, np.empty(4)
    here[0] = 1.0
    moments[:] = 0.0
    for i in range(len(p)):
        height = a * p[i, 0] + b * p[i, 1] + c * p[i, 2] - offset
        along = sigma[i] * max(abs(a * ray[i, 0] + b * ray[i, 1] + c * ray[i, 2]), LEAST_COSINE)
        if not abs(height) < sigmas * along:
            continue
        if not abs(a * normal[i, 0] + b * normal[i, 1] + c * normal[i, 2]) > cosine:
            continue
        distance = 0.0
        for j in range(3):
            here[j + 1] = p[i, j] - about[j]
            distance += here[j + 1] ** 2
        if not distance < reach * reach:
            continue
        count += 1
        for j in range(4):
            for m in range(4):
                moments[j, m] += here[j] * here[m] / along**2
    return count


@compiled
def _fit(moments, about, plane):
    """The plane of least weighted squared distances, on the same side up as before."""
    centre = moments[0, 1:] / moments[0, 0]
    spread = moments[1:, 1:] - moments[0, 0] * centre.reshape(3, 1) * centre
    axis = np.ascontiguousarray(np.linalg.eigh(spread)[1][:, 0])
    if axis @ plane[:3] < 0:
        axis = -axis
    plane[:3] = axis
    plane[3] = axis @ (centre + about)
