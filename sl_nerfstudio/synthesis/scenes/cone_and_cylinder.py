"""The test object of the paper: a cone and a cylinder on a thin plate, as an exact closed mesh."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from sl_nerfstudio.synthesis.scenes.scene import Scene

PLATE = (80.0, 56.0, 6.0)  # x, y, z, millimetres; its upper side is z = 6
CONE = (-20.0, 19.0, 46.0)  # x of the axis, radius at the foot, height
CYLINDER = (20.0, 14.0, 34.0)
_SEGMENTS = 1024  # a multiple of 4; the chords' sagitta is below 0.0001 mm


def cone_and_cylinder() -> Scene:
    """Closed surface of 80 x 56 x 52 mm; sharp edges, a sharp tip, flat, single-curved and occluded parts."""
    half_x, half_y = PLATE[0] / 2, PLATE[1] / 2
    builder = _Builder()
    angles = _angles(CONE[0], half_x, half_y)
    for axis_x, sign, solid in ((CONE[0], 1.0, "cone"), (CYLINDER[0], -1.0, "cylinder")):
        # mirrored angles in the right half make both halves share the points on the line x = 0
        theta = angles if sign > 0 else np.pi - angles[::-1]
        _solid_on_plate(builder, theta, axis_x, (min(0.0, sign * -half_x), max(0.0, sign * -half_x)), half_y, solid)
    _plate_sides(builder, half_x, half_y)
    vertices, faces = builder.merged()
    return Scene("cone-and-cylinder", vertices, faces, elevation_deg=(24.0, 66.0))


class _Builder:
    """Collects quads and triangles, then merges equal vertices."""

    def __init__(self) -> None:
        self.triangles: list[Float[ndarray, "n 3 3"]] = []

    def strip(self, lower: Float[ndarray, "n 3"], upper: Float[ndarray, "n 3"]) -> None:
        """Quads between two closed rings; seen from outside, `lower` runs to the right below `upper`."""
        a, b = lower, np.roll(lower, -1, axis=0)
        c, d = np.roll(upper, -1, axis=0), upper
        self.triangles += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]

    def fan(self, ring: Float[ndarray, "n 3"], centre: Float[ndarray, "3"]) -> None:
        """Triangles from a ring, counter-clockwise from outside, to a point."""
        self.triangles.append(np.stack([ring, np.roll(ring, -1, axis=0), np.broadcast_to(centre, ring.shape)], 1))

    def merged(self) -> tuple[Float[ndarray, "v 3"], Int[ndarray, "f 3"]]:
        """Vertices without duplicates, and faces without degenerate ones."""
        corners = np.concatenate(self.triangles).reshape(-1, 3)
        _, first, index = np.unique(np.round(corners, 7), axis=0, return_index=True, return_inverse=True)
        faces = index.reshape(-1, 3)
        kept = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
        return corners[first], faces[kept].astype(np.int64)


def _angles(axis_x: float, half_x: float, half_y: float) -> Float[ndarray, "n"]:
    """Even angles about the axis of the left solid, and those of the corners of the left half of the plate."""
    corners = [np.arctan2(y, x - axis_x) for x in (-half_x, 0.0) for y in (-half_y, half_y)]
    even = np.arange(_SEGMENTS) * (2 * np.pi / _SEGMENTS)
    return np.unique(np.round(np.mod(np.concatenate([even, corners]), 2 * np.pi), 12))


def _solid_on_plate(
    builder: _Builder,
    theta: Float[ndarray, "n"],
    axis_x: float,
    x_range: tuple[float, float],
    half_y: float,
    solid: str,
) -> None:
    """One half of the plate's upper side and under side, and the solid on it."""
    cos, sin, top = np.cos(theta), np.sin(theta), np.full(theta.shape, PLATE[2])
    reach_x = np.where(cos > 0, x_range[1] - axis_x, axis_x - x_range[0]) / np.maximum(np.abs(cos), 1e-12)
    reach = np.minimum(reach_x, half_y / np.maximum(np.abs(sin), 1e-12))
    rim_x = np.clip(axis_x + reach * cos, *x_range)
    rim = np.stack([rim_x, np.clip(reach * sin, -half_y, half_y), top], 1)
    _, radius, height = CONE if solid == "cone" else CYLINDER
    foot = np.stack([axis_x + radius * cos, radius * sin, top], 1)
    summit = np.array([axis_x, 0.0, PLATE[2] + height])
    builder.strip(rim, foot)
    if solid == "cone":
        builder.fan(foot, summit)
    else:
        builder.strip(foot, foot + np.array([0.0, 0.0, height]))
        builder.fan(foot + np.array([0.0, 0.0, height]), summit)
    below = rim * np.array([1.0, 1.0, 0.0])
    builder.fan(below[::-1], np.array([axis_x, 0.0, 0.0]))


def _plate_sides(builder: _Builder, half_x: float, half_y: float) -> None:
    """The four narrow sides of the plate, which share the points of the upper side's rim."""
    corners = np.concatenate(builder.triangles).reshape(-1, 3)
    on_rim = (np.isclose(np.abs(corners[:, 0]), half_x) | np.isclose(np.abs(corners[:, 1]), half_y)) & (
        corners[:, 2] == PLATE[2]
    )
    _, first = np.unique(np.round(corners[on_rim], 7), axis=0, return_index=True)
    rim = corners[on_rim][first]
    # around the rim by the angle in a square, so that corners keep their place
    rim = rim[np.argsort(np.arctan2(rim[:, 1] / half_y, rim[:, 0] / half_x))]
    builder.strip(rim * np.array([1.0, 1.0, 0.0]), rim)
