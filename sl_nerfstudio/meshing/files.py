"""Meshes as files, PLY, OBJ, STL and GLB, chosen by the suffix; and point clouds, PLY and LAS.

trimesh reads them. What writes them is our own: trimesh's PLY rounds positions to float32 and has no comment for the
unit, and its GLB takes sRGB colours of vertices for linear ones.
"""

import io
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.mesh import GREY, Charts, Mesh, Texture, VertexProperties, VertexQuality, as_linear
from sl_nerfstudio.scan.document import FileError, check_file
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.scan.types import UNITS
from sl_nerfstudio.storage import write_atomic

# Unit and axes of mesh files: glTF has both, STL has a customary unit, PLY and OBJ have neither.

Y_UP_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns z up into y up, as programs do that read and write glTF: (x, y, z) becomes (x, z, -y)."""


def file_from_world(suffix: str, units: str) -> Similarity:
    """Map a scan's world and unit to what a mesh file holds.

    glTF (.glb) is in metres with y up by its specification; STL (.stl) in millimetres by custom, in the scan's axes.
    One arbitrary unit becomes one of the file's.
    """
    metres = UNITS[units]
    if suffix == ".glb":
        return Similarity(metres or 1.0, Y_UP_Z_UP, np.zeros(3))
    return Similarity.scaling(metres * 1000 if suffix == ".stl" and metres else 1.0)


# PLY files with properties of vertices: what a mesh is worth at each of its vertices.

_COLOUR = ("red", "green", "blue")
_TYPES = {"double": "<f8", "float": "<f4", "int": "<i4", "ushort": "<u2", "uchar": "u1"}  # not all programs read ushort


def encode_ply(mesh: Mesh, properties: VertexProperties | None = None, unit: str = "") -> bytes:
    """A binary PLY: positions in float64, normals, and the properties of each vertex, if they are given.

    `unit` is said in a comment of the header.
    """
    columns = _columns(mesh.vertices, mesh.vertex_normals(), properties)
    return _encode(columns, [f"lengths in {unit}"] if unit else [], mesh)


DEVIATIONS = "deviations from"
"""How the first comment of a PLY with deviations begins."""


def encode_deviations(
    mesh: Mesh,
    deviation: Float64[ndarray, "v"],
    sigma: Float64[ndarray, "v"],
    colour: UInt8[ndarray, "v 3"],
    notes: Sequence[str],
) -> bytes:
    """A binary PLY with `deviation` and `sigma` of every vertex; `notes` are comments: unit, axes, legend."""
    columns = _columns(mesh.vertices, mesh.vertex_normals(), None)
    columns |= {name: ("uchar", colour[:, k]) for k, name in enumerate(_COLOUR)}
    return _encode(columns | {"deviation": ("float", deviation), "sigma": ("float", sigma)}, notes, mesh)


def _columns(
    points: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"], properties: VertexProperties | None
) -> dict[str, tuple[str, ndarray]]:
    columns: dict[str, tuple[str, ndarray]] = {axis: ("double", points[:, k]) for k, axis in enumerate("xyz")}
    columns |= {f"n{axis}": ("float", normals[:, k]) for k, axis in enumerate("xyz")}
    if properties is None:
        return columns
    if properties.colour is not None:
        columns |= {name: ("uchar", properties.colour[:, k]) for k, name in enumerate(_COLOUR)}
    quality = properties.quality
    return columns | {
        "sigma": ("float", quality.sigma),
        "sigma_independent": ("float", quality.sigma_independent),
        "views": ("int", quality.views),
        "residual": ("float", quality.residual),
        "ray_angle": ("float", quality.ray_angle),
        "invented": ("uchar", properties.invented),
    }


def _encode(columns: dict[str, tuple[str, ndarray]], notes: Sequence[str], mesh: Mesh | None = None) -> bytes:
    """Header, vertices, and the triangles of a mesh; `notes` are comments."""
    faces = np.empty(0 if mesh is None else len(mesh.faces), dtype=[("count", "u1"), ("corner", "<i4", (3,))])
    if mesh is not None:
        faces["count"], faces["corner"] = 3, mesh.faces
    rows = np.empty(len(columns["x"][1]), dtype=[(name, _TYPES[kind]) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        rows[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {note}" for note in notes),
        f"element vertex {len(rows)}",
        *(f"property {kind} {name}" for name, (kind, _) in columns.items()),
        *([] if mesh is None else [f"element face {len(faces)}", "property list uchar int vertex_indices"]),
        "end_header\n",
    ]
    return "\n".join(header).encode("ascii") + rows.tobytes() + faces.tobytes()


def read_quality(path: Path | str) -> VertexQuality | None:
    """Read what `encode_ply` wrote with a mesh; None for any other file."""
    rows = _read_rows(path)
    if rows is None or not {"sigma", "views"} <= set(rows.dtype.names or ()):
        return None

    def column(name: str) -> Float64[ndarray, "v"]:
        return rows[name].astype(np.float64) if name in rows.dtype.names else np.full(len(rows), np.nan)

    sigma, independent, residual, angle = map(column, ("sigma", "sigma_independent", "residual", "ray_angle"))
    return VertexQuality(sigma, independent, rows["views"].astype(np.int64), residual, angle)


def read_colour(path: Path | str) -> UInt8[ndarray, "v 3"] | None:
    """The colours of the vertices of a PLY file, as `encode_ply` writes them; None for any other file."""
    rows = _read_rows(path)
    if rows is None or any(rows.dtype.fields.get(name, (None,))[0] != np.uint8 for name in _COLOUR):
        return None
    return np.stack([rows[name] for name in _COLOUR], 1)


def _read_rows(path: Path | str) -> ndarray | None:
    """The vertices of a binary PLY file, one row each; None for any other file."""
    with Path(path).open("rb") as stream:
        if stream.read(3) != b"ply":
            return None
        head, mark, _ = (b"ply" + stream.read(65536)).partition(b"end_header\n")
        if not mark or b"format binary_little_endian" not in head:
            return None
        text = head.decode("ascii", "replace")
        count = re.search(r"element vertex (\d+)\n((?:property \w+ \w+\n)+)element face", text)
        if count is None:
            return None
        fields = re.findall(r"property (\w+) (\w+)\n", count[2])
        if any(kind not in _TYPES for kind, _ in fields) or len({name for _, name in fields}) < len(fields):
            return None
        stream.seek(len(head) + len(mark))
        row = np.dtype([(name, _TYPES[kind]) for kind, name in fields])
        content = stream.read(int(count[1]) * row.itemsize)
    return np.frombuffer(content, row) if len(content) == int(count[1]) * row.itemsize else None


# Meshes as bytes of OBJ and STL files.

MATERIAL = "surface"


def encode_obj(mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None, charts: Charts | None, library: str) -> bytes:
    """OBJ text with normals; colours follow the positions, where most programs look for them, if there are no `charts`.

    `library` is the name of the material file. Positions have 8 decimals. Texture coordinates are counted upwards.
    """
    rows, line = mesh.vertices, "v {:.8f} {:.8f} {:.8f}"
    if colour is not None and charts is None:
        rows, line = np.concatenate([rows, colour / 255.0], 1), line + " {:.4f} {:.4f} {:.4f}"
    text = [f"mtllib {library}", *map(line.format, *rows.T.tolist())]
    text += map("vn {:.6f} {:.6f} {:.6f}".format, *mesh.vertex_normals().T.tolist())
    corners, line = mesh.faces, "f {0}//{0} {1}//{1} {2}//{2}"
    if charts is not None:
        text += map("vt {:.7f} {:.7f}".format, charts.uv[:, 0].tolist(), (1.0 - charts.uv[:, 1]).tolist())
        corners, line = np.concatenate([corners, charts.corners], 1), "f {0}/{3}/{0} {1}/{4}/{1} {2}/{5}/{2}"
    text += [f"usemtl {MATERIAL}", *map(line.format, *(corners + 1).T.tolist())]
    return ("\n".join(text) + "\n").encode()


def encode_mtl(coloured: bool, image: str | None) -> bytes:
    """The material of an OBJ: matt and grey, or white under the colours of the vertices or of the file `image`."""
    diffuse = "1 1 1" if coloured or image is not None else " ".join(3 * [f"{GREY / 255:.4f}"])
    texture = "" if image is None else f"map_Kd {image}\n"
    return f"newmtl {MATERIAL}\nKa 0 0 0\nKd {diffuse}\nKs 0 0 0\nd 1\nillum 1\n{texture}".encode()


def encode_stl(mesh: Mesh, unit: str) -> bytes:
    """Binary STL; its header names the unit."""
    import trimesh
    from trimesh.exchange.stl import export_stl

    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return f"binary STL, lengths in {unit}".encode().ljust(80) + export_stl(surface)[80:]


# Meshes as bytes of GLB files: binary glTF 2.0.

_FLOAT, _UINT, _USHORT = 5126, 5125, 5123  # component types of glTF
_VERTICES, _INDICES = 34962, 34963  # targets of glTF's buffer views
_LINEAR, _LINEAR_MIPMAPS, _CLAMPED = 9729, 9987, 33071  # how textures are filtered, and continued beyond their sides


def encode_glb(mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None, texture: Texture | None = None) -> bytes:
    """A mesh in glTF's own unit and axes: positions, normals, colours or else a texture, one matt material."""
    arrays = _attributes(mesh, colour, texture)
    faces = mesh.faces if texture is None else texture.charts.corners
    parts = [array.tobytes() for array in [*arrays.values(), faces.astype("<u4").reshape(-1)]]
    accessors = [_accessor(k, array) for k, array in enumerate(arrays.values())]
    accessors.append({"bufferView": len(arrays), "componentType": _UINT, "count": faces.size, "type": "SCALAR"})
    targets: list[int | None] = [*[_VERTICES] * len(arrays), _INDICES]
    primitive = {"attributes": {name: k for k, name in enumerate(arrays)}, "indices": len(arrays), "material": 0}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "sl_nerfstudio"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": MATERIAL}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_material(grey=colour is None and texture is None, textured=texture is not None)],
        "accessors": accessors,
    }
    if texture is not None:
        parts.append(encode_png(texture.image))
        targets.append(None)
        document["images"] = [{"bufferView": len(parts) - 1, "mimeType": "image/png"}]
        filters = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAPS}
        document["samplers"] = [{**filters, "wrapS": _CLAMPED, "wrapT": _CLAMPED}]
        document["textures"] = [{"sampler": 0, "source": 0}]
    views, at = [], 0
    for part, target in zip(parts, targets, strict=True):
        view = {"buffer": 0, "byteOffset": at, "byteLength": len(part)}
        views.append(view if target is None else {**view, "target": target})
        at += len(part)
    document["bufferViews"] = views
    document["buffers"] = [{"byteLength": at}]
    return _container(document, b"".join(parts))


def _attributes(mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None, texture: Texture | None) -> dict[str, ndarray]:
    """Attributes of the vertices, or of the corners of charts, each of which has one texture coordinate."""
    found = {"POSITION": mesh.vertices.astype("<f4"), "NORMAL": mesh.vertex_normals().astype("<f4")}
    if texture is not None:
        found = {name: values[texture.charts.vertex] for name, values in found.items()}
        return found | {"TEXCOORD_0": texture.charts.uv.astype("<f4")}
    if colour is not None:
        opaque = np.full((len(colour), 1), 65535, dtype="<u2")
        found["COLOR_0"] = np.concatenate([_linear(colour), opaque], 1)
    return found


def _material(grey: bool, textured: bool) -> dict[str, Any]:
    shade = float(_linear(np.array([GREY], np.uint8))[0]) / 65535 if grey else 1.0
    surface: dict[str, Any] = {"baseColorFactor": [*[shade] * 3, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    if textured:
        surface["baseColorTexture"] = {"index": 0}
    return {"name": MATERIAL, "doubleSided": True, "pbrMetallicRoughness": surface}


def _accessor(view: int, array: ndarray) -> dict[str, Any]:
    found: dict[str, Any] = {
        "bufferView": view,
        "componentType": {"f4": _FLOAT, "u2": _USHORT}[array.dtype.str[1:]],
        "count": len(array),
        "type": f"VEC{array.shape[1]}",
    }
    if array.dtype == np.uint16:
        found["normalized"] = True
    if view == 0:  # positions must state their box
        found |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
    return found


def _linear(colour: UInt8[ndarray, "*n"]) -> UInt16[ndarray, "*n"]:
    """sRGB as linear light with 16 bits: colours of vertices are linear in glTF."""
    return np.round(as_linear(colour / 255.0) * 65535).astype("<u2")


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    """The container: a header, then JSON and data, each padded to four bytes."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    head = b"glTF" + np.array([2, size], "<u4").tobytes()
    chunks = np.uint32(len(text)).tobytes() + b"JSON" + text + np.uint32(len(binary)).tobytes() + b"BIN\0" + binary
    return head + chunks


# LAS 1.4 point clouds, which surveying programs read; written by laspy, an optional package.

_PLAIN, _COLOURED = 6, 7  # point formats
_STEPS = 2**30  # of the largest extent: coordinates are whole numbers


def require_laspy(path: Path) -> None:
    """Raise UserError if laspy is not installed."""
    try:
        import laspy  # noqa: F401
    except ImportError as error:
        raise UserError(
            f"{path}: LAS files need the package laspy\n"
            "    remedy: pip install 'sl-nerfstudio[las]', or give a name that ends in .ply"
        ) from error


def encode_las(
    points_m: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"], properties: VertexProperties, unit_m: float
) -> bytes:
    """Points in metres with the further dimensions `nx ny nz sigma views residual`; `unit_m` is the unit of `sigma`."""
    import laspy

    header = laspy.LasHeader(point_format=_PLAIN if properties.colour is None else _COLOURED, version="1.4")
    header.offsets = points_m.mean(0)
    finest = max(float(np.ptp(points_m, axis=0).max()), 1e-9) / _STEPS
    header.scales = np.full(3, 10.0 ** math.ceil(math.log10(finest)))  # readers show so many decimals
    header.offsets = np.round(header.offsets / header.scales) * header.scales
    quality = properties.quality
    extra: dict[str, tuple[type, ndarray]] = {f"n{axis}": (np.float32, normals[:, k]) for k, axis in enumerate("xyz")}
    extra |= {
        "sigma": (np.float32, quality.sigma * unit_m),
        "views": (np.uint16, quality.views),
        "residual": (np.float32, quality.residual),
    }
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind) for name, (kind, _) in extra.items()])
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points_m.T
    for name, (kind, values) in extra.items():
        cloud[name] = values.astype(kind)
    if properties.colour is not None:
        cloud.red, cloud.green, cloud.blue = (properties.colour.astype(np.uint16) * 257).T
    buffer = io.BytesIO()
    cloud.write(buffer, do_compress=False)
    return buffer.getvalue()


# Points of a surface as files of their own: what frames measured, without triangles.

POINT_SUFFIXES = (".ply", ".las")


def observed_points(
    mesh: Mesh, properties: VertexProperties
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"], VertexProperties]:
    """The vertices that at least one frame confirms, their normals, and their properties."""
    chosen = np.flatnonzero(properties.quality.views > 0)
    return mesh.vertices[chosen], mesh.vertex_normals()[chosen], properties.chosen(chosen)


def write_points(
    path: Path,
    points: Float64[ndarray, "n 3"],
    normals: Float64[ndarray, "n 3"],
    properties: VertexProperties,
    units: str,
) -> int:
    """Write a point cloud in the scan's axes, and give its size; .ply in the scan's unit, .las in metres.

    Raises UserError if there are no points.
    """
    if not len(points):
        raise UserError(
            f"{path}: not written, there is no point\n"
            "    cause:  no frame confirms any part of the surface\n"
            "    remedy: train it to its last step; if that was done, find the poses anew with sl-process"
        )
    metres = UNITS[units] or 1.0
    if path.suffix.lower() == ".las":
        write_atomic(path, encode_las(points * metres, normals, properties, metres))
    else:
        write_atomic(path, _encode(_columns(points, normals, properties), [f"lengths in {units}"]))
    return len(points)


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
    path: Path | str,
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
    path = Path(path)
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
            "    remedy: train again; if it happens again, find the poses anew with sl-process"
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


def read_mesh(path: Path | str, units: str = "arbitrary") -> Mesh:
    """Read the triangles of a mesh file, all parts of it in one; polygons are cut into triangles.

    GLB, which is in metres with y up, and STL, in millimetres, are taken into a world with z up whose lengths are in
    `units`; one of their units is one arbitrary unit. PLY and OBJ stay as they are.
    Vertices at the same place are merged only in STL, which cannot share them, and where there is a texture: charts do
    not share them. Raises UserError if the file is missing, empty, damaged, too large, without triangles, refers to
    vertices that do not exist, or holds values that are not numbers.
    """
    path = Path(path)
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
