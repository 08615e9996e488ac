"""Points of the surface with the pixels of all cameras and projectors that measured them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, UInt8
from numpy import ndarray

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.rays import world_pixels
from sl_nerfstudio.geometry.spacing import evenly_spaced
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.vertex_properties import GREY
from sl_nerfstudio.meshing.vertex_views import collect_views
from sl_nerfstudio.scan.types import Scan

_POINTS = 20_000  # at most


@dataclass(frozen=True)
class SurfaceTracks:
    """Points, and the frames that confirm each of them."""

    p_world: Float64[ndarray, "n 3"]
    rgb: UInt8[ndarray, "n 3"]
    point: Int64[ndarray, "m"]  # of each observation, by its place in `p_world`
    frame: Int64[ndarray, "m"]
    uv_camera: Float64[ndarray, "m 2"]  # where the camera sees the point
    uv_projector: Float64[ndarray, "m 2"]  # what was decoded there
    residual_px: Float64[ndarray, "m"]  # distance from where the projector would see the point


def surface_tracks(mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None, scan: Scan, poses: DevicePoses) -> SurfaceTracks:
    """Vertices of a mesh, evenly chosen."""
    chosen = evenly_spaced(len(mesh.vertices), min(_POINTS, len(mesh.vertices)))
    views = collect_views(mesh, scan, poses, chosen, "points for COLMAP")
    p_world = mesh.vertices[views.vertex]
    uv_camera, uv_projector = np.zeros((len(p_world), 2)), np.zeros((len(p_world), 2))
    for k, frame in enumerate(scan.frames):
        mine = views.frame == k
        uv_camera[mine] = world_pixels(frame.camera, poses.T_world_camera[k], p_world[mine])[0]
        uv_projector[mine] = world_pixels(scan.projector, poses.T_world_projector[k], p_world[mine])[0]
    rgb = np.full((len(mesh.vertices), 3), GREY, dtype=np.uint8) if colour is None else colour
    return SurfaceTracks(
        mesh.vertices[chosen],
        rgb[chosen],
        np.searchsorted(chosen, views.vertex).astype(np.int64),
        views.frame,
        uv_camera,
        uv_projector - views.residual,
        np.linalg.norm(views.residual, axis=1).astype(np.float64),
    )
