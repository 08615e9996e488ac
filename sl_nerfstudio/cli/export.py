"""sl-export: the surface and the refined poses of a training run, in the scan's own unit and axes."""

import os
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from sl_nerfstudio.cli.run import run
from sl_nerfstudio.console import command, next_steps, short_path, unit_word
from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from numpy import ndarray

    from sl_nerfstudio.meshing.trim import Trimmed
    from sl_nerfstudio.meshing.vertex_quality import VertexQuality
    from sl_nerfstudio.runs.export import Exported
    from sl_nerfstudio.runs.trained_run import TrainedRun
    from sl_nerfstudio.scan import Scan

_SUSPICIOUS_PX = 3.0


@dataclass(frozen=True)
class ExportConfig:
    """Write the surface of a training run, and optionally its refined poses, in the scan's unit and world axes."""

    load_config: Path
    """config.yml of the run; ns-train prints its path at the end."""
    output: Path
    """Mesh file to write: .ply, .obj, .stl or .glb."""
    poses: Path | None = None
    """Folder for transforms.json with the refined poses, and training.json with settings, versions and curves."""
    resolution: int = 512
    """Cells along each side of the scene's box; the time grows with its square."""
    keep_unobserved: bool = False
    """Keep the surface that no frame observed. It closes the unseen sides, but is invented by the field."""
    object_only: bool = False
    """Remove the plane that the object stands on, walls, and what is not connected to the object."""
    data: Path | None = None
    """Scan folder, if it was moved since the training."""
    overwrite: bool = False
    """Replace existing files."""


def main() -> None:
    """Entry point of the command."""
    run(lambda: export(tyro.cli(ExportConfig, prog="sl-export", config=(tyro.conf.FlagCreatePairsOff,))))


def export(config: ExportConfig) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can correct."""
    check_outputs(config)
    from sl_nerfstudio.files.lock import locked, locked_file

    folder = _pose_folder(config)
    with locked_file(config.output), nullcontext() if folder is None else locked(folder):
        check_outputs(config)  # again: a process that held them until now may have written them
        from sl_nerfstudio.runs.trained_run import load_run

        print(export_trained(load_run(config.load_config, config.data), config))


def check_outputs(config: ExportConfig) -> None:
    """Check before anything slow: known suffix, valid resolution, nothing overwritten, folders that can be written."""
    from sl_nerfstudio.meshing.mesh_io import check_suffix

    check_suffix(config.output)
    if config.resolution < 2:
        raise UserError(f"--resolution {config.resolution}: at least 2 cells are needed; 256 or 512 is usual")
    folder = _pose_folder(config)
    if folder is not None and config.output.absolute() in (folder.absolute(), *folder.absolute().parents):
        raise UserError(
            f"{config.output}: is to be the mesh, and --poses {config.poses} a folder there\n"
            "    remedy: choose another output"
        )
    for path in (config.output, *_pose_files(config)):
        try:
            _check_output(path, config.overwrite)
        except OSError as error:
            raise UserError(
                f"{path}: cannot be written ({error.strerror})\n    remedy: choose another output"
            ) from error


def _check_output(path: Path, overwrite: bool) -> None:
    if path.is_dir():
        raise UserError(f"{path}: is a folder\n    remedy: choose another output")
    if os.path.lexists(path) and not overwrite:
        raise UserError(
            f"{path}: already exists\n    cause:  an earlier export\n"
            "    remedy: choose another output, or add --overwrite"
        )
    folder = next(p for p in path.absolute().parents if p.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        problem = "is not writable" if folder.is_dir() else "is a file, not a folder"
        raise UserError(f"{path}: cannot be written, {folder} {problem}\n    remedy: choose another output")


def export_trained(trained: "TrainedRun", config: ExportConfig) -> str:
    """Export a loaded run; returns the summary to print."""
    from sl_nerfstudio.runs.export import ExportSettings, export_run

    scan = trained.model.scan
    _require_other_files(_pose_files(config), scan.root)
    settings = ExportSettings(
        config.output, _pose_folder(config), config.resolution, config.keep_unobserved, config.object_only
    )
    return summary(config, scan, export_run(trained, settings))


def _pose_folder(config: ExportConfig) -> Path | None:
    if config.poses is None or config.poses.name != "transforms.json":
        return config.poses
    return config.poses.parent


def _pose_files(config: ExportConfig) -> tuple[Path, ...]:
    """The files with the refined poses and with the training, if they are to be written."""
    folder = _pose_folder(config)
    return () if folder is None else (folder / "transforms.json", folder / "training.json")


def _require_other_files(paths: tuple[Path, ...], scan: Path) -> None:
    for path in paths:
        if path.resolve() == (scan / path.name).resolve():
            raise UserError(
                f"{path}: is the scan's own file\n    remedy: give --poses another folder, such as refined/"
            )


def summary(config: ExportConfig, scan: "Scan", exported: "Exported") -> str:
    """What was written, what was removed, how long it took and what to do next."""
    unit = unit_word(scan.units)
    mesh, sigma = exported.mesh, exported.pose_sigma
    poses = next(iter(_pose_files(config)), None)
    extent = " x ".join(f"{side:.4g}" for side in mesh.vertices.max(0) - mesh.vertices.min(0))
    lines = [
        f"{config.output}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles, {extent} {unit}",
        *_removed(exported.trimmed),
        *_cut(exported.cut, unit),
        *_uncertainty(exported.quality, unit),
    ]
    if poses is not None:
        known = ""
        if sigma is not None:
            known = f", camera known to {_rms(sigma[:, 0]):.2g} {unit} / {_rms(sigma[:, 1]):.2g} deg (1 sigma)"
        lines.append(f"{poses}: poses of {len(scan.frames)} frames{known}")
    lines.append(
        f"time: surface {exported.extraction_seconds:.1f} s, trimming and writing {exported.writing_seconds:.1f} s"
    )
    known = () if poses is None else ("--poses", poses)
    given = ("--mesh", config.output, "--data", short_path(scan.root), *known)
    evaluation = command("sl-eval", *given, "--report", "report.html")
    return "\n".join([*lines, next_steps([evaluation])])


def _removed(trimmed: "Trimmed | None") -> list[str]:
    if trimmed is None:
        return ["  nothing was removed: parts that no frame observed are invented by the field"]
    gone = [
        f"{count:,} {what}"
        for count, what in (
            (trimmed.unseen, "vertices that no frame saw"),
            (trimmed.contradicted, "that frames contradict"),
            (trimmed.loose_pieces, "loose pieces"),
        )
        if count
    ]
    lines = [f"  removed, of {trimmed.total:,} vertices: {', '.join(gone) or 'nothing'} (--keep-unobserved keeps them)"]
    if trimmed.closed:
        lines.append(f"  kept, though no frame observed them: {trimmed.closed:,} vertices in small gaps")
    if trimmed.residual_px == trimmed.residual_px:
        lines.append(f"  predicted and decoded pattern coordinates differ by {trimmed.residual_px:.2g} px (median)")
    if trimmed.residual_px > _SUSPICIOUS_PX:
        lines.append("  warning: that is a lot. Poses or intrinsics are wrong, or the training has not converged.")
    return lines


def _uncertainty(quality: "VertexQuality", unit: str) -> list[str]:
    """How well the surface is known, and how much of it is not."""
    import numpy as np

    sigma = quality.sigma[quality.views > 0]
    if not len(sigma):
        return []
    unseen = len(quality.sigma) - len(sigma)
    without = f"; {unseen:,} vertices that no frame confirms have none" if unseen else ""
    median, most = np.percentile(sigma, [50, 95])
    return [
        f"  uncertainty along the normal (1 sigma): {median:.2g} {unit} (median), 95 % below {most:.2g} {unit}{without}"
    ]


def _cut(cut: "ObjectCut | None", unit: str) -> list[str]:
    """What --object-only removed, and which planes it kept."""
    if cut is None:
        return []
    from sl_nerfstudio.processing.selection.object_words import plane_sentence

    share = cut.area_removed / cut.area_before if cut.area_before else 0.0
    lines = [
        f"  --object-only removed {cut.area_removed:.4g} square {unit} ({share:.0%} of the surface) with "
        f"{len(cut.removed)} planes around the object"
    ]
    return lines + [f"    {plane_sentence(plane, plane in cut.removed)}" for plane in cut.planes]


def _rms(values: "ndarray") -> float:
    return float((values**2).mean() ** 0.5)


if __name__ == "__main__":
    main()
