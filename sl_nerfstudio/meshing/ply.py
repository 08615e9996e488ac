"""PLY files with properties of vertices: what a mesh is worth at each of its vertices."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.vertex_quality import VertexQuality

_TYPES = {"double": "<f8", "float": "<f4", "int": "<i4", "ushort": "<u2", "uchar": "u1"}


def encode_ply(mesh: Mesh, quality: VertexQuality | None = None) -> bytes:
    """A binary PLY: positions in float64, normals, and the quality of each vertex, if it is given."""
    normal = mesh.vertex_normals()
    columns: dict[str, tuple[str, ndarray]] = {axis: ("double", mesh.vertices[:, k]) for k, axis in enumerate("xyz")}
    columns |= {f"n{axis}": ("float", normal[:, k]) for k, axis in enumerate("xyz")}
    if quality is not None:
        columns |= {
            "sigma": ("float", quality.sigma),
            "sigma_independent": ("float", quality.sigma_independent),
            "views": ("ushort", quality.views),
            "residual": ("float", quality.residual),
            "ray_angle": ("float", quality.ray_angle),
        }
    rows = np.empty(len(mesh.vertices), dtype=[(name, _TYPES[kind]) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        rows[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *(f"property {kind} {name}" for name, (kind, _) in columns.items()),
        f"element face {len(mesh.faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corner", "<i4", (3,))])
    faces["count"], faces["corner"] = 3, mesh.faces
    return "\n".join(header).encode("ascii") + rows.tobytes() + faces.tobytes()


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
