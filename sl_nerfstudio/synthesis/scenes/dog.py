"""A standing dog, about 40 x 135 x 105 mm: four legs apart, ears, a raised tail."""

from sl_nerfstudio.synthesis.scenes.scene import Scene
from sl_nerfstudio.synthesis.scenes.sdf import (
    Field,
    capsule,
    carve,
    ellipsoid,
    half_space,
    mesh_of,
    mirrored,
    ridges,
    union,
)


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
    legs = union(3.0, _fore_leg(5.0, 1.0), _fore_leg(-4.0, -1.0), _hind_leg(-3.0, 1.0), _hind_leg(6.0, -1.0))
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


def _fore_leg(forward: float, side: float) -> Field:
    x = 10.5 * side
    upper = capsule((x, 27, 52), (x, 24 + forward, 30), 7.4, 5.0)
    lower = capsule((x, 24 + forward, 30), (x, 26 + 1.4 * forward, 4), 4.8, 3.6)
    return union(2.5, upper, lower, ellipsoid((x, 30 + 1.4 * forward, 3), (5.2, 7.5, 4.2)))


def _hind_leg(forward: float, side: float) -> Field:
    x = 9.5 * side
    thigh = ellipsoid((x, -38 + 0.4 * forward, 46), (7.5, 12, 17), (14, 0, 0))
    shank = capsule((x, -33 + forward, 36), (x, -49 + forward, 23), 6.0, 4.0)
    hock = capsule((x, -49 + forward, 23), (x, -45 + forward, 4), 4.0, 3.4)
    return union(2.5, thigh, shank, hock, ellipsoid((x, -41 + forward, 3), (5.0, 7.5, 4.0)))
