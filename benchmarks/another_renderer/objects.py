"""Solids, how they are joined and meshed, and the objects: meshes of about 120 mm. Lengths in mm, z is up."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import cast

import numpy as np
import trimesh
from numpy import ndarray
from skimage.measure import marching_cubes

Solid = Callable[[ndarray], ndarray]
"""Signed distance of points (..., 3), negative inside; may be a bound instead of the distance itself."""


def ball(centre: Sequence[float], radii: float | Sequence[float]) -> Solid:
    """A ball, or an ellipsoid with three radii."""
    r = np.broadcast_to(np.asarray(radii, dtype=float), 3)
    return lambda p: (np.linalg.norm((p - np.asarray(centre)) / r, axis=-1) - 1) * r.min()


def block(centre: Sequence[float], sides: Sequence[float], rounding: float = 0.5, turn_deg: float = 0.0) -> Solid:
    """A box with rounded edges, turned about the vertical through its centre."""
    half = np.asarray(sides, dtype=float) / 2 - rounding
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))

    def distance(p: ndarray) -> ndarray:
        x, y, z = np.moveaxis(p - np.asarray(centre), -1, 0)
        q = np.abs(np.stack([c * x + s * y, c * y - s * x, z], -1)) - half
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - rounding

    return distance


def rod(start: Sequence[float], end: Sequence[float], radius: float, end_radius: float | None = None) -> Solid:
    """A capsule between two points, or a cone with round ends."""
    a, d = np.asarray(start, dtype=float), np.subtract(end, start).astype(float)
    last = radius if end_radius is None else end_radius

    def distance(p: ndarray) -> ndarray:
        t = np.clip((p - a) @ d / (d @ d), 0, 1)
        return np.linalg.norm(p - a - t[..., None] * d, axis=-1) - (radius + t * (last - radius))

    return distance


def drum(centre: Sequence[float], radius: float, height: float, axis: int = 2) -> Solid:
    """A cylinder along one of the axes."""

    def distance(p: ndarray) -> ndarray:
        q = p - np.asarray(centre)
        across = np.linalg.norm(np.delete(q, axis, -1), axis=-1) - radius
        along = np.abs(q[..., axis]) - height / 2
        return np.minimum(np.maximum(across, along), 0) + np.hypot(np.maximum(across, 0), np.maximum(along, 0))

    return distance


def prism(corners: int, radius: float, height: float) -> Solid:
    """A regular prism about z; `radius` is that of its inner circle."""

    def distance(p: ndarray) -> ndarray:
        step = 2 * np.pi / corners
        angle = np.mod(np.arctan2(p[..., 1], p[..., 0]) + step / 2, step) - step / 2
        return np.maximum(np.hypot(p[..., 0], p[..., 1]) * np.cos(angle) - radius, np.abs(p[..., 2]) - height / 2)

    return distance


def turned(profile: Sequence[tuple[float, float]]) -> Solid:
    """A solid of revolution about z: (height, radius) from bottom to top, straight between."""
    z, r = np.asarray(profile, dtype=float).T
    steepest = float(np.hypot(1, np.max(np.abs(np.diff(r) / np.diff(z)))))

    def distance(p: ndarray) -> ndarray:
        side = (np.hypot(p[..., 0], p[..., 1]) - np.interp(p[..., 2], z, r)) / steepest
        return np.maximum(side, np.maximum(z[0] - p[..., 2], p[..., 2] - z[-1]))

    return distance


def ring(centre: Sequence[float], radius: float, thickness: float, axis: int = 2) -> Solid:
    """A torus; `thickness` is the radius of its tube."""

    def distance(p: ndarray) -> ndarray:
        q = p - np.asarray(centre)
        return np.hypot(np.linalg.norm(np.delete(q, axis, -1), axis=-1) - radius, q[..., axis]) - thickness

    return distance


def moved(solid: Solid, shift: Sequence[float], turn_deg: float = 0.0, tilt_deg: float = 0.0) -> Solid:
    """Tilted about y, turned about z, then shifted."""
    a, b = np.radians(turn_deg), np.radians(tilt_deg)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    tilt = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return lambda p: solid((p - np.asarray(shift)) @ (turn @ tilt))


def joined(*solids: Solid, blend: float = 0.0) -> Solid:
    """The union; with `blend`, of its size in mm, the seams are rounded."""

    def distance(p: ndarray) -> ndarray:
        result = solids[0](p)
        for solid in solids[1:]:
            other = solid(p)
            h = np.maximum(blend - np.abs(result - other), 0) / max(blend, 1e-9)
            result = np.minimum(result, other) - h * h * blend / 4
        return result

    return distance


def without(solid: Solid, *holes: Solid) -> Solid:
    """What is left of a solid."""

    def distance(p: ndarray) -> ndarray:
        result = solid(p)
        for hole in holes:
            result = np.maximum(result, -hole(p))
        return result

    return distance


def meshed(solid: Solid, half: Sequence[float], voxel: float = 0.8) -> trimesh.Trimesh:
    """Marching cubes in a box from -half to half. Raises ValueError if the solid leaves the box."""
    axes = [np.arange(-h, h + voxel, voxel) for h in half]
    slabs = [solid(np.stack(np.meshgrid(x, *axes[1:], indexing="ij"), -1))[0] for x in axes[0][:, None]]
    values = np.stack(slabs).astype(np.float32)
    rims = (values[[0, -1]], values[:, [0, -1]], values[:, :, [0, -1]])
    if any(rim.min() <= 0 for rim in rims):
        raise ValueError("the solid does not fit into its box")
    points, faces, _, _ = marching_cubes(values, 0.0, spacing=(voxel,) * 3, gradient_direction="descent")
    return trimesh.Trimesh(points + [a[0] for a in axes], faces, process=False)


def tube(path: ndarray, radius: float, closed: bool = False, around: int = 20) -> trimesh.Trimesh:
    """A pipe along a path (n, 3), with half-open ends unless it is closed."""
    path = np.asarray(path, dtype=float)
    along = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    first = np.cross(along[0], [0.3, 0.5, 0.81])
    sides = [first / np.linalg.norm(first)]
    for direction in along[1:]:
        side = sides[-1] - direction * (sides[-1] @ direction)
        sides.append(side / np.linalg.norm(side))
    u = np.stack(sides)
    v = np.cross(along, u)
    angle = np.arange(around) * 2 * np.pi / around
    rings = path[:, None] + radius * (u[:, None] * np.cos(angle)[:, None] + v[:, None] * np.sin(angle)[:, None])
    n = len(path)
    i, k = np.meshgrid(np.arange(n if closed else n - 1), np.arange(around), indexing="ij")
    a, b = i * around + k, i * around + (k + 1) % around
    c, d = (i + 1) % n * around + k, (i + 1) % n * around + (k + 1) % around
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    return trimesh.Trimesh(rings.reshape(-1, 3), faces, process=False)


def sheet(
    height: Callable[[ndarray, ndarray], ndarray], sides: tuple[float, float], thickness: float
) -> trimesh.Trimesh:
    """A plate whose upper side is `height(x, y)`, and whose lower side is `thickness` below it."""
    x, y = (np.linspace(-s / 2, s / 2, int(s / 0.7)) for s in sides)
    X, Y = np.meshgrid(x, y, indexing="ij")
    top = np.stack([X, Y, height(X, Y)], -1).reshape(-1, 3)
    n, m = X.shape
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    upper = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([index[:, 0], index[-1, 1:], index[-2::-1, -1], index[0, -2::-1]])
    wall = [face for p, q in pairwise(rim) for face in ((p, p + n * m, q), (q, p + n * m, q + n * m))]
    faces = np.concatenate([upper, upper[:, ::-1] + n * m, np.array(wall)])
    return trimesh.Trimesh(np.concatenate([top, top - [0, 0, thickness]]), faces, process=False)


def shoe() -> trimesh.Trimesh:
    """A low shoe with a heel and laces, open at the top."""
    sole = joined(ball((-35, 0, -22), (26, 20, 9)), ball((25, 2, -22), (36, 24, 9)), blend=16)
    heel = block((-42, 0, -28), (28, 34, 12), 3)
    upper = joined(ball((-34, 0, -4), (24, 18, 26)), rod((-20, 0, 6), (38, 2, -14), 18, 13), blend=14)
    inside = joined(ball((-33, 0, 14), (19, 13, 26)), rod((-20, 0, 16), (6, 1, 2), 12, 10))
    laces = [rod((x, -12, 8.64 - 0.42 * x), (x, 12, 8.64 - 0.42 * x), 1.8) for x in (-4, 6, 16)]
    return meshed(joined(joined(without(upper, inside), sole, blend=6), heel, *laces, blend=1.0), (76, 42, 48))


def knight() -> trimesh.Trimesh:
    """A chess knight on a turned foot."""
    foot = turned([(-55, 26), (-48, 26), (-45, 22), (-40, 22), (-34, 15), (-30, 17), (-26, 15)])
    neck = joined(rod((-4, 0, -28), (-8, 0, 8), 15, 12), rod((-8, 0, 8), (2, 0, 30), 13, 11), blend=8)
    head = joined(rod((0, 0, 32), (26, 0, 14), 11, 7), ball((28, 0, 12), (7, 6, 6)), blend=6)
    ears = [rod((-2, side * 6, 38), (-4, side * 8, 52), 3.4, 1.4) for side in (-1, 1)]
    mane = [block((-20 + 0.15 * k * k, 0, 30 - 9 * k), (8, 5, 6), 1.2) for k in range(6)]
    eyes = [ball((8, side * 10, 30), 2.5) for side in (-1, 1)]
    return meshed(joined(foot, neck, head, *ears, *mane, *eyes, blend=2), (44, 36, 60))


def car() -> trimesh.Trimesh:
    """A toy car."""
    body = joined(block((0, 0, -8), (112, 48, 18), 4), block((-8, 0, 10), (58, 42, 26), 8), blend=3)
    arches = [drum((x, y, -16), 13, 14, axis=1) for x in (-33, 35) for y in (-24, 24)]
    wheels = [drum((x, y, -16), 11, 9, axis=1) for x in (-33, 35) for y in (-21, 21)]
    windows = [block((-8, side * 21, 14), (44, 4, 12), 2) for side in (-1, 1)]
    bumper = [block((-54, 0, 6), (5, 44, 3), 1), *(rod((-52, y, 0), (-52, y, 6), 2) for y in (14, -14))]
    lamp = drum((44, 14, -6), 4, 6, axis=0)
    hollow = without(body, *arches, *windows, block((22, 0, 14), (5, 34, 12), 2))
    return meshed(joined(hollow, *wheels, *bumper, lamp), (68, 36, 38))


def hand() -> trimesh.Trimesh:
    """A right hand, upright, with the fingers a little bent."""
    palm = joined(ball((0, 0, -18), (24, 10, 28)), ball((-14, 4, -26), (14, 9, 16)), blend=10)
    fingers = []
    for x, length, y in ((-17, 36, 8), (-6, 46, 2), (5, 43, -2), (15, 32, 4)):
        joint = (x * 1.25, y, 4 + length * 0.55)
        fingers += [rod((x, 0, 4), joint, 7, 6), rod(joint, (x * 1.35, y + 7, 4 + length), 6, 5)]
    thumb = [rod((-18, 4, -26), (-36, 12, -6), 9, 7), rod((-36, 12, -6), (-38, 18, 12), 7, 5.5)]
    wrist = rod((2, 0, -36), (3, -2, -56), 16, 15)
    return meshed(joined(joined(palm, wrist, blend=10), *fingers, *thumb, blend=5), (56, 34, 76))


def shell() -> trimesh.Trimesh:
    """A sea snail's."""
    turn = np.linspace(0, 7 * np.pi, 130)
    parts = [
        ball((34 * k * np.cos(t), 34 * k * np.sin(t), 58 - 112 * k**0.9), 21 * k + 1 + k * np.cos(6 * t))
        for t, k in zip(turn, np.exp(-0.11 * turn), strict=True)
    ]
    return meshed(joined(*parts, blend=1.5), (66, 66, 84), 1.0)


def pan() -> trimesh.Trimesh:
    """A pan: round but for its handle."""
    bowl = turned([(-14, 38), (-10, 42), (14, 48), (16, 48)])
    hollow = turned([(-10, 36), (-6, 39), (18, 45), (30, 45)])
    handle = joined(rod((44, 0, 10), (74, 4, 16), 5, 6.5), ball((74, 4, 16), (10, 7, 5)), blend=3)
    return meshed(joined(without(bowl, hollow), handle, blend=1.5), (92, 54, 28))


def knot() -> trimesh.Trimesh:
    """A trefoil."""
    t = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    x, y, z = np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -1.3 * np.sin(3 * t)
    return tube(np.stack([x, y, z], 1) * 17.5 * [1.05, 0.95, 1.0], 9.0, closed=True, around=48)


def bracket() -> trimesh.Trimesh:
    """An angle with holes and a rib."""
    plates = joined(block((0, 0, -30), (100, 60, 10)), block((-45, 0, 5), (10, 60, 80)), blend=3)
    rib = without(block((-25, 4, -8), (44, 8, 40)), moved(block((30, 0, 30), (90, 60, 60)), (-8, 0, 0), 0, -45))
    holes = [drum((x, y, -30), r, 30) for x, y, r in ((5, -16, 7), (34, 14, 9), (36, -18, 5))]
    return meshed(without(joined(plates, rib), *holes, drum((-45, -8, 20), 11, 30, axis=0)), (62, 42, 56))


def blob() -> trimesh.Trimesh:
    """A ball with bumps and ripples."""
    mesh = trimesh.creation.icosphere(subdivisions=6, radius=1.0)
    x, y, z = mesh.vertices.T
    radius = 50 + 9 * np.sin(2.1 * x + 1.3) * np.cos(1.7 * y - 0.4) + 6 * np.sin(3.1 * z + 2 * x) + 1.2 * np.sin(17 * z)
    return trimesh.Trimesh(mesh.vertices * radius[:, None], mesh.faces, process=False)


def sticks() -> trimesh.Trimesh:
    """Thin rods that stand and lean on a plate."""
    rng = np.random.default_rng(5)
    foot = rng.uniform(-34, 34, (7, 2))
    top = foot + rng.uniform(-22, 22, (7, 2))
    rods = [rod((*a, -40), (*b, h), 3.2) for a, b, h in zip(foot, top, rng.uniform(5, 48, 7), strict=True)]
    return meshed(joined(block((0, 0, -44), (100, 84, 8)), *rods, rod((-30, 10, 0), (32, -6, 18), 2.6)), (64, 62, 56))


def mug() -> trimesh.Trimesh:
    """A cylinder, hollow, with a handle."""
    handle = without(ring((42, 0, 0), 24, 5.5, axis=1), drum((0, 0, 0), 38, 90))
    outside = joined(drum((0, 0, 0), 40, 96), handle, blend=2)
    return meshed(without(outside, drum((0, 0, 8), 35.5, 96)), (76, 46, 54))


def box() -> trimesh.Trimesh:
    """110 x 70 x 60 mm: the same after half a turn."""
    mesh = trimesh.creation.box((110, 70, 60))
    return cast(trimesh.Trimesh, mesh.subdivide_to_size(4.0))


def nut() -> trimesh.Trimesh:
    """Hexagonal, with a hole."""
    return meshed(without(prism(6, 45, 38), drum((0, 0, 0), 26, 60), ball((0, 0, 52), 40)), (58, 58, 26))


def gear() -> trimesh.Trimesh:
    """Twelve teeth, a hub and a hole."""

    def teeth(p: ndarray) -> ndarray:
        wave = np.clip(2.5 * np.cos(12 * np.arctan2(p[..., 1], p[..., 0])), -1, 1)
        return np.maximum((np.hypot(p[..., 0], p[..., 1]) - 52 - 5 * wave) * 0.5, np.abs(p[..., 2]) - 11)

    return meshed(without(joined(teeth, drum((0, 0, 6), 22, 34)), drum((0, 0, 0), 10, 60)), (62, 62, 28))


def foot() -> trimesh.Trimesh:
    """A left foot, cut above the ankle."""
    sole = joined(ball((-38, 0, -18), (24, 19, 18)), ball((8, 3, -20), (40, 22, 15)), blend=18)
    instep = rod((-28, 0, 40), (-26, 0, 0), 17, 20)
    back = joined(instep, rod((-18, 0, 6), (34, 5, -18), 17, 11), blend=16)
    toes = [rod((34, y - 2, -24), (46 + 10 * np.exp(-(((y - 17) / 14) ** 2)), y, -26), r) for y, r in
            ((17, 8.5), (4, 6), (-5, 5.5), (-12, 5), (-18, 4.5))]  # fmt: skip
    ankles = joined(ball((-26, 17, 10), 7), ball((-29, -17, 6), 7))
    whole = joined(joined(sole, back, blend=14), ankles, *toes, blend=5)
    return meshed(without(whole, block((0, 0, 70), (200, 200, 60))), (72, 44, 46))


def jaw() -> trimesh.Trimesh:
    """A lower jaw: fourteen teeth of several kinds on an arch."""
    rng = np.random.default_rng(3)
    place = np.linspace(-1, 1, 14)
    x, y = 46 * place, 40 - 72 * place**2
    gum = joined(*[ball((a, b, -8), (9.5, 9.5, 12)) for a, b in zip(46 * place, y, strict=True)], blend=8)
    teeth = []
    for k, (a, b) in enumerate(zip(x, y, strict=True)):
        turn = float(np.degrees(np.arctan2(-144 * place[k], 46)))
        kind = abs(place[k])
        height = 11 + rng.uniform(-1.5, 1.5)
        if kind < 0.3:
            teeth.append(block((a, b, height / 2), (6.5, 3.5, height + 8), 1.6, turn))
        elif kind < 0.55:
            teeth.append(joined(ball((a, b, 2), (4.2, 4.5, height)), ball((a, b + 1, 0), 5), blend=2))
        else:
            cusps = [ball((a + dx, b + dy, 5 + rng.uniform(0, 2)), 3) for dx in (-2.6, 2.6) for dy in (-2.6, 2.6)]
            teeth.append(joined(block((a, b, 2), (9.5, 9, 10), 2.5, turn), *cusps, blend=2))
    return meshed(joined(gum, *teeth, blend=2), (62, 60, 26), 0.7)


def bust() -> trimesh.Trimesh:
    """A head with a face on shoulders."""
    head = joined(ball((0, 0, 24), (23, 28, 31)), ball((0, 10, 8), (17, 18, 18)), blend=8)
    face = joined(
        rod((0, 25, 30), (0, 33, 18), 3, 4.5), ball((0, 27, 5), (8, 4, 2.5)), ball((0, 24, -6), (7, 7, 6)), blend=5
    )
    sockets = [ball((side * 9.5, 31, 27), (6.5, 6, 4.5)) for side in (-1, 1)]
    ears = joined(ball((-24, 0, 20), (4, 6, 10)), ball((24, -1, 20), (4, 6, 10)))
    hair = joined(ball((3, -10, 38), (20, 22, 20)), ball((-8, -22, 20), (12, 10, 20)), blend=8)
    body = joined(rod((0, -2, 0), (0, -4, -28), 13), ball((0, -6, -46), (50, 20, 20)), blend=14)
    whole = joined(without(joined(joined(head, face, blend=4), ears, hair, blend=3), *sockets), body, blend=8)
    return meshed(without(whole, block((0, 0, -80), (200, 200, 60))), (64, 46, 64))


def blade() -> trimesh.Trimesh:
    """A twisted turbine blade on a root with grooves."""
    parts = []
    for k in np.linspace(0, 1, 60):
        chord, turn = 46 - 16 * k, np.radians(15 + 38 * k)
        t = np.linspace(0, 2 * np.pi, 100, endpoint=False)
        u = np.cos(t)
        x, y = chord / 2 * u, 3.4 * np.sin(t) * (1.25 - u) * (1 - 0.4 * k) + 7 * (1 - u**2)
        c, s = np.cos(turn), np.sin(turn)
        parts.append(np.stack([c * x - s * y, s * x + c * y + 6 * k, np.full_like(t, -32 + 92 * k)], 1))
    points = np.concatenate([*parts, parts[0].mean(0)[None], parts[-1].mean(0)[None]])
    i, k = np.meshgrid(np.arange(59), np.arange(100), indexing="ij")
    a, b, c, d = i * 100 + k, i * 100 + (k + 1) % 100, (i + 1) * 100 + k, (i + 1) * 100 + (k + 1) % 100
    sides = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    n, j = len(points), np.arange(100)
    ends = [
        np.stack([np.full(100, n - 2), (j + 1) % 100, j], 1),
        np.stack([np.full(100, n - 1), 5900 + j, 5900 + (j + 1) % 100], 1),
    ]
    wing = trimesh.Trimesh(points, np.concatenate([sides, *ends]), process=False)
    root = without(
        block((0, 4, -44), (56, 34, 28), 1.5),
        *[drum((0, 4 + side * 19, z), 5, 90, axis=0) for side in (-1, 1) for z in (-40, -51)],
    )
    return _concatenated([wing, meshed(root, (34, 34, 64))])


def housing() -> trimesh.Trimesh:
    """A bearing block: bore, feet with holes, bosses of unequal height, a rib, an oil cup."""
    body = joined(block((0, 0, -28), (116, 46, 16), 2), drum((0, 0, 4), 32, 40, axis=1), blend=6)
    ribs = joined(block((30, 0, -10), (40, 7, 30), 1), block((-30, 6, -12), (36, 6, 24), 1))
    bosses = joined(
        drum((46, 12, -14), 9, 22), drum((-46, -10, -18), 8, 12), drum((-44, 12, -16), 6, 20), drum((8, 0, 38), 8, 24),
        blend=2,
    )  # fmt: skip
    holes = [
        drum((0, 0, 4), 19, 80, axis=1), drum((46, 12, -14), 4, 80), drum((-46, -10, -18), 4, 80),
        drum((8, 0, 46), 4, 20),
    ]  # fmt: skip
    return meshed(without(joined(body, ribs, bosses, blend=2), *holes), (64, 34, 56))


def bottle() -> trimesh.Trimesh:
    """A jug with a handle and a spout."""
    profile = [(-58, 30), (-50, 36), (-20, 40), (5, 35), (25, 22), (36, 15), (50, 15), (56, 18)]
    handle = without(ring((38, 0, 14), 24, 5, axis=1), turned([(h, r - 3) for h, r in profile]))
    spout = rod((-12, 0, 48), (-25, 0, 57), 6, 3.5)
    return meshed(joined(turned(profile), handle, spout, blend=3), (74, 46, 66))


def vertebra() -> trimesh.Trimesh:
    """Body, arch with a hole, and processes."""
    body = without(drum((0, 28, 0), 27, 34), ring((0, 28, 0), 33, 9))
    arch = without(drum((0, -6, 2), 21, 24), drum((0, -4, 0), 12, 60))
    side = [rod((s * 14, -10, 4), (s * 48, -24 - 4 * s, 10 + 3 * s), 8, 5) for s in (-1, 1)]
    joints = [rod((s * 17, -16, 0), (s * 20, -22, s2 * 26), 7, 5.5) for s in (-1, 1) for s2 in (-1, 1)]
    spine = rod((0, -22, 0), (2, -60, -14), 7, 5)
    return meshed(
        joined(
            without(joined(body, arch, blend=5), rod((0, -4, -40), (0, -4, 40), 11)), *side, *joints, spine, blend=5
        ),
        (62, 70, 42),
    )


def relief() -> trimesh.Trimesh:
    """A tile with an ornament."""

    def height(x: ndarray, y: ndarray) -> ndarray:
        r, angle = np.hypot(x - 6, y + 4), np.arctan2(y + 4, x - 6)
        petals = 7 * np.exp(-(((r - 26 - 6 * np.cos(5 * angle)) / 7) ** 2))
        leaf = 8 * np.exp(-(((x + 36 + 0.01 * y**2) / 6) ** 2 + (y / 34) ** 2)) * (1 + 0.3 * np.sin(y / 2.5))
        rim = 5 / (1 + np.exp(-(np.maximum(np.abs(x) - 52, np.abs(y) - 42)) / 0.7))
        return (
            petals + leaf + rim + 9 * np.exp(-((r / 9) ** 2)) + 3 * np.exp(-(((x - 42) / 5) ** 2 + ((y - 30) / 4) ** 2))
        )

    return sheet(height, (116, 96), 12)


def cloth() -> trimesh.Trimesh:
    """A crumpled sheet."""
    rng = np.random.default_rng(8)
    waves = [(rng.normal(0, 0.09, 2), rng.uniform(0, 6.3), rng.uniform(1, 4)) for _ in range(12)]

    def height(x: ndarray, y: ndarray) -> ndarray:
        folds = sum(a * np.abs(np.sin((k[0] * x + k[1] * y) / 1.6 + phase)) ** 0.8 for k, phase, a in waves)
        return folds + 0.006 * (x - 10) ** 2 - 14

    return sheet(height, (110, 96), 1.6)


def wire() -> trimesh.Trimesh:
    """A frame of bent wire."""
    a, b, c, d = (-45, -32, -40), (46, -30, -40), (44, 34, -40), (-42, 30, -40)
    e, f, g, h = (-38, -24, 36), (40, -26, 20), (36, 28, 44), (-36, 26, 30)
    lines = [
        (a, b), (b, c), (c, d), (d, a), (e, f), (f, g), (g, h), (h, e), (a, e), (b, f), (c, g), (d, h), (b, g), (e, c),
    ]  # fmt: skip
    parts = [tube(np.linspace(p, q, 60), 2.6) for p, q in lines]
    knots = [trimesh.creation.icosphere(subdivisions=3, radius=4.0) for _ in range(8)]
    for ball_, at in zip(knots, (a, b, c, d, e, f, g, h), strict=True):
        ball_.apply_translation(at)
    return _concatenated([*parts, *knots])


def pair() -> trimesh.Trimesh:
    """Two separate things."""
    pear = joined(ball((-30, 6, -14), (25, 23, 24)), ball((-27, 3, 20), (13, 14, 16)), blend=18)
    dented = without(pear, ball((-48, -16, -8), 12), ball((-18, 18, 28), 8))
    wedge = without(
        block((38, -4, -12), (36, 52, 48), 2, 20), moved(block((0, 0, 24), (70, 90, 30)), (40, 0, 0), 20, 24)
    )
    return meshed(joined(dented, joined(wedge, drum((38, -4, 6), 8, 30))), (74, 50, 50))


def steps() -> trimesh.Trimesh:
    """A block of steps, as for trying instruments out, with a groove and two holes."""
    parts = [block((-44 + 22 * k, 0, -38 + 5.5 * (k + 1)), (22, 60 - 4 * k, 11 * (k + 1)), 0.6) for k in range(5)]
    holes = [drum((-22, 12, -20), 6, 30), drum((22, -8, 0), 7, 60), block((0, -18, -4), (10, 40, 16), 0.5)]
    return meshed(without(joined(*parts), *holes), (62, 38, 46))


def _concatenated(parts: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    return cast(trimesh.Trimesh, trimesh.util.concatenate(list(parts)))


OBJECTS: dict[str, Callable[[], trimesh.Trimesh]] = {
    make.__name__: make
    for make in (
        knot, bracket, blob, sticks, mug, box, nut, gear,
        foot, jaw, bust, blade, housing, bottle, vertebra, relief, cloth, wire, pair, steps,
        shoe, knight, car, hand, shell, pan,
    )
}  # fmt: skip
