"""Objects whose geometry hardly determines some motions of a frame: the hard cases of registration and adjustment.

A frame may slide along planes, turn about an axis of revolution or about a sphere's centre, at hardly any cost. Each
object has a little that prevents it.
"""

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

_FROM_ABOVE = (45.0, 78.0)  # degrees: planes that lie down are seen from above


def staircase(cell: float = 1.0) -> Scene:
    """Five steps, 90 x 60 x 40 mm: parallel planes at five heights, and risers."""
    steps = [_block((18.0 * k - 45, -30, 0), (45, 30, 8.0 * k + 8)) for k in range(5)]
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
    plate = _block((-50, -40, 0), (50, 40, 5))
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
    solid = union(1.5, _block((-60, -45, 0), (60, 45, 5)), *marks, *domes)
    flat = carve(0.0, solid, half_space((0, 0, 1), 0.0))
    return mesh_of("relief", flat, (-65, -50, -4), (65, 50, 13), cell, _FROM_ABOVE)


def rod(cell: float = 1.0) -> Scene:
    """A long thin rod, 158 x 13 x 14 mm, with two collars and a bent end."""
    shaft = capsule((-74, 0, 6.5), (60, 0, 6.5), 5, 5)
    end = capsule((60, 0, 6.5), (76, 3, 10.5), 5, 3.5)
    collars = [cylinder((x, 0, 6.5), (x + 5, 0, 6.5), 6.5, 1.5) for x in (-40, 15)]
    return mesh_of("rod", union(2.0, shaft, end, *collars), (-85, -12, -5), (85, 14, 20), cell)


def _block(low: Triple, high: Triple) -> Field:
    """A box with sharp edges."""
    middle, half = (np.add(low, high)) / 2, np.subtract(high, low) / 2

    def field(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        q = np.abs(p - middle) - half
        return np.sqrt((np.maximum(q, 0) ** 2).sum(-1)) + np.minimum(q.max(-1), 0)

    return field
