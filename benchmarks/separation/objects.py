"""Objects, and what surrounds them: those of sl-synth, and some that are hard to tell apart; millimetres."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from sl_nerfstudio.synthesis.render import Background, make_surroundings
from sl_nerfstudio.synthesis.scenes import BUILT_IN
from sl_nerfstudio.synthesis.sdf import Scene


def plaque() -> Scene:
    """110 x 80 mm, 6 mm thick, with a low relief in the middle of a plain ground."""
    n, half = 480, 60.0
    at = (np.arange(n) + 0.5) / n * 2 * half - half
    x, y = np.meshgrid(at, at, indexing="ij")
    height = 6.0 + 2.0 * np.exp(-((np.hypot(x, y) / 16) ** 4)) * (0.6 + 0.4 * np.sin(x / 3) * np.cos(y / 4))
    height = np.where((np.abs(x) < 55) & (np.abs(y) < 40), height, 0.0)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    vertices = np.stack([x, y, height], -1).reshape(-1, 3)
    return _compact("plaque", vertices, faces[(vertices[faces, 2] > 0).any(1)])


def box() -> Scene:
    """Flat sides."""
    return _joined("box", [trimesh.creation.box((70, 50, 90), _at(0, 0, 45))])


OBJECTS: dict[str, Callable[[], Scene]] = {**BUILT_IN, "box": box, "plaque": plaque}
BACKGROUNDS = ("none", "table", "walls", "room", "plate")


def surroundings(name: str, scene: Scene, rng: np.random.Generator) -> Scene | None:
    """What sl-synth puts around an object; or a room with a large table and two walls; or a round plate."""
    if name in ("none", "table", "walls"):
        return make_surroundings(scene, cast(Background, name), rng)
    s, z = scene.size, float(scene.vertices[:, 2].min()) - 1e-4 * scene.size
    if name == "plate":
        return _joined(name, [trimesh.creation.cylinder(s, 8.0, sections=96, transform=_at(0, 0, z - 4.0))])
    return _joined(name, [
        trimesh.creation.box((14 * s, 14 * s, 10.0), _at(0, 0, z - 5.0)),
        trimesh.creation.box((14 * s, 10.0, 8 * s), _at(0, 1.7 * s, z + 4 * s)),
        trimesh.creation.box((10.0, 14 * s, 8 * s), _at(-2.2 * s, 0, z + 4 * s)),
    ])  # fmt: skip


def in_the_room(scene: Scene, p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
    """Places in front of both walls of the room."""
    return (p_world[:, 1] < 1.6 * scene.size) & (p_world[:, 0] > -2.1 * scene.size)


def _at(x: float, y: float, z: float) -> Float[ndarray, "4 4"]:
    return trimesh.transformations.translation_matrix((x, y, z))


def _joined(name: str, parts: list[trimesh.Trimesh]) -> Scene:
    whole: Any = trimesh.util.concatenate(parts)
    return Scene(name, np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int64))


def _compact(name: str, vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "f 3"]) -> Scene:
    used, place = np.unique(faces, return_inverse=True)
    return Scene(name, vertices[used], place.reshape(faces.shape).astype(np.int64))
