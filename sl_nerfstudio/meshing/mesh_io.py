"""Meshes as files: PLY, OBJ, STL and GLB, chosen by the suffix."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.files.atomic import write_atomic
from sl_nerfstudio.meshing.formats.encode import encode_mtl, encode_obj, encode_stl
from sl_nerfstudio.meshing.formats.file_frame import file_from_world
from sl_nerfstudio.meshing.formats.glb import encode_glb
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.ply import encode_ply
from sl_nerfstudio.meshing.texture.texture import Texture
from sl_nerfstudio.meshing.vertex_properties import VertexProperties
from sl_nerfstudio.scan.file_error import FileError, check_file
from sl_nerfstudio.scan.images import encode_png

SUFFIXES = (".ply", ".obj", ".stl", ".glb")
TEXTURE_SUFFIXES = (".glb", ".obj")
MAX_TRIANGLES = 200_000_000  # about 10 GB once read


def check_suffix(path: Path) -> str:
    """The suffix in lower case. Raises UserError, naming the choices, if it is not a known one."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        problem = f"unknown kind of mesh file {path.suffix!r}" if suffix else "the name of a mesh file needs a suffix"
        raise UserError(
            f"{path}: {problem}\n"
            f"    cause:  the suffix chooses the format\n    remedy: end the name in one of {', '.join(SUFFIXES)}"
        )
    return suffix


def files_of(path: Path, textured: bool = False) -> tuple[Path, ...]:
    """All files that `write_mesh` writes for a path: OBJ has a second one for its material, a third for its texture."""
    if path.suffix.lower() != ".obj":
        return (path,)
    return (path, path.with_suffix(".mtl"), *([path.with_suffix(".png")] if textured else []))


def write_mesh(
    path: Path,
    mesh: Mesh,
    properties: VertexProperties | None = None,
    units: str = "arbitrary",
    texture: Texture | None = None,
) -> None:
    """Write a mesh of a scan's world, whose lengths are in `units`; each file appears complete or not at all.

    PLY keeps float64 and the scan's unit and axes, and holds normals and all `properties`. The others hold the colours
    of `properties` alone (STL: nothing) or the `texture` in their place, and are rounded: OBJ, with .mtl and .png
    beside it, to 8 decimals, STL and GLB to float32. STL, without shared vertices, is in millimetres, GLB in metres
    with y up: see `file_from_world`. Raises UserError for an unknown suffix, a mesh without triangles, a vertex that is
    not a number, or a place where writing is impossible; ValueError for a texture where the format has none.
    """
    suffix = check_suffix(path)
    if texture is not None and suffix not in TEXTURE_SUFFIXES:
        raise ValueError(f"{suffix} files have no texture")
    if len(mesh.faces) == 0:
        raise UserError(
            f"{path}: not written, the mesh has no triangles\n"
            "    cause:  no surface was found, or nothing of it was observed by any frame\n"
            "    remedy: look at the run in ns-viewer; sl-export --keep-unobserved writes the whole surface"
        )
    if not np.isfinite(mesh.vertices).all():
        raise UserError(
            f"{path}: not written, {int((~np.isfinite(mesh.vertices)).any(1).sum())} vertices are not numbers\n"
            "    cause:  the training diverged, or the scan's poses are wrong\n"
            "    remedy: check the scan with sl-check and train again"
        )
    placed = mesh.mapped(file_from_world(suffix, units))
    colour = None if properties is None else properties.colour
    if suffix == ".ply":
        write_atomic(path, encode_ply(placed, properties, units))
    elif suffix == ".obj":
        _, material, *image = files_of(path, texture is not None)
        if texture is not None:
            write_atomic(image[0], encode_png(texture.image))
        write_atomic(material, encode_mtl(colour is not None, image[0].name if image else None))
        write_atomic(path, encode_obj(placed, colour, None if texture is None else texture.charts, material.name))
    elif suffix == ".stl":
        write_atomic(path, encode_stl(placed, "arbitrary units" if units == "arbitrary" else "mm"))
    else:
        write_atomic(path, encode_glb(placed, colour, texture))


def read_mesh(path: Path, units: str = "arbitrary") -> Mesh:
    """Read the triangles of a mesh file, all parts of it in one; polygons are cut into triangles.

    GLB, which is in metres with y up, and STL, in millimetres, are taken into a world with z up whose lengths are in
    `units`; one of their units is one arbitrary unit. PLY and OBJ stay as they are.
    Vertices at the same place are merged only in STL, which cannot share them, and where there is a texture: charts do
    not share them. Raises UserError if the file is missing, empty, damaged, too large, without triangles, refers to
    vertices that do not exist, or holds values that are not numbers.
    """
    suffix = check_suffix(path)
    check_file(path)
    try:
        vertices, faces = _load(path, suffix)
    except MemoryError as error:
        raise FileError(
            path, "does not fit into memory", "a huge or damaged mesh", "decimate or export it again"
        ) from error
    except Exception as error:  # every loader fails in its own way on a damaged file
        problem = f"cannot be read as {suffix[1:].upper()} ({first_line(error)})"
        cause = "the file is truncated, damaged or of another kind"
        raise FileError(path, problem, cause, "export or copy it again") from error
    if suffix == ".ply":
        _check_ply_counts(path, len(vertices), len(faces))
    return _checked(path, vertices, faces).mapped(file_from_world(suffix, units).inverse())


def _check_ply_counts(path: Path, vertices: int, faces: int) -> None:
    """The loader accepts a truncated text file; the header says how much there should be."""
    with path.open("rb") as stream:
        header = stream.read(65536).split(b"end_header")[0].decode("ascii", "replace")
    stated = {kind: int(count) for kind, count in re.findall(r"element (vertex|face) (\d+)", header)}
    stated = {"vertex": 0, "face": 0, **stated}
    if vertices < stated["vertex"] or faces < stated["face"]:
        problem = (
            f"should hold {stated['vertex']} vertices and {stated['face']} faces, but {vertices} and {faces} were read"
        )
        raise FileError(path, problem, "the file is truncated or damaged", "export or copy it again")


def _load(path: Path, suffix: str) -> tuple[ndarray, ndarray]:
    import trimesh

    with path.open("rb") as stream:
        loaded: Any = trimesh.load_scene(stream, file_type=suffix[1:], process=False)
    parts = [g for g in loaded.dump() if isinstance(g, trimesh.Trimesh)]
    if not parts:
        clouds = [np.asarray(g.vertices) for g in loaded.geometry.values() if hasattr(g, "vertices")]
        return np.concatenate([np.empty((0, 3)), *clouds]), np.empty((0, 3))
    offsets = np.cumsum([0, *(len(p.vertices) for p in parts)])
    vertices = np.concatenate([np.asarray(p.vertices) for p in parts])
    faces = np.concatenate([np.asarray(p.faces) + o for p, o in zip(parts, offsets[:-1], strict=True)])
    if suffix == ".stl" or any(getattr(p.visual, "uv", None) is not None for p in parts):
        vertices, index = np.unique(vertices, axis=0, return_inverse=True)
        faces = index.reshape(-1)[faces]
    return vertices, faces


def _checked(path: Path, vertices: ndarray, faces: ndarray) -> Mesh:
    again = "export it again from the program that made it"
    if len(faces) == 0:
        problem = f"has no triangles: it holds {f'{len(vertices)} points only' if len(vertices) else 'nothing'}"
        raise FileError(path, problem, "a point cloud, an empty result, or a truncated file", "give a surface mesh")
    if len(faces) > MAX_TRIANGLES:
        raise FileError(path, f"has {len(faces)} triangles", f"{MAX_TRIANGLES} are supported", "decimate it first")
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise FileError(path, "has vertices that are not three numbers each", "the file is damaged", again)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise FileError(
            path, f"has triangles at vertices that do not exist (it has {len(vertices)})", "the file is damaged", again
        )
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    bad = ~np.isfinite(vertices).all(1)
    if bad.any():
        problem = f"has {int(bad.sum())} vertices that are not numbers, the first is number {int(bad.argmax())}"
        raise FileError(path, problem, "it was written by a computation that failed", again)
    if (reach := np.abs(vertices).max()) > 1e12:
        raise FileError(path, f"reaches out to {reach:.0e} units", "a damaged file or a wrong unit", again)
    mesh = Mesh(vertices, faces)
    if not mesh.face_areas().any():
        raise FileError(path, "has no triangle with an area", "a scale of 0, or an empty result", again)
    return mesh
