"""sl-export: the surface and the refined poses of a training run, in the scan's own unit and axes."""

import os
import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from numpy import ndarray

    from sl_nerfstudio.meshing.mesh import Mesh
    from sl_nerfstudio.meshing.trim import Trimmed
    from sl_nerfstudio.runs.trained_run import TrainedModel, TrainedRun

_SUSPICIOUS_PX = 3.0


@dataclass(frozen=True)
class ExportConfig:
    """Write the surface, and on request the refined poses, of a training run in the scan's unit and world axes."""

    load_config: Path
    """config.yml of the run; ns-train names it at its end."""
    output: Path
    """Mesh file to write: .ply, .obj, .stl or .glb."""
    poses: Path | None = None
    """Folder for transforms.json with the refined poses, and training.json with settings, versions and curves."""
    resolution: int = 512
    """Cells along each side of the scene's box; the time grows with its square."""
    keep_unobserved: bool = False
    """Keep the surface that no frame observed: it closes unseen sides, and is the field's invention."""
    data: Path | None = None
    """Scan folder, if it was moved since the training."""
    overwrite: bool = False
    """Replace files that exist."""


def main() -> None:
    """Entry point of the command."""
    run(lambda: export(tyro.cli(ExportConfig, prog="sl-export", config=(tyro.conf.FlagCreatePairsOff,))))


def export(config: ExportConfig) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can mend."""
    check_outputs(config)
    from sl_nerfstudio.runs.trained_run import load_run

    print(export_run(load_run(config.load_config, config.data), config))


def check_outputs(config: ExportConfig) -> None:
    """Before anything slow: known suffix, sensible resolution, nothing overwritten, folders that can be written."""
    from sl_nerfstudio.meshing.mesh_io import check_suffix

    check_suffix(config.output)
    if config.resolution < 2:
        raise UserError(f"--resolution {config.resolution}: at least 2 cells are needed; 256 or 512 is usual")
    for path in (config.output, *_pose_files(config)):
        if path.is_dir():
            raise UserError(f"{path}: a folder stands there\n    remedy: choose another output")
        if path.exists() and not config.overwrite:
            raise UserError(
                f"{path}: exists already\n    cause:  an earlier export\n"
                "    remedy: choose another output, or add --overwrite"
            )
        folder = next(p for p in path.absolute().parents if p.exists())
        if not folder.is_dir() or not os.access(folder, os.W_OK):
            problem = "may not be written to" if folder.is_dir() else "is a file, not a folder"
            raise UserError(f"{path}: cannot be written, {folder} {problem}\n    remedy: choose another output")


def _pose_files(config: ExportConfig) -> tuple[Path, ...]:
    if config.poses is None:
        return ()
    folder = config.poses.parent if config.poses.name == "transforms.json" else config.poses
    return folder / "transforms.json", folder / "training.json"


def export_run(run: "TrainedRun", config: ExportConfig) -> str:
    """Extract, cut and write; gives the summary to print."""
    from sl_nerfstudio.meshing.extract import extract_mesh
    from sl_nerfstudio.meshing.mesh_io import write_mesh
    from sl_nerfstudio.meshing.trim import trim_to_observed

    model, start = run.model, time.perf_counter()
    for path in _pose_files(config):
        if path.resolve() == (model.scan.root / path.name).resolve():
            raise UserError(
                f"{path}: is the scan's own file\n    remedy: give --poses another folder, such as refined/"
            )
    closed = extract_mesh(model.sdf, config.resolution, device=model.device).mapped(model.S_scene_world.inverse())
    extracted, trimmed = time.perf_counter(), None
    if not config.keep_unobserved:
        trimmed = trim_to_observed(closed, model.scan, *model.poses())
    mesh = closed if trimmed is None else trimmed.mesh
    write_mesh(config.output, mesh)
    if config.poses is not None:
        _write_poses(run, config)
    seconds = (extracted - start, time.perf_counter() - extracted)
    return summary(config, model, mesh, trimmed, seconds)


def _write_poses(run: "TrainedRun", config: ExportConfig) -> None:
    from sl_nerfstudio.runs.run_record import training_record
    from sl_nerfstudio.scan import PoseSigma, write_transforms
    from sl_nerfstudio.scan.atomic import write_atomic
    from sl_nerfstudio.scan.writing import encode_json, sigma_fields

    transforms, training = _pose_files(config)
    sigma = run.model.pose_sigma()
    extra = None if sigma is None else [{"sl_pose_sigma": sigma_fields(PoseSigma(*row))} for row in sigma.tolist()]
    write_transforms(transforms, run.model.scan, *run.model.poses(), extra_frame_fields=extra)
    write_atomic(training, encode_json(training_record(run)))


def summary(
    config: ExportConfig,
    model: "TrainedModel",
    mesh: "Mesh",
    trimmed: "Trimmed | None",
    seconds: tuple[float, float],
) -> str:
    """What was written, what was cut, how long it took and what to do next."""
    unit = "units" if model.scan.units == "arbitrary" else model.scan.units
    extent = " x ".join(f"{side:.4g}" for side in mesh.vertices.max(0) - mesh.vertices.min(0))
    lines = [
        f"{config.output}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles, {extent} {unit}",
        *_cut(trimmed),
    ]
    if config.poses is not None:
        sigma = model.pose_sigma()
        known = (
            ""
            if sigma is None
            else f", camera good to {_rms(sigma[:, 0]):.2g} {unit} / {_rms(sigma[:, 1]):.2g} deg (1 sigma)"
        )
        lines.append(f"{_pose_files(config)[0]}: poses of {len(model.scan.frames)} frames{known}")
    lines.append(f"time: surface {seconds[0]:.1f} s, cutting and writing {seconds[1]:.1f} s")
    poses = f" --poses {shlex.quote(str(_pose_files(config)[0]))}" if config.poses is not None else ""
    mesh_and_data = f"--mesh {shlex.quote(str(config.output))} --data {shlex.quote(str(model.scan.root))}"
    lines += ["next:", f"  sl-eval {mesh_and_data}{poses} --report report.html"]
    return "\n".join(lines)


def _cut(trimmed: "Trimmed | None") -> list[str]:
    if trimmed is None:
        return ["  nothing was cut: parts that no frame observed are the field's invention"]
    gone = [
        f"{count:,} {what}"
        for count, what in (
            (trimmed.unseen, "vertices that no frame saw"),
            (trimmed.denied, "that frames contradict"),
            (trimmed.specks, "loose pieces"),
        )
        if count
    ]
    lines = [
        f"  cut away, of {trimmed.total:,} vertices: {', '.join(gone) or 'nothing'} (--keep-unobserved keeps them)"
    ]
    if trimmed.residual_px == trimmed.residual_px:
        lines.append(f"  predicted and decoded pattern coordinates differ by {trimmed.residual_px:.2g} px (median)")
    if trimmed.residual_px > _SUSPICIOUS_PX:
        lines.append("  warning: that is much. Poses or intrinsics are wrong, or the training has not converged.")
    return lines


def _rms(values: "ndarray") -> float:
    return float((values**2).mean() ** 0.5)


if __name__ == "__main__":
    main()
