"""The object cut out of a surface: what `sl-export --object-only` leaves of it."""

from dataclasses import dataclass

import numpy as np

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.object_separation.frame_points import DecodedFrame
from sl_nerfstudio.object_separation.plane_judgement import PlaneFinding
from sl_nerfstudio.object_separation.separate import separate
from sl_nerfstudio.object_separation.settings import SEPARATION_DEFAULTS
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.types import Scan


@dataclass(frozen=True)
class ObjectCut:
    """A mesh without surroundings; areas in the square of the scan's unit."""

    mesh: Mesh
    area_before: float
    area_removed: float
    planes: tuple[PlaneFinding, ...]  # all that were judged
    removed: tuple[PlaneFinding, ...]  # those that were removed


def cut_object(mesh: Mesh, scan: Scan, poses: DevicePoses) -> ObjectCut:
    """Remove planes around the object and what is not connected to it.

    The object is found in the triangulated points of the scan, as sl-process does. Raises UserError if nothing is left.
    """
    found = separate(_decoded_frames(scan, poses))
    kept = mesh.with_vertices(found.keeps(mesh.vertices))
    if not len(kept.faces):
        raise UserError(
            "--object-only leaves nothing of the surface\n"
            "    cause:  the surface is far from the scan's decoded points: wrong poses, or an unfinished training\n"
            "    remedy: look at the run in ns-viewer, or leave --object-only out"
        )
    before = float(mesh.face_areas().sum())
    removed = before - float(kept.face_areas().sum())
    return ObjectCut(kept, before, removed, found.findings, tuple(plane.finding for plane in found.surroundings))


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
