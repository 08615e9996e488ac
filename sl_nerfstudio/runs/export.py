"""The surface and the refined poses of a trained run, extracted and written."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.files.atomic import write_atomic
from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.mesh_io import write_mesh
from sl_nerfstudio.meshing.trim import Trimmed, trim_to_observed
from sl_nerfstudio.meshing.vertex_quality import VertexQuality
from sl_nerfstudio.meshing.vertex_uncertainty import vertex_uncertainty
from sl_nerfstudio.runs.covariance_file import write_covariance
from sl_nerfstudio.runs.object_cut import ObjectCut, cut_object
from sl_nerfstudio.runs.run_record import training_record
from sl_nerfstudio.runs.trained_run import TrainedModel, TrainedRun
from sl_nerfstudio.scan import PoseSigma, write_transforms
from sl_nerfstudio.scan.document import TRANSFORMS
from sl_nerfstudio.scan.writing import encode_json, sigma_fields
from sl_nerfstudio.threads import one_library_thread


@dataclass(frozen=True)
class ExportSettings:
    """What is exported, and to which files."""

    mesh: Path
    pose_folder: Path | None = None  # for transforms.json and training.json; None: the poses are not written
    resolution: int = 512  # cells along each side of the scene's box
    keep_unobserved: bool = False
    object_only: bool = False  # without planes around the object and what is not connected to it


@dataclass(frozen=True)
class Exported:
    """What was written; lengths in the scan's unit."""

    mesh: Mesh
    quality: VertexQuality  # of the mesh's vertices
    trimmed: Trimmed | None  # None: nothing was removed for not being observed
    cut: ObjectCut | None  # None: surroundings were not looked for
    pose_sigma: Float[ndarray, "frames 4"] | None  # in the order of PoseSigma's fields; None: not estimated
    extraction_seconds: float
    writing_seconds: float  # trimming, uncertainty and writing


@one_library_thread()
def export_run(run: TrainedRun, settings: ExportSettings) -> Exported:
    """Extract the surface, trim it to what was observed, cut out the object, as the settings say, and write the files.

    Raises UserError if there is no surface, if no part of it was observed, or if a file cannot be written.
    """
    model, start = run.model, time.perf_counter()
    closed = extract_mesh(model.sdf, settings.resolution, device=model.device).mapped(model.S_scene_world.inverse())
    extracted = time.perf_counter()
    trimmed = None if settings.keep_unobserved else trim_to_observed(closed, model.scan, model.poses())
    mesh = closed if trimmed is None else trimmed.mesh
    cut = cut_object(mesh, model.scan, model.poses()) if settings.object_only else None
    mesh = mesh if cut is None else cut.mesh
    joint = model.joint_covariance()
    quality = vertex_uncertainty(mesh, model.scan, model.poses(), joint, model.cell)
    write_mesh(settings.mesh, mesh, quality)
    if settings.pose_folder is not None:
        _write_poses(settings.pose_folder / TRANSFORMS, model)
        write_covariance(settings.pose_folder, model.scan, joint)
        write_atomic(settings.pose_folder / "training.json", encode_json(training_record(run)))
    return Exported(mesh, quality, trimmed, cut, model.pose_sigma(), extracted - start, time.perf_counter() - extracted)


def _write_poses(path: Path, model: TrainedModel) -> None:
    """The scan's transforms.json with the refined poses and, if it was estimated, their uncertainty."""
    sigma, unplaced = model.pose_sigma(), model.unplaced()
    extra: list[dict[str, Any]] = [{"sl_unplaced": True} if lost else {} for lost in unplaced]
    if sigma is not None:
        for fields, row in zip(extra, sigma.tolist(), strict=True):
            if not fields:  # where a frame cannot be placed, its sigma says nothing
                fields["sl_pose_sigma"] = sigma_fields(PoseSigma(*row))
    write_transforms(path, model.scan, model.poses(), extra_frame_fields=extra)
