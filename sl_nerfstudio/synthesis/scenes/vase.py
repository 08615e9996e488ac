"""A vase, 84 x 84 x 129 mm: an exact surface of revolution, hollow, with nothing that tells one side from another."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

from sl_nerfstudio.synthesis.scenes.scene import Scene

_SEGMENTS = 720  # around the axis
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
    r, z, normal_r, normal_z = _outline()
    theta = 2 * np.pi * np.arange(_SEGMENTS) / _SEGMENTS
    c, s = np.cos(theta), np.sin(theta)
    rings = np.stack([r[:, None] * c, r[:, None] * s, np.broadcast_to(z[:, None], (len(z), _SEGMENTS))], -1)
    normals = np.stack(
        [normal_r[:, None] * c, normal_r[:, None] * s, np.broadcast_to(normal_z[:, None], (len(z), _SEGMENTS))], -1
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


def _outline() -> tuple[Float[ndarray, "k"], Float[ndarray, "k"], Float[ndarray, "k"], Float[ndarray, "k"]]:
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
    j = np.arange(_SEGMENTS)
    k = (j + 1) % _SEGMENTS
    out = []
    for i in range(rings - 1):
        a, b = i * _SEGMENTS, (i + 1) * _SEGMENTS
        out += [np.stack([a + j, a + k, b + k], 1), np.stack([a + j, b + k, b + j], 1)]
    foot, floor = rings * _SEGMENTS, rings * _SEGMENTS + 1
    last = (rings - 1) * _SEGMENTS
    out += [np.stack([np.full_like(j, foot), k, j], 1), np.stack([np.full_like(j, floor), last + j, last + k], 1)]
    return np.concatenate(out)
