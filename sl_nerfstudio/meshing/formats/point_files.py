"""Points of a surface as files of their own: what frames measured, without triangles."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.atomic import write_atomic
from sl_nerfstudio.meshing.formats.las import encode_las
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.ply import encode_points
from sl_nerfstudio.meshing.vertex_properties import VertexProperties
from sl_nerfstudio.scan.types import UNITS

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
            "    remedy: check the scan with sl-check, and look at the run in ns-viewer"
        )
    metres = UNITS[units] or 1.0
    if path.suffix.lower() == ".las":
        write_atomic(path, encode_las(points * metres, normals, properties, metres))
    else:
        write_atomic(path, encode_points(points, normals, properties, units))
    return len(points)
