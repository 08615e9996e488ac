"""A head with neck, about 147 x 195 x 201 mm: large smooth parts with small features."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.synthesis.scenes.scene import Scene
from sl_nerfstudio.synthesis.scenes.sdf import capsule, carve, ellipsoid, half_space, mesh_of, mirrored, ridges, union


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
    lips = union(
        1.5,
        ellipsoid((0, 64, 69.5), (18, 7.5, 4.6)),
        ellipsoid((0, 64.5, 62), (15, 7.5, 5.2)),
    )
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
        2.0,
        ellipsoid((65, -8, 106), (7.5, 19, 29), (0, 0, -22)),
        ellipsoid((73, -3, 109), (7.5, 12, 20), (0, 0, -22)),
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
