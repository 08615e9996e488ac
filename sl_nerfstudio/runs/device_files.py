"""Cameras and trajectories of a run, written for other programs."""

from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.files.atomic import write_atomic
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.runs.cameras.blender import encode_blender
from sl_nerfstudio.runs.cameras.colmap import encode_colmap, require_possible
from sl_nerfstudio.runs.cameras.posed_device import posed_frames
from sl_nerfstudio.runs.cameras.tracks import surface_tracks
from sl_nerfstudio.runs.cameras.trajectory import encode_kitti, encode_tum
from sl_nerfstudio.runs.export_settings import BLENDER_FILE, COLMAP_FOLDER, ExportSettings
from sl_nerfstudio.runs.trained_run import TrainedModel
from sl_nerfstudio.scan.types import UNITS


def require_possible_files(settings: ExportSettings, model: TrainedModel) -> None:
    """Raise UserError, before anything slow, for what a format cannot hold."""
    if "colmap" in settings.cameras:
        require_possible(posed_frames(model.scan, model.poses(), model.unplaced()), model.scan.root)


def write_device_files(
    settings: ExportSettings, model: TrainedModel, mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None
) -> None:
    """Write what the settings ask for; COLMAP gets points of `mesh`."""
    scan, folder, poses = model.scan, settings.device_folder, model.poses()
    frames, unit_m = posed_frames(scan, poses, model.unplaced()), UNITS[scan.units]
    files: dict[str, bytes] = {}
    if "colmap" in settings.cameras:
        model_files = encode_colmap(frames, scan.root, surface_tracks(mesh, colour, scan, poses))
        files |= {f"{COLMAP_FOLDER}/{name}": content for name, content in model_files.items()}
    if "blender" in settings.cameras:
        files[BLENDER_FILE] = encode_blender(frames, unit_m)
    for name, devices in (("camera", frames.cameras), ("projector", frames.projectors)):
        if "tum" in settings.trajectories:
            files[f"{name}_tum.txt"] = encode_tum(devices, frames.placed, unit_m or 1.0)
        if "kitti" in settings.trajectories:
            files[f"{name}_kitti.txt"] = encode_kitti(devices, unit_m or 1.0)
    for name, content in files.items():
        write_atomic(folder / name, content)
