"""The surface and the refined poses of a trained run, extracted and written."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.atomic import write_atomic
from sl_nerfstudio.meshing.finishing.decimate import Decimated, decimate
from sl_nerfstudio.meshing.finishing.marked import MarkedMesh
from sl_nerfstudio.meshing.formats.point_files import observed_points, write_points
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.mesh_io import write_mesh
from sl_nerfstudio.meshing.texture.colours import Textured, surface_texture
from sl_nerfstudio.meshing.vertex_colour import Colours, has_pictures, vertex_colours
from sl_nerfstudio.meshing.vertex_properties import VertexProperties
from sl_nerfstudio.meshing.vertex_uncertainty import vertex_uncertainty
from sl_nerfstudio.runs.covariance_file import write_covariance
from sl_nerfstudio.runs.device_files import require_possible_files, write_device_files
from sl_nerfstudio.runs.export_settings import ExportSettings
from sl_nerfstudio.runs.run_record import training_record
from sl_nerfstudio.runs.surface import Surface, build_surface
from sl_nerfstudio.runs.trained_run import TrainedModel, TrainedRun
from sl_nerfstudio.scan import PoseSigma, Scan, write_transforms
from sl_nerfstudio.scan.document import TRANSFORMS
from sl_nerfstudio.scan.writing import encode_json, sigma_fields
from sl_nerfstudio.threads import one_library_thread

_ROUNDING = 1e-6  # of single precision, relative to the largest number


@dataclass(frozen=True)
class Exported:
    """What was written; lengths in the scan's unit."""

    mesh: Mesh
    properties: VertexProperties  # of the mesh's vertices
    surface: Surface  # before it was decimated
    decimated: Decimated | None
    colours: Colours | None  # of the surface before it was decimated; None: no picture without the pattern
    textured: Textured | None  # None: no texture was asked for
    points: int  # in the point cloud
    pose_sigma: Float[ndarray, "frames 4"] | None  # in the order of PoseSigma's fields; None: not estimated
    poses_refined: bool  # whether the run's poses are others than the scan's
    writing_seconds: float  # everything but the extraction

    @property
    def invented_share(self) -> float:
        """Share of the mesh's area that no frame observed."""
        return MarkedMesh(self.mesh, self.properties.invented).invented_share()


@one_library_thread()
def export_run(run: TrainedRun, settings: ExportSettings) -> Exported:
    """Extract the surface, keep of it what the settings say, and write the files.

    Raises UserError if there is no surface, if no part of it was observed, or if a file cannot be written.
    """
    model, start = run.model, time.perf_counter()
    require_possible_files(settings, model)
    _require_pictures(settings, model.scan)
    surface = build_surface(model, settings)
    mesh, scan, poses = surface.marked.mesh, model.scan, model.poses()
    joint = model.joint_covariance()
    quality = vertex_uncertainty(mesh, scan, poses, joint, model.cell)
    colours = vertex_colours(mesh, scan, poses)
    invented = quality.views == 0 if settings.keep_unobserved else surface.marked.invented
    properties = VertexProperties(quality, invented, None if colours is None else colours.rgb)
    points = 0
    if settings.points is not None:
        points = write_points(settings.points, *observed_points(mesh, properties), scan.units)
    if settings.cameras or settings.trajectories:
        write_device_files(settings, model, mesh, properties.colour)
    whole, decimated, textured = mesh, None, None
    if settings.target_faces is not None:
        decimated = decimate(mesh, settings.target_faces)
        mesh, properties = decimated.mesh, properties.chosen(decimated.nearest).moved(decimated.distance)
    if settings.watertight:
        _require_closed(mesh, settings)
    if settings.texture is not None:
        textured = surface_texture(mesh, settings.texture, whole, scan, poses)
    write_mesh(settings.mesh, mesh, properties, scan.units, None if textured is None else textured.texture)
    if settings.pose_folder is not None:
        _write_poses(settings.pose_folder / TRANSFORMS, model)
        write_covariance(settings.pose_folder, scan, joint)
        write_atomic(settings.pose_folder / "training.json", encode_json(training_record(run)))
    seconds = time.perf_counter() - start - surface.extraction_seconds
    refined = poses_refined(model)
    return Exported(
        mesh, properties, surface, decimated, colours, textured, points, model.pose_sigma(), refined, seconds
    )


def poses_refined(model: TrainedModel) -> bool:
    """Whether the model's poses differ from those of its scan by more than rounding."""
    given, now = model.scan.poses.stacked(), model.poses().stacked()
    return not np.allclose(now, given, rtol=0.0, atol=_ROUNDING * float(np.abs(given).max()))


def _require_pictures(settings: ExportSettings, scan: Scan) -> None:
    if settings.texture is None or has_pictures(scan):
        return
    raise UserError(
        f"--texture {settings.texture}: no frame of {scan.root} has a picture without the pattern\n"
        "    cause:  a texture needs colours, and captures under the pattern have none\n"
        "    remedy: photograph frames once more from the same place in even light, without the pattern, name these\n"
        '            pictures in transforms.json ("sl_color_path": "color/NAME.png" in the frame) and train again;\n'
        "            or leave --texture out"
    )


def _require_closed(mesh: Mesh, settings: ExportSettings) -> None:
    if mesh.is_closed():
        return
    if settings.target_faces is not None:
        raise UserError(
            f"--target-faces {settings.target_faces}: the surface is no longer closed with so few triangles\n"
            "    cause:  thin parts of it collapse\n    remedy: keep more triangles, or leave --watertight out"
        )
    raise UserError(
        f"--watertight: the surface is not closed at --resolution {settings.resolution}\n"
        "    cause:  parts of it are thinner than a cell\n    remedy: give another --resolution"
    )


def _write_poses(path: Path, model: TrainedModel) -> None:
    """The scan's transforms.json with the refined poses and, if it was estimated, their uncertainty."""
    sigma, unplaced = model.pose_sigma(), model.unplaced()
    extra: list[dict[str, Any]] = [{"sl_unplaced": True} if lost else {} for lost in unplaced]
    if sigma is not None:
        for fields, row in zip(extra, sigma.tolist(), strict=True):
            if not fields:  # where a frame cannot be placed, its sigma says nothing
                fields["sl_pose_sigma"] = sigma_fields(PoseSigma(*row))
    write_transforms(path, model.scan, model.poses(), extra_frame_fields=extra)
