"""Corners of a board in the pattern: the homography of a corner's surroundings carries it into the projector.

Moreno and Taubin, "Simple, accurate, and robust projector-camera calibration" (3DIMPVT 2012): a board is flat, so
close to a corner camera and projector pixels are related by a homography, which lens distortion hardly bends there.
No pixel needs to be decoded at the corner itself, where black and white meet.
"""

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.calibration.board.detection import Corners
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA, geman_mcclure_weight

_REACH = 0.7  # half the side of a corner's surroundings, in distances to the next corner
_LEAST_REACH = 4  # camera pixels
_LEAST_PIXELS = 24
_LEAST_SPREAD = 0.25  # of the surroundings: the smaller axis of the pixels used, as a standard deviation
_ROUNDS = 3  # of reweighting
_KERNEL = 3.0  # robust standard deviations


def corners_in_pattern(corners: Corners, coords: Float32[ndarray, "h w 2"]) -> Corners:
    """The corners whose surroundings are decoded, in pattern pixels. `coords` is NaN where nothing is decoded."""
    distance = KDTree(corners.uv).query(corners.uv, k=2)[0][:, 1]
    found = [_carried(uv, reach, coords) for uv, reach in zip(corners.uv, _REACH * distance, strict=True)]
    known = np.array([uv is not None for uv in found], dtype=bool)
    uv = np.array([uv for uv in found if uv is not None], dtype=np.float64).reshape(-1, 2)
    return Corners(corners.ids[known], uv)


def _carried(
    corner: Float64[ndarray, "2"], reach: float, coords: Float32[ndarray, "h w 2"]
) -> Float64[ndarray, "2"] | None:
    reach = max(reach, _LEAST_REACH)
    h, w = coords.shape[:2]
    left, top = (max(0, int(c - reach)) for c in corner)
    right, bottom = min(w, int(corner[0] + reach) + 1), min(h, int(corner[1] + reach) + 1)
    part = coords[top:bottom, left:right]
    rows, columns = np.nonzero(np.isfinite(part).all(-1))
    if len(rows) < _LEAST_PIXELS:
        return None
    xy = (np.stack([columns + left, rows + top], -1) + 0.5 - corner) / reach
    if np.sqrt(np.linalg.eigvalsh(np.cov(xy.T))[0]) < _LEAST_SPREAD:
        return None  # to one side of the corner only, from where it would be extrapolated
    return _at_origin(xy, part[rows, columns].astype(np.float64))


def _at_origin(xy: Float64[ndarray, "n 2"], uv: Float64[ndarray, "n 2"]) -> Float64[ndarray, "2"] | None:
    """Where a robustly fitted homography from `xy` to `uv` puts (0, 0); None where there is none."""
    middle = np.median(uv, axis=0)
    size = max(float(np.abs(uv - middle).max()), 1e-6)
    target = (uv - middle) / size
    weight = np.ones(len(xy))
    for _ in range(_ROUNDS):
        h = _homography(xy, target, weight)
        if h is None:
            return None
        mapped = np.c_[xy, np.ones(len(xy))] @ h.T
        if (mapped[:, 2] <= 0).any():
            return None
        miss = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - target, axis=1)
        scale = max(MAD_TO_SIGMA * float(np.median(miss)), 1e-9)
        weight = geman_mcclure_weight((miss / (_KERNEL * scale)) ** 2)
    return h[:2, 2] * size + middle


def _homography(
    xy: Float64[ndarray, "n 2"], uv: Float64[ndarray, "n 2"], weight: Float64[ndarray, "n"]
) -> Float64[ndarray, "3 3"] | None:
    """By least squares, with 1 in the last place: the origin, where it is looked up, is never at infinity."""
    x, y = xy.T
    o, one = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, o, o, o, -uv[:, 0] * x, -uv[:, 0] * y], -1),
            np.stack([o, o, o, x, y, one, -uv[:, 1] * x, -uv[:, 1] * y], -1),
        ]
    )
    w = np.tile(weight, 2)
    normal = (rows * w[:, None]).T @ rows
    if np.linalg.cond(normal) > 1e12:
        return None
    return np.append(np.linalg.solve(normal, (rows * w[:, None]).T @ uv.T.ravel()), 1.0).reshape(3, 3)
