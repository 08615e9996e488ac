"""Six more objects, added after the decoder and all limits were settled."""

import numpy as np
import trimesh

from benchmarks.another_renderer.shapes import ball, block, drum, joined, meshed, rod, turned, without


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
