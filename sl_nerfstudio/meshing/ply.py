"""PLY files with properties of vertices: what a mesh is worth at each of its vertices."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.vertex_properties import VertexProperties
from sl_nerfstudio.meshing.vertex_quality import VertexQuality

_TYPES = {"double": "<f8", "float": "<f4", "int": "<i4", "ushort": "<u2", "uchar": "u1"}  # not all programs read ushort


def encode_ply(mesh: Mesh, properties: VertexProperties | None = None, unit: str = "") -> bytes:
    """A binary PLY: positions in float64, normals, and the properties of each vertex, if they are given.

    `unit` is said in a comment of the header.
    """
    columns = _columns(mesh.vertices, mesh.vertex_normals(), properties)
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corner", "<i4", (3,))])
    faces["count"], faces["corner"] = 3, mesh.faces
    element = [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices"]
    return _encode(columns, unit, element) + faces.tobytes()


def encode_points(
    points: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"], properties: VertexProperties, unit: str
) -> bytes:
    """A binary PLY of points without triangles, with the same properties."""
    return _encode(_columns(points, normals, properties), unit, [])


def _columns(
    points: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"], properties: VertexProperties | None
) -> dict[str, tuple[str, ndarray]]:
    columns: dict[str, tuple[str, ndarray]] = {axis: ("double", points[:, k]) for k, axis in enumerate("xyz")}
    columns |= {f"n{axis}": ("float", normals[:, k]) for k, axis in enumerate("xyz")}
    if properties is None:
        return columns
    if properties.colour is not None:
        columns |= {name: ("uchar", properties.colour[:, k]) for k, name in enumerate(("red", "green", "blue"))}
    quality = properties.quality
    return columns | {
        "sigma": ("float", quality.sigma),
        "sigma_independent": ("float", quality.sigma_independent),
        "views": ("int", quality.views),
        "residual": ("float", quality.residual),
        "ray_angle": ("float", quality.ray_angle),
        "invented": ("uchar", properties.invented),
    }


def _encode(columns: dict[str, tuple[str, ndarray]], unit: str, element: list[str]) -> bytes:
    """Header and vertices; `element` are the header's lines of what follows them."""
    rows = np.empty(len(columns["x"][1]), dtype=[(name, _TYPES[kind]) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        rows[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *([f"comment lengths in {unit}"] if unit else []),
        f"element vertex {len(rows)}",
        *(f"property {kind} {name}" for name, (kind, _) in columns.items()),
        *element,
        "end_header\n",
    ]
    return "\n".join(header).encode("ascii") + rows.tobytes()


def read_quality(path: Path) -> VertexQuality | None:
    """What `encode_ply` wrote with a mesh; None for any other file."""
    with path.open("rb") as stream:
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
        if any(kind not in _TYPES for kind, _ in fields) or not {"sigma", "views"} <= {name for _, name in fields}:
            return None
        stream.seek(len(head) + len(mark))
        known = {name for _, name in fields}
        row = np.dtype([(name, _TYPES[kind]) for kind, name in fields])
        content = stream.read(int(count[1]) * row.itemsize)
    if len(content) < int(count[1]) * row.itemsize:
        return None
    rows = np.frombuffer(content, row)

    def column(name: str) -> Float64[ndarray, "v"]:
        return rows[name].astype(np.float64) if name in known else np.full(len(rows), np.nan)

    return VertexQuality(
        column("sigma"),
        column("sigma_independent"),
        rows["views"].astype(np.int64),
        column("residual"),
        column("ray_angle"),
    )
