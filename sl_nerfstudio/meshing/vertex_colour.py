"""Colours of a surface, from captures that were also taken without the pattern."""

from dataclasses import dataclass
from functools import partial

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
from sl_nerfstudio.threads import results, threads

_LEAST_COSINE = 0.2
"""Between normal and line of sight: flatter views (beyond 78 degrees) mix in what is behind the edge of the object."""


@dataclass(frozen=True)
class Colours:
    """Colours of points of a surface."""

    rgb: UInt8[ndarray, "n 3"]  # sRGB; GREY where no picture shows the point
    seen: Bool[ndarray, "n"]  # by at least one picture
    pictures: int


def vertex_colours(mesh: Mesh, scan: Scan, poses: DevicePoses) -> Colours | None:
    """Colours of all vertices; None if no frame of the scan has a picture (`sl_color_path`)."""
    if not has_pictures(scan):
        return None
    return point_colours(mesh.vertices, mesh.vertex_normals(), Occluder(mesh), scan, poses)


def has_pictures(scan: Scan) -> bool:
    """Whether some frame was also captured without the pattern."""
    return any(frame.color_path is not None for frame in scan.frames)


def point_colours(
    points: Float64[ndarray, "n 3"],
    normals: Float64[ndarray, "n 3"],
    occluder: Occluder,
    scan: Scan,
    poses: DevicePoses,
    task: str = "colours of the surface",
) -> Colours:
    """The mean over all pictures that see a point, weighted by the squared cosine of the viewing angle.

    A picture sees a point of the occluder's mesh that faces its camera, is inside the image, and that the mesh hides
    not. Exposure and white balance count as the same in all pictures. `task` names the progress. As many pictures are
    in memory at a time as there are threads.
    """
    pictures = [(k, frame) for k, frame in enumerate(scan.frames) if frame.color_path is not None]
    total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
    for first in track(range(0, len(pictures), threads()), task):
        some = pictures[first : first + threads()]
        looks = [partial(_look, points, normals, occluder, frame, poses.T_world_camera[k]) for k, frame in some]
        for index, square, rgb in results(looks):
            total[index] += square[:, None] * rgb
            weight[index] += square
    seen = weight > 0
    rgb = np.where(seen[:, None], total / np.where(seen, weight, 1.0)[:, None] * 255, GREY)
    return Colours(np.round(rgb).clip(0, 255).astype(np.uint8), seen, len(pictures))


def _look(
    points: Float64[ndarray, "n 3"],
    normals: Float64[ndarray, "n 3"],
    occluder: Occluder,
    frame: Frame,
    T_world_camera: Float64[ndarray, "4 4"],
) -> tuple[Int64[ndarray, "m"], Float64[ndarray, "m"], Float64[ndarray, "m 3"]]:
    """Points that a picture sees, squared cosines between their normals and lines of sight, and colours in [0, 1]."""
    eye = T_world_camera[:3, 3]
    way = eye - points
    cosine = np.einsum("vi,vi->v", way, normals) / np.linalg.norm(way, axis=1)
    index = np.flatnonzero(cosine > _LEAST_COSINE)
    uv, inside = world_pixels(frame.camera, T_world_camera, points[index])
    index, uv = index[inside], uv[inside]
    free = ~occluder.hidden(points, normals, index, eye)
    return index[free], cosine[index[free]] ** 2, _look_up(frame, uv[free])


def _look_up(frame: Frame, uv: Float64[ndarray, "n 2"]) -> Float64[ndarray, "n 3"]:
    """Bilinear values of the frame's picture in [0, 1]; grey pictures in all three channels."""
    image = frame.read_color()
    if image is None:
        raise ValueError(f"frame {frame.name} was not captured without the pattern")
    values = image.reshape(*image.shape[:2], -1) / np.iinfo(image.dtype).max
    place = (uv - 0.5).T[::-1]  # the centre of the first pixel is (0.5, 0.5)
    channels = [map_coordinates(values[..., c], place, order=1, mode="nearest") for c in range(values.shape[2])]
    return np.stack(channels * (3 // len(channels)), 1)
