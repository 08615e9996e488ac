"""Objects that stand on z = 0, and surroundings for them; millimetres."""

from collections.abc import Callable

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from numpy import ndarray

from sl_nerfstudio.synthesis.scene import Scene
from sl_nerfstudio.synthesis.scenes import make_scene
from sl_nerfstudio.synthesis.sdf import capsule, ellipsoid, mesh_of, mirrored, union


def built_in(name: str) -> Scene:
    """A scene of sl-synth, lowered until it stands on z = 0."""
    scene = make_scene(name)
    low = np.array([0.0, 0.0, scene.vertices[:, 2].min()])
    return Scene(name, scene.vertices - low, scene.faces, scene.vertex_normals, scene.elevation_deg)


def medal() -> Scene:
    """80 mm wide and 3 mm thick, with a rim, and a relief of up to 2 mm on both sides."""
    return _relief("medal", lambda x, y: np.hypot(x, y) < 40.0, 3.0, rim=True)


def plaque() -> Scene:
    """110 x 80 mm, 6 mm thick, with a low relief in the middle of a plain ground."""
    return _relief("plaque", lambda x, y: (np.abs(x) < 55) & (np.abs(y) < 40), 6.0, rim=False)


def _relief(
    name: str, inside: Callable[[ndarray, ndarray], ndarray], thickness: float, rim: bool
) -> Scene:
    """A height field with vertical edges."""
    n, half = 480, 60.0
    at = (np.arange(n) + 0.5) / n * 2 * half - half
    x, y = np.meshgrid(at, at, indexing="ij")
    r = np.hypot(x, y)
    height = thickness + 2.0 * np.exp(-((r / 16) ** 4)) * (0.6 + 0.4 * np.sin(x / 3) * np.cos(y / 4))
    if rim:
        height += 1.0 * (r > 37)
    height = np.where(inside(x, y), height, 0.0)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    vertices = np.stack([x, y, height], -1).reshape(-1, 3)
    return _compact(name, vertices, faces[(vertices[faces, 2] > 0).any(1)])


def chair() -> Scene:
    """Thin legs, a seat and a back with slats."""
    parts = [trimesh.creation.box((40, 40, 4), _at(0, 0, 45))]
    parts += [trimesh.creation.box((4, 4, 45), _at(x, y, 22.5)) for x in (-18, 18) for y in (-18, 18)]
    parts += [trimesh.creation.box((4, 4, 55), _at(x, 18, 72)) for x in (-18, -6, 6, 18)]
    parts += [trimesh.creation.box((40, 4, 6), _at(0, 18, 98))]
    return _joined("chair", parts)


def box() -> Scene:
    """Flat sides."""
    return _joined("box", [trimesh.creation.box((70, 50, 90), _at(0, 0, 45))])


def vase() -> Scene:
    """A surface of revolution."""
    z = np.linspace(0, 110, 120)
    radius = 22 + 14 * np.sin(z / 110 * 2.2 * np.pi) + 4 * (z / 110)
    outline = np.stack([np.concatenate([[0], radius, [0]]), np.concatenate([[0], z, [108]])], 1)
    return _joined("vase", [trimesh.creation.revolve(outline, sections=180)])


def dog() -> Scene:
    """Legs, a tail and a head."""
    legs = mirrored(union(2.0, capsule((14, -28, 40), (14, -28, 3), 7, 4), capsule((14, 28, 40), (14, 30, 3), 8, 4)))
    body = ellipsoid((0, 0, 52), (19, 42, 18))
    head = union(4.0, ellipsoid((0, -52, 76), (12, 16, 13)), capsule((0, -62, 72), (0, -78, 68), 8, 5),
                 capsule((0, -36, 60), (0, -48, 74), 10, 9), mirrored(capsule((8, -46, 86), (10, -44, 96), 4, 2)))  # fmt: skip
    tail = capsule((0, 40, 60), (0, 66, 84), 4, 2)
    return mesh_of("dog", union(4.0, body, legs, head, tail), (-40, -95, -6), (40, 80, 110), 1.2)


OBJECTS: dict[str, Callable[[], Scene]] = {
    "frog": lambda: built_in("frog"), "head": lambda: built_in("head"), "cone": lambda: built_in("cone-and-cylinder"),
    "medal": medal, "plaque": plaque, "chair": chair, "box": box, "vase": vase, "dog": dog,
}  # fmt: skip
BACKGROUNDS = ("none", "table", "walls", "plate")


def surroundings(name: str, scene: Scene) -> Scene | None:
    """A large table, one with two walls, a round plate whose edge is seen, or nothing."""
    s, z = scene.size, float(scene.vertices[:, 2].min())
    if name == "none":
        return None
    if name == "plate":
        return _joined(name, [trimesh.creation.cylinder(1.4 * s, 8.0, sections=96, transform=_at(0, 0, z - 4.0))])
    parts = [trimesh.creation.box((14 * s, 14 * s, 10.0), _at(0, 0, z - 5.0))]
    if name == "walls":
        parts += [trimesh.creation.box((14 * s, 10.0, 8 * s), _at(0, 1.7 * s, z + 4 * s)),
                  trimesh.creation.box((10.0, 14 * s, 8 * s), _at(-2.2 * s, 0, z + 4 * s))]  # fmt: skip
    return _joined(name, parts)


def in_the_room(scene: Scene, p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
    """Places in front of both walls."""
    return (p_world[:, 1] < 1.6 * scene.size) & (p_world[:, 0] > -2.1 * scene.size)


def together(scene: Scene, other: Scene | None) -> Scene:
    """One scene; the faces of the first come first."""
    if other is None:
        return scene
    return Scene(
        f"{scene.name} {other.name}",
        np.concatenate([scene.vertices, other.vertices]),
        np.concatenate([scene.faces, other.faces + len(scene.vertices)]),
        elevation_deg=scene.elevation_deg,
    )


def _at(x: float, y: float, z: float) -> Float[ndarray, "4 4"]:
    return trimesh.transformations.translation_matrix((x, y, z))


def _joined(name: str, parts: list[trimesh.Trimesh]) -> Scene:
    whole = trimesh.util.concatenate(parts)
    return Scene(name, np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int64))


def _compact(name: str, vertices: Float[ndarray, "v 3"], faces: ndarray) -> Scene:
    used, place = np.unique(faces, return_inverse=True)
    return Scene(name, vertices[used], place.reshape(faces.shape).astype(np.int64))
