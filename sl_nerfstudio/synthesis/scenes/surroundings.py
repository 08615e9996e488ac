"""What an object stands on and among: a table, and upright boards and boxes behind the object."""

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.synthesis.scenes.scene import Scene

Background = Literal["none", "table", "walls"]
_LOWEST_ELEVATION, _HIGHEST_AT_LEAST = 26.0, 48.0  # degrees: the devices stay above the table
_TABLE_HALF_SIDE = (1.7, 2.6)  # in sizes of the object: a little more than the image shows
_TABLE_THICKNESS = 0.15
_GAP = 1e-4  # below the object, in its sizes: surfaces in one place would hide each other at random
_DISTANCE = (0.85, 1.7)  # of boards and boxes from the object's middle
_CLEARANCE = 0.8  # of the height at which the lowest cameras look over a board to the object's middle


def make_surroundings(scene: Scene, background: Background, rng: np.random.Generator) -> Scene | None:
    """Table, or table and two or three boards or boxes at random places around the object; None for "none"."""
    if background == "none":
        return None
    parts = [_table(scene, rng)]
    if background == "walls":
        number = int(rng.integers(2, 4))
        azimuth = rng.uniform(0, 2 * np.pi) + (np.arange(number) + rng.uniform(-0.3, 0.3, number)) * 2 * np.pi / number
        parts += [_board(scene, float(a), rng) for a in azimuth]
    corners = np.concatenate(parts)
    faces = np.arange(len(corners) * 3).reshape(-1, 3)
    return Scene("surroundings", corners.reshape(-1, 3), faces, _flat_normals(corners))


def above_the_table(scene: Scene) -> Scene:
    """The object, looked at only from elevations at which neither device dips below the table."""
    low, high = scene.elevation_deg
    bounds = (max(low, _LOWEST_ELEVATION), max(high, _HIGHEST_AT_LEAST))
    return replace(scene, elevation_deg=bounds)


def joined(scene: Scene, surroundings: Scene) -> Scene:
    """Both as one mesh; the faces of the object come first."""
    normals = None
    if scene.vertex_normals is not None and surroundings.vertex_normals is not None:
        normals = np.concatenate([scene.vertex_normals, surroundings.vertex_normals])
    return Scene(
        scene.name,
        np.concatenate([scene.vertices, surroundings.vertices]),
        np.concatenate([scene.faces, surroundings.faces + len(scene.vertices)]),
        normals,
        scene.elevation_deg,
    )


def _table(scene: Scene, rng: np.random.Generator) -> Float[ndarray, "12 3 3"]:
    """A turned slab below the object, not quite in the middle."""
    half = scene.size * rng.uniform(*_TABLE_HALF_SIDE, 2)
    thickness = _TABLE_THICKNESS * scene.size
    shift = scene.size * rng.uniform(-0.2, 0.2, 2)
    top = scene.vertices[:, 2].min() - _GAP * scene.size
    centre = np.array([scene.centre[0] + shift[0], scene.centre[1] + shift[1], top - thickness / 2])
    return _box(centre, np.array([half[0], half[1], thickness / 2]), rng.uniform(0, np.pi))


def _board(scene: Scene, azimuth: float, rng: np.random.Generator) -> Float[ndarray, "12 3 3"]:
    """A board or a box that stands on the table, low enough to look over it, turned roughly to the object."""
    thickness = rng.choice([0.03, rng.uniform(0.2, 0.5)])
    half_width = rng.uniform(0.25, 0.9)
    bottom = scene.vertices[:, 2].min() - _GAP * scene.size
    # no part of it may reach into the object, whatever the outline of both
    nearest = (
        np.linalg.norm(scene.vertices[:, :2] - scene.centre[:2], axis=1).max() + (0.15 + thickness / 2) * scene.size
    )
    distance = max(nearest, scene.size * rng.uniform(*_DISTANCE))
    look_over = scene.centre[2] - bottom + distance * np.tan(np.radians(scene.elevation_deg[0]))
    height = _CLEARANCE * look_over * rng.uniform(0.5, 1.0)
    direction = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    centre = np.array([scene.centre[0], scene.centre[1], bottom + height / 2]) + distance * direction
    half = np.array([scene.size * thickness / 2, scene.size * half_width, height / 2])
    return _box(centre, half, azimuth + np.radians(rng.uniform(-25, 25)))


def _box(centre: Float[ndarray, "3"], half: Float[ndarray, "3"], turn: float) -> Float[ndarray, "12 3 3"]:
    """Corners of the triangles of a cuboid, rotated about the vertical; seen from outside counter-clockwise."""
    triangles = []
    for axis in range(3):
        u, v = np.roll(np.eye(3), axis, axis=1)[1:]
        n = np.roll(np.eye(3), axis, axis=1)[0]
        for sign in (1.0, -1.0):
            a, b, c, d = (sign * n + s * sign * u + t * v for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
            triangles += [[a, b, c], [a, c, d]]
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return centre + np.array(triangles) * half @ R.T


def _flat_normals(corners: Float[ndarray, "f 3 3"]) -> Float[ndarray, "v 3"]:
    """The face's normal for each of its corners, so that shading keeps the edges sharp."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.repeat(normal, 3, axis=0)
