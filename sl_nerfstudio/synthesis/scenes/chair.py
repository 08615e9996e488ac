"""A chair of rods, about 62 x 66 x 116 mm: legs, rungs and spindles that are a few millimetres thin."""

from sl_nerfstudio.synthesis.scenes.scene import Scene
from sl_nerfstudio.synthesis.scenes.sdf import Field, Triple, capsule, carve, half_space, mesh_of, mirrored, union

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
