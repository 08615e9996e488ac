"""A medal that lies on its back, 96 x 96 x 7 mm: nearly flat, with a rim, a profile, letters and rays in relief."""

import math

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.synthesis.scenes.scene import Scene
from sl_nerfstudio.synthesis.scenes.sdf import (
    Field,
    Triple,
    capsule,
    carve,
    cylinder,
    ellipsoid,
    half_space,
    mesh_of,
    union,
)

_RADIUS = 48.0
_TOP = 4.0  # of the field between the raised parts


def medal(cell: float = 0.6) -> Scene:
    """Lies on z = 0, the top of the picture towards +y; a mesh with edges about `cell` long."""
    disc = cylinder((0, 0, 0), (0, 0, _TOP), _RADIUS, 0.6)
    relief = union(1.0, disc, _rim(), _bird(), *_rays(), *_marks())
    solid = carve(0.0, relief, half_space((0, 0, 1), 0.0))
    return mesh_of("medal", solid, (-52, -52, -4), (52, 52, 12), cell, elevation_deg=(36.0, 74.0))


def _rim() -> Field:
    """A round bead near the edge."""
    bead = 1.9

    def field(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        out = np.hypot(p[:, 0], p[:, 1]) - (_RADIUS - 2.6)
        return np.hypot(out, p[:, 2] - _TOP) - bead

    return field


def _bird() -> Field:
    """A bird with one raised wing, flattened."""
    z = _TOP
    body = ellipsoid((-2, -3, z), (17, 9, 3.4), (0, 0, 18))
    head = ellipsoid((14, 8, z), (6.5, 6, 3.4))
    beak = capsule((19, 9, z), (26, 7, z), 2.2, 0.7)
    tail = union(0.8, *[capsule((-14, -8, z), (-31, y, z), 2.6, 1.6) for y in (-20.0, -14.0, -8.0)])
    feathers = [capsule((0, 0, z), tip, 3.4, 1.2) for tip in ((-22, 25, z), (-14, 29, z), (-5, 31, z), (4, 29, z))]
    return union(1.5, body, head, beak, tail, *feathers, ellipsoid((15.5, 9.5, z + 3), (1.3, 1.3, 0.9)))


def _rays() -> list[Field]:
    """Rays of a sun at the right."""
    out = []
    for k in range(7):
        angle = float(np.radians(-60 + 22 * k))
        out.append(capsule(_at(28.0, angle), _at(38.0, angle), 1.4, 0.8))
    return out


def _marks() -> list[Field]:
    """Strokes like letters along the lower edge, no two alike."""
    rng = np.random.default_rng(7)
    out = []
    for k in range(9):
        angle = np.radians(208 + 14 * k)
        u, v = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
        for _ in range(2):
            ends = [37.5 * v + rng.uniform(-2.8, 2.8) * u + h * v for h in (-3.2, 3.2)]
            a, b = ((float(e[0]), float(e[1]), _TOP + 0.2) for e in ends)
            out.append(capsule(a, b, 1.0, 1.0))
    return out


def _at(radius: float, angle: float) -> Triple:
    """A point around the bird's neck, on the medal's field."""
    return 1.0 + radius * math.cos(angle), -2.0 + radius * math.sin(angle), _TOP
