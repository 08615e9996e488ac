"""A sitting frog, about 120 x 99 x 68 mm: thin legs, deep folds, many parts that hide others."""

from sl_nerfstudio.synthesis.scenes.scene import Scene
from sl_nerfstudio.synthesis.scenes.sdf import (
    Field,
    Triple,
    capsule,
    carve,
    ellipsoid,
    half_space,
    mesh_of,
    mirrored,
    union,
)


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
    hind = mirrored(_hind_leg())
    fore = mirrored(_fore_leg())
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


def _hind_leg() -> Field:
    thigh = ellipsoid((32, -16, 21), (11, 26, 15), (-24, -8, 16))
    shank = capsule((42, 4, 16), (33, -38, 7), 7.0, 5.5)
    foot = capsule((34, -38, 4.5), (46, -8, 2.5), 5.0, 4.0)
    toes = _toes((46, -10, 2.5), ((42, 16, 1.8), (50, 18, 1.8), (57, 12, 1.8)))
    return union(1.5, thigh, shank, union(3.0, foot, *toes))


def _fore_leg() -> Field:
    upper = capsule((23, 14, 30), (33, 16, 14), 7.0, 5.5)
    lower = capsule((33, 16, 14), (25, 33, 4), 5.2, 4.2)
    fingers = _toes((25, 33, 3.2), ((17, 44, 1.8), (25, 47, 1.8), (33, 44, 1.8), (36, 36, 1.8)))
    return union(2.0, upper, lower, *fingers)


def _toes(start: Triple, tips: tuple[Triple, ...]) -> list[Field]:
    """Thin toes with round pads."""
    return [union(1.0, capsule(start, tip, 2.8, 1.9), ellipsoid(tip, (3.2, 3.2, 2.4))) for tip in tips]
