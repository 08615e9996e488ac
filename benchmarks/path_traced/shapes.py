"""The shapes: meshes that other packages carry as data, and scenes of our own; all stand on z upwards, in mm."""

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray

from benchmarks.path_traced.rendering import Body, Matter
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.synthesis.scenes import make_scene
from sl_nerfstudio.synthesis.sdf import Scene

_SIZE = 120.0  # longest side of a shape, mm
_EDGES = 110  # of triangles, along the longest side: colours vary from vertex to vertex
_CREASE = np.radians(30.0)  # edges that are sharper stay sharp in the shading


@dataclass(frozen=True)
class _File:
    """A mesh in the data of another package, which need not be importable: its files are enough."""

    package: str
    path: str
    wheel: str

    def read(self) -> trimesh.Trimesh:
        """Raises UserError if the package is not there."""
        found = importlib.util.find_spec(self.package)
        file = None if found is None or found.origin is None else Path(found.origin).parent / self.path
        if file is None or not file.exists():
            raise UserError(
                f"{self.package}/{self.path} is not there: the shape is part of that package\n"
                f"    remedy: pip install --no-deps {self.wheel}"
            )
        mesh: Any = trimesh.load(file, force="mesh")
        return mesh


_DOG, _GRIPPERS = "suite/dog_assets/", "models/assets/grippers/meshes/"
FILES: dict[str, tuple[_File, ...]] = {
    "skull": (_File("dm_control", f"{_DOG}BONEMergedSkull.stl", "dm_control"),),  # free-form
    "ribs": (_File("dm_control", f"{_DOG}BONERibcage.stl", "dm_control"),),  # thin and ribbed
    "hound": (_File("dm_control", f"{_DOG}SKINbody.stl", "dm_control"),),  # an animal with legs
    "gripper": (_File("robosuite", f"{_GRIPPERS}robotiq_s_gripper/palm_vis.stl", "robosuite"),),  # machined
    "wrist": (_File("robosuite", f"{_GRIPPERS}jaco_three_finger_gripper/hand_3finger.stl", "robosuite"),),
    "skull-and-vertebra": (
        _File("dm_control", f"{_DOG}BONEMergedSkull.stl", "dm_control"),
        _File("dm_control", f"{_DOG}BONESacrum.stl", "dm_control"),
    ),
}  # fmt: skip
"""Shapes whose meshes come with other packages; of two things, the second stands beside the first."""
OURS = ("medal", "knob", "flange", "disc", "gear", "frog", "leaf")
"""A flat relief, parts that are nearly round, free-form and thin: scenes of `sl_nerfstudio.synthesis`."""


def shape_of(name: str, seed: int) -> Scene:
    """A shape in mm about the origin. Raises UserError if the package that carries it is not installed."""
    if name in OURS:
        return make_scene(name, seed=seed)
    first, *others = [file.read() for file in FILES[name]]
    for other in others:
        other.apply_scale(0.55 * first.extents.max() / other.extents.max())
        (x, y, z), (low, high) = first.bounds[0], other.bounds
        other.apply_translation([x - low[0], y - 0.08 * first.extents.max() - high[1], z - low[2]])
    mesh: Any = trimesh.util.concatenate([first, *others]) if others else first
    mesh.apply_scale(_SIZE / mesh.extents.max())
    mesh.apply_translation(-mesh.bounds.mean(0))
    return Scene(name, np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


@dataclass(frozen=True)
class _Paint:
    """Base colour (mean of the three channels, how colourful), how uneven, and the surface."""

    tone: float
    colourful: float
    uneven: float
    roughness: float
    specular: float = 0.5
    coat: float = 0.0


MATTERS: dict[str, _Paint] = {
    "matte": _Paint(0.6, 0.05, 0.1, 0.8, 0.3),
    "glossy": _Paint(0.5, 0.15, 0.15, 0.3, 0.5, 0.6),
    "dark": _Paint(0.07, 0.2, 0.2, 0.5),
    "textured": _Paint(0.45, 0.4, 0.6, 0.6),
}
"""What objects are made of."""


def body_of(scene: Scene, matter: str, rng: np.random.Generator) -> Body:
    """A scene with its matter: triangles small enough for the colours, normals smooth except across creases."""
    size = _SIZE if scene.name == "surroundings" else scene.size
    vertices, faces = scene.vertices, scene.faces
    normals = scene.vertex_normals
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max()
    if normals is None or longest > 2 * size / _EDGES:
        vertices, faces = trimesh.remesh.subdivide_to_size(vertices, faces, 2 * size / _EDGES, 20)[:2]
        smooth = trimesh.graph.smooth_shade(trimesh.Trimesh(vertices, faces), angle=_CREASE)
        vertices, faces, normals = smooth.vertices, smooth.faces, smooth.vertex_normals
    paint = MATTERS[matter]
    colour = _colours(np.asarray(vertices, np.float64) / size, paint, rng)
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)
    return Body(mesh, Matter(colour, paint.roughness, paint.specular, paint.coat))


def _colours(p: Float[ndarray, "v 3"], paint: _Paint, rng: np.random.Generator) -> Float[ndarray, "v 3"]:
    """A base colour with stains of another one, from waves in space; `p` in sizes of the object."""

    def wave(length: float) -> Float[ndarray, "v"]:
        number = 2 * np.pi / length * rng.normal(size=(3, 6))
        return np.sin(p @ number + rng.uniform(0, 2 * np.pi, 6)).mean(1)

    base, other = (paint.tone * np.exp(rng.normal(0, paint.colourful, 3)) for _ in range(2))
    cloudy = 1 + paint.uneven * (wave(0.5) + 0.7 * wave(0.12))
    stains = 1 / (1 + np.exp(-30 * (wave(0.3) + 0.4 * wave(0.08) - 0.25))) * min(1.0, 2 * paint.uneven)
    return np.clip((base + stains[:, None] * (other - base)) * cloudy[:, None], 0.01, 0.95)
