"""Colours of vertices, from captures that were also taken without the pattern."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from numpy import ndarray
from scipy.ndimage import map_coordinates

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.rays import world_pixels
from sl_nerfstudio.meshing.lit_vertices import Occluder
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.vertex_properties import GREY
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.types import Frame, Scan

_LEAST_COSINE = 0.2
"""Between normal and line of sight: flatter views (beyond 78 degrees) mix in what is behind the edge of the object."""


@dataclass(frozen=True)
class VertexColours:
    """Colours of a mesh's vertices."""

    rgb: UInt8[ndarray, "v 3"]  # sRGB; GREY where no picture shows the vertex
    seen: Bool[ndarray, "v"]  # by at least one picture
    pictures: int


def vertex_colours(mesh: Mesh, scan: Scan, poses: DevicePoses) -> VertexColours | None:
    """The mean over all pictures that see a vertex, weighted by the squared cosine of the viewing angle.

    A picture sees a vertex that faces its camera, is inside the image, and that the mesh hides not. None if no frame
    of the scan has a picture (`sl_color_path`). Exposure and white balance count as the same in all pictures.
    """
    pictures = [(k, frame) for k, frame in enumerate(scan.frames) if frame.color_path is not None]
    if not pictures:
        return None
    occluder, normals = Occluder(mesh), mesh.vertex_normals()
    total, weight = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    for k, frame in track(pictures, "colours of the surface"):
        vertex, cosine, uv = _seen(mesh, normals, occluder, frame, poses.T_world_camera[k])
        total[vertex] += cosine[:, None] ** 2 * _look_up(frame, uv)
        weight[vertex] += cosine**2
    seen = weight > 0
    rgb = np.where(seen[:, None], total / np.where(seen, weight, 1.0)[:, None] * 255, GREY)
    return VertexColours(np.round(rgb).clip(0, 255).astype(np.uint8), seen, len(pictures))


def _seen(
    mesh: Mesh, normals: Float64[ndarray, "v 3"], occluder: Occluder, frame: Frame, T_world_camera: ndarray
) -> tuple[Int64[ndarray, "n"], Float64[ndarray, "n"], Float64[ndarray, "n 2"]]:
    """Vertices that the camera sees, cosine of the angle between normal and line of sight, and their pixels."""
    eye = T_world_camera[:3, 3]
    way = eye - mesh.vertices
    cosine = np.einsum("vi,vi->v", way, normals) / np.linalg.norm(way, axis=1)
    vertex = np.flatnonzero(cosine > _LEAST_COSINE)
    uv, inside = world_pixels(frame.camera, T_world_camera, mesh.vertices[vertex])
    vertex, uv = vertex[inside], uv[inside]
    free = ~occluder.hidden(mesh.vertices[vertex], normals[vertex], eye)
    return vertex[free], cosine[vertex[free]], uv[free]


def _look_up(frame: Frame, uv: Float64[ndarray, "n 2"]) -> Float64[ndarray, "n 3"]:
    """Bilinear values of the frame's picture in [0, 1]; grey pictures in all three channels."""
    image = frame.read_color()
    if image is None:
        raise ValueError(f"frame {frame.name} was not captured without the pattern")
    values = image.reshape(*image.shape[:2], -1) / np.iinfo(image.dtype).max
    place = (uv - 0.5).T[::-1]  # the centre of the first pixel is (0.5, 0.5)
    channels = [map_coordinates(values[..., c], place, order=1, mode="nearest") for c in range(values.shape[2])]
    return np.stack(channels * (3 // len(channels)), 1)
