"""Machined parts that are nearly round, or nearly the same from several sides: a body, and one small feature.

Everything but the feature looks the same after a turn about z, so it alone says from which side a part is seen. Sizes
are drawn at random: a part of another seed is another one of its kind.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.synthesis.sdf import (
    Field,
    Scene,
    Triple,
    block,
    capsule,
    carve,
    cylinder,
    half_space,
    mesh_of,
    union,
)

_CELL = 0.6  # of the mesh, millimetres: below the features' own edges
_MARGIN = 4.0  # around a part, millimetres


@dataclass(frozen=True)
class Part:
    """A part that stands on z = 0 about the z axis; lengths in millimetres."""

    body: Field  # looks the same after each of the turns
    solid: Field  # the body with its feature
    turns: int  # a whole turn has so many that leave the body as it is; 0: any does
    depth: float  # the greatest distance of the part's surface from the body's
    radius: float  # of a cylinder about z that holds it
    height: float

    def scene(self, name: str) -> Scene:
        """The part as a mesh."""
        r, z = self.radius + _MARGIN, self.height + _MARGIN
        return mesh_of(name, self.solid, (-r, -r, -_MARGIN), (r, r, z), _CELL)


def flange(rng: np.random.Generator) -> Part:
    """A plate with a rim, a hub and a bore; the heads of two screws stand on it, not opposite each other."""
    radius, plate, hub, bore = rng.uniform((38, 7, 15, 8), (46, 10, 19, 11))
    height, head, depth, apart = rng.uniform((18, 4, 2.5, 65), (28, 5.5, 4, 145))
    rim = carve(0.0, cylinder((0, 0, 0), (0, 0, plate + 1.5), radius, 1), cylinder((0, 0, 1), (0, 0, 60), radius - 5))
    plain = union(0.0, cylinder((0, 0, 0), (0, 0, plate), radius, 1), rim)
    body = union(1.0, plain, cylinder((0, 0, 3), (0, 0, height), hub, 1))
    body = carve(0.0, body, cylinder((0, 0, -20), (0, 0, 60), bore))
    middle = (hub + radius - 5) / 2
    screw = carve(
        0.0,
        cylinder((middle, 0, plate - 2), (middle, 0, plate + depth), head, 0.5),
        cylinder((middle, 0, plate + depth - 2), (middle, 0, plate + depth + 9), 0.5 * head),
    )
    return Part(body, union(0.0, body, screw, turned(screw, apart)), 0, depth, radius, height)


def knob(rng: np.random.Generator) -> Part:
    """A knob on a skirt, plain or with flutes; a raised line on its top points outwards."""
    radius, skirt, height, depth = rng.uniform((25, 5, 26, 1.0), (31, 9, 36, 1.8))
    flutes = int(rng.choice([0, 10, 12]))
    body = union(
        1.0, cylinder((0, 0, 0), (0, 0, 7), radius + skirt, 1.5), cylinder((0, 0, 2), (0, 0, height), radius, 3)
    )
    if flutes:
        groove = cylinder((radius + 2.0, 0, 11), (radius + 2.0, 0, height + 9), 3.5)
        body = carve(1.0, body, repeated(groove, flutes))
    thick = 2.0
    level = height + depth - thick
    mark = capsule((0.35 * radius, 0, level), (radius - 4, 0, level), thick, thick)
    return Part(body, union(0.0, body, mark), flutes, depth, radius + skirt, height + depth)


def disc(rng: np.random.Generator) -> Part:
    """A disc with equal posts at equal angles; one slot, or two, is cut into its rim between posts."""
    radius, plate, post, height = rng.uniform((40, 6, 4, 14), (48, 9, 6, 22))
    width, depth = rng.uniform((4, 7), (6, 10))
    posts, slots = int(rng.choice([3, 4, 6])), int(rng.choice([1, 2]))
    out = 0.62 * radius
    body = union(
        0.5,
        cylinder((0, 0, 0), (0, 0, plate), radius, 1),
        cylinder((0, 0, 2), (0, 0, plate + 4), 0.25 * radius, 1),
        repeated(cylinder((out, 0, 1), (out, 0, height), post, 1), posts),
    )
    slot = block((radius - depth, -width / 2, -20), (radius + 20, width / 2, 60))
    # neighbouring gaps of three posts or more: two slots are never opposite each other
    cuts = [turned(slot, (k + 0.5) * 360 / posts) for k in range(slots)]
    return Part(body, carve(0.0, body, *cuts), posts, min(depth, plate / 2), radius, height)


def gear(rng: np.random.Generator) -> Part:
    """A gear with a hub and a bore; one tooth is wider than the others."""
    radius, thick, hub, height = rng.uniform((34, 9, 11, 15), (40, 14, 15, 22))
    teeth, wider = int(rng.integers(13, 20)), float(rng.uniform(1.4, 1.7))
    tip, width = radius + 5.0, np.pi * radius / teeth
    depth = (wider - 1) * width / 2

    def tooth(w: float) -> Field:
        return block((radius - 5, -w / 2, 0), (tip, w / 2, thick))

    wheel = union(0.0, cylinder((0, 0, 0), (0, 0, thick), radius), repeated(tooth(width), teeth))
    body = union(1.0, wheel, cylinder((0, 0, 3), (0, 0, height), hub, 1))
    bore = cylinder((0, 0, -20), (0, 0, 60), 0.5 * hub)
    body, solid = carve(0.0, body, bore), carve(0.0, union(0.0, body, tooth(wider * width)), bore)
    return Part(body, solid, teeth, depth, float(np.hypot(tip, wider * width)), height)


def box(rng: np.random.Generator) -> Part:
    """A square box with a round hole in its top; one upright edge is cut off."""
    half, height, hole, leg = rng.uniform((26, 30, 7, 5), (33, 46, 11, 9))
    hollow = cylinder((0, 0, height - 8), (0, 0, height + 20), hole)
    body = carve(0.0, block((-half, -half, 0), (half, half, height)), hollow)
    slope = float(np.sqrt(0.5))
    cut = half_space((-slope, -slope, 0), -slope * (2 * half - leg))
    return Part(body, carve(0.0, body, cut), 4, leg / 2, half * np.sqrt(2), height)


def labelled_bottle(rng: np.random.Generator) -> Part:
    """A round bottle with a cap; a label with a few strokes stands out of its side."""
    radius, shoulder, neck, depth = rng.uniform((24, 60, 9, 0.6), (29, 72, 11, 1.1))
    top, half_angle = shoulder + radius + 12, float(rng.uniform(35, 60))
    round_above = cylinder((0, 0, 3), (0, 0, shoulder + 0.7 * radius), radius, 0.7 * radius)
    body = union(
        2.0,
        union(0.0, cylinder((0, 0, 0), (0, 0, shoulder), radius, 2), round_above),
        cylinder((0, 0, shoulder), (0, 0, top - 4), neck, 1),
        cylinder((0, 0, top - 8), (0, 0, top), neck + 3, 1),
    )
    low, high, out = 0.2 * shoulder, 0.8 * shoulder, radius + depth
    c, s = np.cos(np.radians(half_angle)), np.sin(np.radians(half_angle))
    paper = cylinder((0, 0, low), (0, 0, high), out)
    label = carve(0.0, paper, half_space((s, c, 0), 0.0), half_space((s, -c, 0), 0.0))
    pen, strokes = 0.8, list[Field]()
    for _ in range(5):
        ends: list[Triple] = []
        for angle, z in rng.uniform((-0.8 * half_angle, low + 5), (0.8 * half_angle, high - 5), (2, 2)):
            turn = np.radians(angle)
            ends.append((float(out * np.cos(turn)), float(out * np.sin(turn)), float(z)))
        strokes.append(capsule(ends[0], ends[1], pen, pen))
    return Part(body, union(0.0, body, label, *strokes), 0, depth + pen, out + pen, top)


PARTS: dict[str, Callable[[np.random.Generator], Part]] = {
    "flange": flange,
    "knob": knob,
    "disc": disc,
    "gear": gear,
    "box": box,
    "labelled-bottle": labelled_bottle,
}


def turned(field: Field, angle_deg: float) -> Field:
    """The field turned about z."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return lambda p: field(p @ R)


def repeated(field: Field, times: int) -> Field:
    """The field at equal angles about z, the first along x; there it must be the same on both sides of y = 0."""
    step = 2 * np.pi / times

    def all_of_them(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        angle = np.arctan2(p[:, 1], p[:, 0])
        angle -= step * np.round(angle / step)
        r = np.hypot(p[:, 0], p[:, 1])
        return field(np.stack([r * np.cos(angle), r * np.sin(angle), p[:, 2]], -1))

    return all_of_them
