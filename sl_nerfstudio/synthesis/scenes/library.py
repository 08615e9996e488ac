"""Scenes by name, and from mesh files."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.synthesis.scenes.chair import chair
from sl_nerfstudio.synthesis.scenes.cone_and_cylinder import cone_and_cylinder
from sl_nerfstudio.synthesis.scenes.dog import dog
from sl_nerfstudio.synthesis.scenes.frog import frog
from sl_nerfstudio.synthesis.scenes.head import head
from sl_nerfstudio.synthesis.scenes.leaf import leaf
from sl_nerfstudio.synthesis.scenes.medal import medal
from sl_nerfstudio.synthesis.scenes.scene import Scene
from sl_nerfstudio.synthesis.scenes.vase import vase
from sl_nerfstudio.synthesis.scenes.weak_geometry import bottle, bump, relief, rod, spheres, staircase

MESH_FORMATS = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
BUILT_IN: dict[str, Callable[[], Scene]] = {
    "cone-and-cylinder": cone_and_cylinder,
    "head": head,
    "frog": frog,
    "chair": chair,
    "leaf": leaf,
    "dog": dog,
    "vase": vase,
    "medal": medal,
    "staircase": staircase,
    "bottle": bottle,
    "spheres": spheres,
    "bump": bump,
    "relief": relief,
    "rod": rod,
}


def make_scene(name: str, file_unit: float = 1.0) -> Scene:
    """A built-in scene, or the mesh in a file whose unit is `file_unit` millimetres.

    Raises UserError for a name that is neither.
    """
    if name in BUILT_IN:
        return _built_in(name)
    path = Path(name)
    if path.suffix.lower() not in MESH_FORMATS:
        raise UserError(
            f"--scene {name}: neither a built-in scene ({', '.join(BUILT_IN)}) "
            f"nor a mesh file ({' '.join(MESH_FORMATS)})"
        )
    return _read_mesh(path, file_unit)


@cache
def _built_in(name: str) -> Scene:
    """Meshed once in a process: of the finest that takes seconds. Nobody may write to it."""
    scene = BUILT_IN[name]()
    for values in (scene.vertices, scene.faces, scene.vertex_normals):
        if values is not None:
            values.flags.writeable = False
    return scene


def _read_mesh(path: Path, file_unit: float) -> Scene:
    import trimesh

    if not path.is_file():
        raise UserError(f"--scene {path}: there is no such file")
    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False)
        vertices = np.asarray(mesh.vertices, dtype=np.float64) * file_unit
        faces = np.asarray(mesh.faces, dtype=np.int64)
    except Exception as error:  # trimesh's loaders raise whatever their parsers do
        raise UserError(f"--scene {path}: cannot be read as a mesh ({error}); export it again as PLY") from error
    if len(faces) == 0 or not np.isfinite(vertices).all() or np.ptp(vertices, axis=0).max() <= 0:
        raise UserError(f"--scene {path}: has no surface (no faces, or all in one place); a point cloud is not enough")
    return Scene(path.stem, vertices, faces)
