"""The objects, as meshes of about 120 mm: eight that found faults before, and twelve of the kind that people scan."""

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import trimesh
from numpy import ndarray

from benchmarks.another_renderer.more_objects import car, hand, knight, pan, shell, shoe
from benchmarks.another_renderer.shapes import (
    ball,
    block,
    drum,
    joined,
    meshed,
    moved,
    prism,
    ring,
    rod,
    sheet,
    tube,
    turned,
    without,
)


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
        drum((46, 12, -14), 9, 22),
        drum((-46, -10, -18), 8, 12),
        drum((-44, 12, -16), 6, 20),
        drum((8, 0, 38), 8, 24),
        blend=2,
    )
    holes = [
        drum((0, 0, 4), 19, 80, axis=1),
        drum((46, 12, -14), 4, 80),
        drum((-46, -10, -18), 4, 80),
        drum((8, 0, 46), 4, 20),
    ]
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
        (a, b),
        (b, c),
        (c, d),
        (d, a),
        (e, f),
        (f, g),
        (g, h),
        (h, e),
        (a, e),
        (b, f),
        (c, g),
        (d, h),
        (b, g),
        (e, c),
    ]
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
