"""Scenes: built-in objects by name, and mesh files."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.synthesis.parts import PARTS
from sl_nerfstudio.synthesis.sdf import (
    Field,
    Scene,
    Triple,
    block,
    capsule,
    carve,
    cylinder,
    ellipsoid,
    half_space,
    mesh_of,
    mirrored,
    ridges,
    union,
)

# Triangle meshes as binary PLY.


def encode_ply(vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "f 3"]) -> bytes:
    """A binary little-endian PLY file with vertices in double precision."""
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    records = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    records["count"], records["corners"] = 3, faces
    return head.encode() + vertices.astype("<f8").tobytes() + records.tobytes()


# A chair of rods, about 62 x 66 x 116 mm: legs, rungs and spindles that are a few millimetres thin.

_SEAT = 54.0  # height of the seat's rods


def chair(cell: float = 0.7) -> Scene:
    """Faces +y and stands on z = 0; a mesh with edges about `cell` long."""
    solid = carve(0.0, union(0.8, mirrored(_side()), _across(), _seat(), _back()), half_space((0, 0, 1), 0.0))
    return mesh_of("chair", solid, (-40, -50, -3), (40, 40, 124), cell, elevation_deg=(14.0, 60.0))


def _side() -> Field:
    """Legs, the post of the back, and the rungs between them, on one side."""
    front = capsule((27, 28, -4), (25, 25, _SEAT), 3.4, 4.0)
    rear = union(
        2.0, capsule((27, -34, -4), (25, -24, _SEAT), 3.4, 4.0), capsule((25, -24, _SEAT), (24, -37, 112), 4.0, 3.2)
    )
    rungs = capsule((26.5, 27.5, 18), (26.5, -31, 18), 2.4, 2.4), capsule((26, 26, 36), (26, -27, 36), 2.4, 2.4)
    rail = capsule((25, 25, _SEAT), (25, -24, _SEAT), 4.0, 4.0)
    return union(1.5, front, rear, rail, *rungs)


def _across() -> Field:
    """Rungs from the left to the right."""
    ends: tuple[tuple[Triple, float], ...] = (
        ((26, 25, _SEAT), 4.0),
        ((26, -24, _SEAT), 4.0),
        ((27, 27, 24), 2.4),
        ((27, -30, 24), 2.4),
    )
    return union(1.0, *[capsule((-x, y, z), (x, y, z), r, r) for (x, y, z), r in ends])


def _seat() -> Field:
    """Slats from front to back, with gaps."""
    return union(
        0.0, *[capsule((x, 25, _SEAT + 1), (x, -24, _SEAT + 1), 2.9, 2.9) for x in (-16.5, -8.2, 0, 8.2, 16.5)]
    )


def _back() -> Field:
    """Spindles that lean backwards, and a bent rail above them."""
    spindles = [
        capsule((0.8 * x, -24, _SEAT), (x, -36.5 - abs(x) / 30, 106), 2.2, 2.0) for x in (-15.0, -5.0, 5.0, 15.0)
    ]
    middle = (0.0, -40.0, 112.0)
    rail = union(2.0, *[capsule((24.0 * side, -37, 111), middle, 4.2, 5.0) for side in (-1, 1)])
    return union(1.0, rail, *spindles)


# The test object of the paper: a cone and a cylinder on a thin plate, as an exact closed mesh.

PLATE = (80.0, 56.0, 6.0)  # x, y, z, millimetres; its upper side is z = 6
CONE = (-20.0, 19.0, 46.0)  # x of the axis, radius at the foot, height
CYLINDER = (20.0, 14.0, 34.0)
_CONE_SEGMENTS = 1024  # a multiple of 4; the chords' sagitta is below 0.0001 mm


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
    even = np.arange(_CONE_SEGMENTS) * (2 * np.pi / _CONE_SEGMENTS)
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


# A standing dog, about 40 x 135 x 105 mm: four legs apart, ears, a raised tail.


def dog(cell: float = 0.8) -> Scene:
    """Looks along +y and stands on z = 0; a mesh with edges about `cell` long."""
    trunk = union(
        12.0,
        ellipsoid((0, 20, 62), (17, 24, 19), (12, 0, 0)),  # chest
        ellipsoid((0, -18, 62), (14, 26, 14.5), (-4, 0, 0)),
        ellipsoid((0, -36, 60), (15, 15, 16)),
    )
    trunk = ridges(trunk, 0.35, lambda p: 0.9 * p[:, 1] + 0.7 * p[:, 2])  # fur
    neck = capsule((0, 30, 70), (0, 45, 90), 12.5, 9.5)
    tail = union(3.0, capsule((0, -48, 66), (3, -62, 80), 4.6, 3.6), capsule((3, -62, 80), (7, -64, 98), 3.6, 2.4))
    legs = union(
        3.0, _dog_fore_leg(5.0, 1.0), _dog_fore_leg(-4.0, -1.0), _dog_hind_leg(-3.0, 1.0), _dog_hind_leg(6.0, -1.0)
    )
    whole = union(2.0, union(6.0, trunk, neck), _head(), tail)
    solid = carve(0.0, union(5.0, whole, legs), half_space((0, 0, 1), 0.0))
    return mesh_of("dog", solid, (-34, -78, -4), (34, 88, 120), cell, elevation_deg=(10.0, 55.0))


def _head() -> Field:
    """Skull, muzzle, nose, eyes and hanging ears."""
    skull = union(5.0, ellipsoid((0, 50, 96), (12.5, 14, 12)), ellipsoid((0, 65, 90), (7.5, 14, 7.5), (-8, 0, 0)))
    nose = ellipsoid((0, 77.5, 93), (3.4, 3.2, 2.8))
    mouth = ellipsoid((0, 71, 86.6), (9, 9, 0.9), (-8, 0, 0))
    sockets = mirrored(ellipsoid((6.6, 59.5, 99.5), (3.2, 3.2, 3.0)))
    eyes = mirrored(ellipsoid((6.2, 58.2, 99.2), (2.6, 2.6, 2.6)))
    ears = mirrored(
        union(2.0, ellipsoid((12.5, 46, 99), (3.2, 7.5, 8), (0, 20, 0)), ellipsoid((15.5, 47, 88), (2.6, 7.5, 11)))
    )
    return union(1.0, carve(0.8, skull, mouth, sockets), nose, eyes, ears)


def _dog_fore_leg(forward: float, side: float) -> Field:
    x = 10.5 * side
    upper = capsule((x, 27, 52), (x, 24 + forward, 30), 7.4, 5.0)
    lower = capsule((x, 24 + forward, 30), (x, 26 + 1.4 * forward, 4), 4.8, 3.6)
    return union(2.5, upper, lower, ellipsoid((x, 30 + 1.4 * forward, 3), (5.2, 7.5, 4.2)))


def _dog_hind_leg(forward: float, side: float) -> Field:
    x = 9.5 * side
    thigh = ellipsoid((x, -38 + 0.4 * forward, 46), (7.5, 12, 17), (14, 0, 0))
    shank = capsule((x, -33 + forward, 36), (x, -49 + forward, 23), 6.0, 4.0)
    hock = capsule((x, -49 + forward, 23), (x, -45 + forward, 4), 4.0, 3.4)
    return union(2.5, thigh, shank, hock, ellipsoid((x, -41 + forward, 3), (5.0, 7.5, 4.0)))


# A sitting frog, about 120 x 99 x 68 mm: thin legs, deep folds, many parts that hide others.


def frog(cell: float = 0.8) -> Scene:
    """Looks along +y and stands on z = 0; a mesh with edges about `cell` long."""
    body = union(
        14.0,
        ellipsoid((0, -14, 30), (28, 36, 21), (22, 0, 0)),
        ellipsoid((0, 12, 40), (27, 27, 19), (14, 0, 0)),
        ellipsoid((0, 32, 45), (24, 19, 13), (-6, 0, 0)),  # snout
        ellipsoid((0, 22, 27), (21, 21, 17)),  # throat
    )
    folds = capsule((11, 22, 59.5), (15, -14, 51), 2.0, 1.8), capsule((15, -14, 51), (11, -42, 26), 1.8, 1.2)
    ridges = mirrored(union(3.0, *folds))
    warts = mirrored(union(0.0, *[ellipsoid(c, (r, r, r)) for c, r in _WARTS]))
    body = union(1.5, union(2.0, body, ridges), warts)
    mouth = ellipsoid((0, 38, 42.5), (31, 24, 1.3), (-7, 0, 0))
    nostrils = mirrored(ellipsoid((5.5, 48.5, 52), (1.7, 1.9, 1.9)))
    body = carve(0.8, body, mouth, nostrils)
    pupil = ellipsoid((25, 29.5, 62), (3.4, 5.0, 1.6), (0, 0, 25))
    eyes = mirrored(carve(0.6, ellipsoid((16.5, 25, 60), (9, 9, 8.5)), pupil))
    body = union(2.0, body, eyes)
    hind = mirrored(_frog_hind_leg())
    fore = mirrored(_frog_fore_leg())
    whole = union(3.5, union(2.5, body, hind), fore)
    solid = carve(0.0, whole, half_space((0, 0, 1), 0.0))
    return mesh_of("frog", solid, (-64, -66, -4), (64, 66, 80), cell, elevation_deg=(12.0, 64.0))


_WARTS = [
    ((6, -2, 57.5), 2.2),
    ((19, 2, 53.5), 2.0),
    ((5.5, -22, 49.5), 2.4),
    ((21, -22, 43), 2.2),
    ((7, -36, 38), 2.0),
    ((24, 6, 44), 1.8),
]


def _frog_hind_leg() -> Field:
    thigh = ellipsoid((32, -16, 21), (11, 26, 15), (-24, -8, 16))
    shank = capsule((42, 4, 16), (33, -38, 7), 7.0, 5.5)
    foot = capsule((34, -38, 4.5), (46, -8, 2.5), 5.0, 4.0)
    toes = _toes((46, -10, 2.5), ((42, 16, 1.8), (50, 18, 1.8), (57, 12, 1.8)))
    return union(1.5, thigh, shank, union(3.0, foot, *toes))


def _frog_fore_leg() -> Field:
    upper = capsule((23, 14, 30), (33, 16, 14), 7.0, 5.5)
    lower = capsule((33, 16, 14), (25, 33, 4), 5.2, 4.2)
    fingers = _toes((25, 33, 3.2), ((17, 44, 1.8), (25, 47, 1.8), (33, 44, 1.8), (36, 36, 1.8)))
    return union(2.0, upper, lower, *fingers)


def _toes(start: Triple, tips: tuple[Triple, ...]) -> list[Field]:
    """Thin toes with round pads."""
    return [union(1.0, capsule(start, tip, 2.8, 1.9), ellipsoid(tip, (3.2, 3.2, 2.4))) for tip in tips]


# A head with neck, about 147 x 195 x 201 mm: large smooth parts with small features.


def head(cell: float = 1.25) -> Scene:
    """Looks along +y and stands on z = 0; a mesh with edges about `cell` long."""
    skull = union(
        26.0,
        ellipsoid((0, -10, 132), (62, 74, 60)),
        ellipsoid((0, 24, 88), (45, 44, 52)),
        ellipsoid((0, 44, 52), (23, 21, 19)),  # chin
    )
    neck = capsule((0, -16, -14), (0, -12, 70), 41, 37)
    brow = mirrored(capsule((9, 62, 122), (38, 49, 121), 7.5, 6.0))
    cheek = mirrored(ellipsoid((31, 48, 86), (15, 14, 14)))
    nose = union(6.0, capsule((0, 63, 118), (0, 81, 91), 5.5, 8.0), mirrored(ellipsoid((8.5, 71, 88), (6.5, 8.5, 6))))
    lips = union(1.5, ellipsoid((0, 64, 69.5), (18, 7.5, 4.6)), ellipsoid((0, 64.5, 62), (15, 7.5, 5.2)))
    body = union(9.0, union(16.0, skull, neck), brow, cheek, nose)
    body = union(3.0, body, lips)
    sockets = mirrored(ellipsoid((23, 66, 108), (14.5, 13, 9.5)))
    eyes = mirrored(ellipsoid((22.5, 52.5, 107.5), (11.5, 10.5, 10.5)))
    lids = mirrored(ellipsoid((22.5, 60.5, 107), (10, 9, 2.0)))
    mouth = ellipsoid((0, 71, 66), (21, 7, 1.7))
    nostrils = mirrored(ellipsoid((6.5, 77, 83), (3, 5, 4)))
    face = carve(7.0, body, sockets)
    face = union(1.2, face, carve(0.8, eyes, lids))
    face = carve(1.0, face, mouth, nostrils)
    ear = carve(
        2.0, ellipsoid((65, -8, 106), (7.5, 19, 29), (0, 0, -22)), ellipsoid((73, -3, 109), (7.5, 12, 20), (0, 0, -22))
    )
    cap = ridges(ellipsoid((0, -16, 137), (68.5, 79.5, 64)), 1.3, _strands)
    hair = carve(1.0, cap, half_space((0, -0.79, 0.613), 57.0))
    knot = ridges(ellipsoid((14, -86, 158), (22, 19, 21)), 0.9, lambda p: 0.75 * (p[:, 0] + 0.6 * p[:, 2]))
    whole = union(2.5, union(0.5, face, union(2.0, hair, knot)), mirrored(ear))
    solid = carve(0.0, whole, half_space((0, 0, 1), 0.0))
    return mesh_of("head", solid, (-86, -116, -6), (86, 96, 212), cell, elevation_deg=(4.0, 58.0))


def _strands(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Hair combed from the forehead to the back, in waves."""
    return 26.0 * np.arctan2(p[:, 0], np.maximum(p[:, 2] - 70.0, 5.0)) + 1.2 * np.sin(0.055 * p[:, 1])


# A fallen leaf, about 84 x 130 x 38 mm: a thin curved sheet with veins, on a stalk.

_HALF_THICKNESS = 1.1  # millimetres
_LENGTH = 118.0
_SLOPE = 1.25  # about the largest length of the gradient of height and veins: keeps values below distances


def leaf(cell: float = 0.65) -> Scene:
    """Lies on z = 0 with its tip towards +y, upper side up; a mesh with edges about `cell` long."""
    tail = _height(np.array([[0.0, -_LENGTH / 2 + 3, 0.0]]))[0]
    stalk = capsule((0, -_LENGTH / 2 + 4, tail), (9, -_LENGTH / 2 - 17, tail + 10.0), 1.7, 2.3)
    found = mesh_of("leaf", union(1.5, _blade(), stalk), (-50, -84, -16), (50, 66, 36), cell, (28.0, 72.0))
    return replace(found, vertices=found.vertices - [0.0, 0.0, found.vertices[:, 2].min()])


def _blade() -> Field:
    """The sheet around `_height`, thicker along the veins, cut to the leaf's outline."""

    def field(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        sheet = (np.abs(p[:, 2] - _height(p)) - _HALF_THICKNESS - _veins(p)) / _SLOPE
        outline = _leaf_outline(p)
        # rounded rim: the larger of both values, as a length where both are positive
        outside = np.maximum(sheet, 0) ** 2 + np.maximum(outline, 0) ** 2
        return np.minimum(np.maximum(sheet, outline), 0) + np.sqrt(outside)

    return field


def _height(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Middle of the sheet: a keel along the midrib, an arch from stalk to tip, a curled side, a wavy rim."""
    x, y = p[:, 0], p[:, 1]
    arch = 13.0 * np.cos(np.clip(np.pi * y / 130.0, -2, 2))
    keel = 0.22 * (np.sqrt(x**2 + 36.0) - 6.0)
    curl = 0.0058 * np.maximum(x - 8.0, 0) ** 2
    return arch + keel + curl + 1.3 * np.sin(0.17 * y + 0.6 * np.sign(x)) * np.clip(np.abs(x) / 34.0, 0, 1) ** 2


def _half_width(y: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Half width of the outline: widest behind the middle, with a drawn-out tip and coarse teeth."""
    t = np.clip((y + _LENGTH / 2) / _LENGTH, 0.0, 1.0)
    smooth = 42.0 * np.sqrt(np.clip(np.sin(np.pi * t**0.8), 0, None)) * (1.12 - 0.55 * t)
    return smooth * (1 + 0.05 * np.sin(2 * np.pi * 9 * t))


def _leaf_outline(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Distance outside the outline, roughly; negative inside."""
    beyond = np.abs(p[:, 1]) - _LENGTH / 2
    return np.maximum((np.abs(p[:, 0]) - _half_width(p[:, 1])) / 1.6, beyond)


def _veins(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Extra thickness along the midrib and the side veins that leave it obliquely."""
    x, y = np.abs(p[:, 0]), p[:, 1]
    midrib = 1.2 * np.exp(-((x / 2.2) ** 2))
    along = (y - 0.75 * x) / 13.0
    side = 0.5 * np.exp(-(((along - np.round(along)) * 13.0 / 1.5) ** 2)) * np.clip(x / 4.0, 0, 1)
    return midrib + side


# A medal that lies on its back, 96 x 96 x 7 mm: nearly flat, with a rim, a profile, letters and rays in relief.

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


# A vase, 84 x 84 x 129 mm: an exact surface of revolution, hollow, with nothing that tells one side from another.

_VASE_SEGMENTS = 720  # around the axis
_STEPS = 320  # along the outside
_WALL = 3.2  # thickness, millimetres
_FLOOR = 5.0  # height of the inner floor
_EDGE = 1.5  # width over which the shading turns from the wall to foot and floor
_PROFILE = (  # height and radius of the outside
    (0.0, 24.0),
    (6.0, 25.0),
    (14.0, 27.0),
    (46.0, 42.0),
    (76.0, 31.0),
    (100.0, 15.0),
    (112.0, 16.5),
    (126.0, 25.0),
)


def vase() -> Scene:
    """Stands on z = 0 about the z axis; the normals are those of the curved profile."""
    r, z, normal_r, normal_z = _vase_outline()
    theta = 2 * np.pi * np.arange(_VASE_SEGMENTS) / _VASE_SEGMENTS
    c, s = np.cos(theta), np.sin(theta)
    rings = np.stack([r[:, None] * c, r[:, None] * s, np.broadcast_to(z[:, None], (len(z), _VASE_SEGMENTS))], -1)
    normals = np.stack(
        [normal_r[:, None] * c, normal_r[:, None] * s, np.broadcast_to(normal_z[:, None], (len(z), _VASE_SEGMENTS))], -1
    )
    poles = np.array([[0.0, 0.0, z[0]], [0.0, 0.0, z[-1]]])  # middle of the foot and of the inner floor
    vertices = np.concatenate([rings.reshape(-1, 3), poles])
    pole_normals = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    return Scene(
        "vase",
        vertices,
        _faces(len(r)),
        np.concatenate([normals.reshape(-1, 3), pole_normals]),
        elevation_deg=(16.0, 58.0),
    )


def _vase_outline() -> tuple[Float[ndarray, "k"], Float[ndarray, "k"], Float[ndarray, "k"], Float[ndarray, "k"]]:
    """Radius, height and normal (r, z) along the profile: foot, outside, round lip, inside, floor."""
    height, radius = np.array(_PROFILE).T
    curve = PchipInterpolator(height, radius)
    slope = curve.derivative()
    z = np.linspace(0.0, height[-1], _STEPS)
    r, dr = curve(z), slope(z)
    length = np.sqrt(1 + dr**2)
    outer = np.stack([r, z, 1 / length, -dr / length], 1)
    inner = outer[z >= _FLOOR][::-1] * [1, 1, -1, -1]
    inner[:, :2] += _WALL * inner[:, 2:]
    # a half circle from the outer to the inner side
    start = np.arctan2(outer[-1, 3], outer[-1, 2])
    turn = start + np.pi * np.linspace(0, 1, 18)[1:-1]
    ray = np.stack([np.cos(turn), np.sin(turn)], 1)
    lip = np.concatenate([outer[-1, :2] - _WALL / 2 * outer[-1, 2:] + _WALL / 2 * ray, ray], 1)
    foot = np.array([[r[0] - _EDGE, 0.0, 0.0, -1.0]])
    floor = np.array([[inner[-1, 0] - _EDGE, inner[-1, 1], 0.0, 1.0]])
    r, z, normal_r, normal_z = np.concatenate([foot, outer, lip, inner, floor]).T
    return r, z, normal_r, normal_z


def _faces(rings: int) -> Int[ndarray, "f 3"]:
    """Quads between neighbouring rings, and fans at both ends."""
    j = np.arange(_VASE_SEGMENTS)
    k = (j + 1) % _VASE_SEGMENTS
    out = []
    for i in range(rings - 1):
        a, b = i * _VASE_SEGMENTS, (i + 1) * _VASE_SEGMENTS
        out += [np.stack([a + j, a + k, b + k], 1), np.stack([a + j, b + k, b + j], 1)]
    foot, floor = rings * _VASE_SEGMENTS, rings * _VASE_SEGMENTS + 1
    last = (rings - 1) * _VASE_SEGMENTS
    out += [np.stack([np.full_like(j, foot), k, j], 1), np.stack([np.full_like(j, floor), last + j, last + k], 1)]
    return np.concatenate(out)


# Objects whose geometry hardly determines some motions of a frame: the hard cases of registration and adjustment.
#
# A frame may slide along planes, turn about an axis of revolution or about a sphere's centre, at hardly any cost. Each
# object has a little that prevents it.

_FROM_ABOVE = (45.0, 78.0)  # degrees: planes that lie down are seen from above


def staircase(cell: float = 1.0) -> Scene:
    """Five steps, 90 x 60 x 40 mm: parallel planes at five heights, and risers."""
    steps = [block((18.0 * k - 45, -30, 0), (45, 30, 8.0 * k + 8)) for k in range(5)]
    return mesh_of("staircase", union(0.0, *steps), (-50, -35, -4), (50, 35, 45), cell, _FROM_ABOVE)


def bottle(cell: float = 1.2) -> Scene:
    """An object of revolution, 60 x 60 x 124 mm; only its small spout shows how it is turned."""
    belly = ellipsoid((0, 0, 38), (30, 30, 42))
    neck = cylinder((0, 0, 60), (0, 0, 114), 11, 2)
    lip = cylinder((0, 0, 110), (0, 0, 122), 15, 3)
    spout = capsule((12, 0, 117), (19, 0, 119), 3, 2)
    solid = carve(0.0, union(12.0, belly, neck, lip, spout), half_space((0, 0, 1), 0.0))
    return mesh_of("bottle", solid, (-36, -36, -5), (36, 36, 128), cell)


def spheres(cell: float = 1.2) -> Scene:
    """Two spheres of different size that touch, 92 x 60 x 60 mm: one axis of revolution is left."""
    both = union(2.0, ellipsoid((-16, 0, 30), (30, 30, 30)), ellipsoid((28, 0, 18), (18, 18, 18)))
    return mesh_of("spheres", both, (-52, -36, -5), (52, 36, 66), cell)


def bump(cell: float = 1.0) -> Scene:
    """A plate of 100 x 80 x 5 mm with one bump, 7 mm higher."""
    plate = block((-50, -40, 0), (50, 40, 5))
    solid = union(6.0, plate, ellipsoid((14, -9, 5), (17, 12, 7)))
    flat = carve(0.0, solid, half_space((0, 0, 1), 0.0))
    return mesh_of("bump", flat, (-55, -45, -4), (55, 45, 16), cell, _FROM_ABOVE)


def relief(cell: float = 1.0) -> Scene:
    """A wall that lies on its back, 120 x 90 x 8 mm, with shallow strokes and domes."""
    rng = np.random.default_rng(11)
    marks: list[Field] = []
    for _ in range(9):
        x, y = (float(v) for v in rng.uniform((-48, -33), (48, 33)))
        a = float(rng.uniform(0, 2 * np.pi))
        end = (x + 12 * float(np.cos(a)), y + 10 * float(np.sin(a)), 5.0)
        marks.append(capsule((x, y, 5.0), end, 2.2, 1.4))
    domes = [ellipsoid((x, y, 5), (9, 9, 2.5)) for x, y in ((-30, 18), (8, -20), (36, 12))]
    solid = union(1.5, block((-60, -45, 0), (60, 45, 5)), *marks, *domes)
    flat = carve(0.0, solid, half_space((0, 0, 1), 0.0))
    return mesh_of("relief", flat, (-65, -50, -4), (65, 50, 13), cell, _FROM_ABOVE)


def rod(cell: float = 1.0) -> Scene:
    """A long thin rod, 158 x 13 x 14 mm, with two collars and a bent end."""
    shaft = capsule((-74, 0, 6.5), (60, 0, 6.5), 5, 5)
    end = capsule((60, 0, 6.5), (76, 3, 10.5), 5, 3.5)
    collars = [cylinder((x, 0, 6.5), (x + 5, 0, 6.5), 6.5, 1.5) for x in (-40, 15)]
    return mesh_of("rod", union(2.0, shaft, end, *collars), (-85, -12, -5), (85, 14, 20), cell)


_SHAPE = 12  # stream of random numbers: the others are those of `synthesise`
MESH_FORMATS = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
BUILT_IN: dict[str, Callable[[], Scene]] = {
    "cone-and-cylinder": cone_and_cylinder,
    "head": head,
    "frog": frog,
    "chair": chair,
    "leaf": leaf,
    "dog": dog,
    "vase": vase,
    "medal": medal,
    "staircase": staircase,
    "bottle": bottle,
    "spheres": spheres,
    "bump": bump,
    "relief": relief,
    "rod": rod,
}


def make_scene(name: str, file_unit: float = 1.0, seed: int = 0) -> Scene:
    """A built-in scene, the part of a kind that `seed` stands for, or the mesh in a file of unit `file_unit` mm.

    Raises UserError for a name that is none of these.
    """
    if name in BUILT_IN:
        return _built_in(name)
    if name in PARTS:
        return _built_in(name, seed)
    path = Path(name)
    if path.suffix.lower() not in MESH_FORMATS:
        raise UserError(
            f"--scene {name}: neither a built-in scene ({', '.join((*BUILT_IN, *PARTS))}) "
            f"nor a mesh file ({' '.join(MESH_FORMATS)})"
        )
    return _read_mesh(path, file_unit)


@cache
def _built_in(name: str, seed: int | None = None) -> Scene:
    """Meshed once in a process: of the finest that takes seconds. Nobody may write to it."""
    scene = BUILT_IN[name]() if seed is None else PARTS[name](np.random.default_rng([seed, _SHAPE])).scene(name)
    for values in (scene.vertices, scene.faces, scene.vertex_normals):
        if values is not None:
            values.flags.writeable = False
    return scene


def _read_mesh(path: Path, file_unit: float) -> Scene:
    import trimesh

    if not path.is_file():
        raise UserError(f"--scene {path}: there is no such file")
    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False)
        vertices = np.asarray(mesh.vertices, dtype=np.float64) * file_unit
        faces = np.asarray(mesh.faces, dtype=np.int64)
    except Exception as error:  # trimesh's loaders raise whatever their parsers do
        raise UserError(f"--scene {path}: cannot be read as a mesh ({error}); export it again as PLY") from error
    if len(faces) == 0 or not np.isfinite(vertices).all() or np.ptp(vertices, axis=0).max() <= 0:
        raise UserError(f"--scene {path}: has no surface (no faces, or all in one place); a point cloud is not enough")
    return Scene(path.stem, vertices, faces)
