"""From where to look at a scene: beside the first camera, and far enough away to see everything."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

_BESIDE, _ABOVE, _STEEPEST = 0.35, 0.3, 1.2  # radian


@dataclass(frozen=True)
class Viewpoint:
    """An eye, the point it looks at, and what is upwards for it."""

    eye: Float64[ndarray, "3"]
    centre: Float64[ndarray, "3"]
    up: Float64[ndarray, "3"]


def beside(towards: Float64[ndarray, "3"], up: Float64[ndarray, "3"]) -> Float64[ndarray, "3"]:
    """A unit direction a little beside `towards`, and nearer to `up`; both directions lead away from the object."""
    z = up / np.linalg.norm(up)
    level = towards - (towards @ z) * z
    if np.linalg.norm(level) < 1e-6 * np.linalg.norm(towards):  # straight above: any horizontal direction will do
        level = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x = level / np.linalg.norm(level)
    elevation = math.asin(max(-1.0, min(1.0, float(towards @ z) / float(np.linalg.norm(towards)))))
    elevation = min(elevation + _ABOVE, _STEEPEST)
    turned = math.cos(_BESIDE) * x + math.sin(_BESIDE) * np.cross(z, x)
    return math.cos(elevation) * turned + math.sin(elevation) * z


def far_enough(
    points: Float64[ndarray, "n 3"],
    centre: Float64[ndarray, "3"],
    direction: Float64[ndarray, "3"],
    up: Float64[ndarray, "3"],
    vertical_fov: float,
    aspect: float,
    margin: float = 1.1,
) -> Viewpoint:
    """The nearest eye in `direction` (unit) from `centre` that sees all points, with a margin around them.

    `vertical_fov` is in radian, `aspect` is width by height of the picture. Points that are not finite do not count.
    """
    offset = points[np.isfinite(points).all(1)] - centre
    right = np.cross(up, direction)
    right = right / np.linalg.norm(right)
    across, along = np.abs(offset @ right), offset @ direction
    upwards = np.abs(offset @ np.cross(direction, right))
    tangent = math.tan(vertical_fov / 2)
    needed = along + margin * np.maximum(across / (tangent * aspect), upwards / tangent)
    distance = float(needed.max()) if len(needed) else 1.0
    return Viewpoint(centre + distance * direction, centre, up)
