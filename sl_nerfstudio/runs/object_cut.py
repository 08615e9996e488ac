"""The object cut out of a surface: what `sl-export --object-only` leaves of it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.meshing.finishing.closed_field import Planes
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.object_separation.frame_points import DecodedFrame
from sl_nerfstudio.object_separation.plane_judgement import PlaneFinding
from sl_nerfstudio.object_separation.separate import Separation, separate
from sl_nerfstudio.object_separation.settings import SEPARATION_DEFAULTS
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.types import Scan


@dataclass(frozen=True)
class ObjectCut:
    """A mesh without surroundings; areas in the square of the scan's unit."""

    kept: Bool[ndarray, "f"]  # triangles of the mesh that was cut
    area_before: float
    area_removed: float
    planes: tuple[PlaneFinding, ...]  # all that were judged
    removed: tuple[PlaneFinding, ...]  # those that were removed


def separate_scan(scan: Scan, poses: DevicePoses) -> Separation:
    """The object in the triangulated points of a scan, found as sl-process does. Raises UserError without points."""
    return separate(_decoded_frames(scan, poses))


def cut_object(mesh: Mesh, found: Separation) -> ObjectCut:
    """Remove planes around the object and what is not connected to it. Raises UserError if nothing is left."""
    return object_cut(mesh, found, found.keeps(mesh.vertices)[mesh.faces].all(1))


def object_cut(mesh: Mesh, found: Separation, kept: Bool[ndarray, "f"]) -> ObjectCut:
    """What it means to keep these triangles. Raises UserError if there are none."""
    if not kept.any():
        raise UserError(
            "--object-only leaves nothing of the surface\n"
            "    cause:  the surface is far from the scan's decoded points: wrong poses, or an unfinished training\n"
            "    remedy: look at the run in ns-viewer, or leave --object-only out"
        )
    areas = mesh.face_areas()
    removed = tuple(plane.finding for plane in found.surroundings)
    return ObjectCut(kept, float(areas.sum()), float(areas[~kept].sum()), found.findings, removed)


def planes_below(found: Separation, S_scene_world: Similarity) -> Planes:
    """Normals and offsets, in the scene, of the planes above which the object is: what belongs to a plane is below."""
    planes: Planes = []
    for one in found.surroundings:
        plane = one.finding.plane
        normal = S_scene_world.R @ plane.normal
        offset = S_scene_world.scale * (plane.offset + one.tolerance) + float(normal @ S_scene_world.t)
        planes.append((normal, offset))
    return planes


def _decoded_frames(scan: Scan, poses: DevicePoses) -> list[DecodedFrame]:
    """All frames that have coordinates, thinned as they are read."""
    frames = []
    for k, frame in enumerate(track(scan.frames, "object only")):
        coords = frame.read_coords()
        if np.isfinite(coords).all(-1).any():
            whole = DecodedFrame(
                frame.camera, scan.projector, poses.T_world_camera[k], poses.T_world_projector[k], coords,
                frame.read_mask(),
            )  # fmt: skip
            frames.append(whole.thinned(SEPARATION_DEFAULTS.pixels_per_frame))
    if not frames:
        raise UserError(
            f"{scan.root}: no frame has decoded coordinates, so --object-only cannot find the object\n"
            "    cause:  the scan has images and poses only\n    remedy: leave --object-only out"
        )
    return frames
