"""What sl-export prints: what was written, what was removed or invented, and what to do next."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sl_nerfstudio.cli.exporting.config import ExportConfig
from sl_nerfstudio.console import command, fitted, next_steps, short_path, unit_word

if TYPE_CHECKING:
    from numpy import ndarray

    from sl_nerfstudio.meshing.texture.colours import Textured
    from sl_nerfstudio.meshing.vertex_quality import VertexQuality
    from sl_nerfstudio.runs.export import Exported
    from sl_nerfstudio.runs.surface import Surface
    from sl_nerfstudio.scan import Scan

_SUSPICIOUS_PX = 3.0
_LONG_SECONDS = 15.0


def summary(config: ExportConfig, scan: "Scan", exported: "Exported") -> str:
    """The whole text."""
    unit = unit_word(scan.units)
    mesh, surface = exported.mesh, exported.surface
    extent = " x ".join(f"{side:.4g}" for side in mesh.vertices.max(0) - mesh.vertices.min(0))
    lines = [
        f"{config.output}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles, {extent} {unit}",
        *_file_unit(config.output, scan.units),
        *(_solid(exported) if config.watertight else _removed(surface)),
        *_filled(config, surface, unit),
        *_cut(config, surface, unit),
        *_pieces(config, surface),
        *_invented(config, exported),
        *_decimated(exported, unit),
        *(_colours(exported) if exported.textured is None else _texture(exported.textured, unit)),
        *_uncertainty(exported.properties.quality, unit),
        *_other_files(config, scan, exported, unit),
    ]
    lines.append(f"time: surface {surface.extraction_seconds:.1f} s, everything else {exported.writing_seconds:.1f} s")
    return "\n".join([fitted("\n".join(lines)), *_next(config, scan, exported)])


def _next(config: ExportConfig, scan: "Scan", exported: "Exported") -> list[str]:
    """How to judge the mesh. It fits the captures only from the poses with which it was trained."""
    if config.watertight or config.keep_unobserved:
        flag = "--watertight" if config.watertight else "--keep-unobserved"
        return [fitted(f"to judge the surface with sl-eval, export it without {flag}: it judges what is invented, too")]
    steps, poses = [], config.pose_files[:1]
    if exported.poses_refined and not poses:
        again = replace(config, poses=_new_folder(config.output), overwrite=True)
        steps.append(command("sl-export", *again.words()))
        poses = again.pose_files[:1]
    given = ("--mesh", config.output, "--data", short_path(scan.root), *(("--poses", poses[0]) if poses else ()))
    return [next_steps([*steps, command("sl-eval", *given, "--report", "report.html")])]


def _new_folder(mesh: Path) -> Path:
    """A folder for poses beside the mesh; --overwrite is for the mesh, not for poses that are already there."""
    usual = mesh.parent / "refined"
    return mesh.with_name(f"{mesh.stem}-refined") if usual.exists() else usual


def _file_unit(path: Path, units: str) -> list[str]:
    """What the file's lengths and axes are, where they are not the scan's."""
    named = {".glb": ("metre", "m", "glTF's unit; y up: x, z and -y of the scan"), ".stl": ("millimetre", "mm", "")}
    if path.suffix.lower() not in named:
        return []
    word, short, note = named[path.suffix.lower()]
    if units == "arbitrary":
        text = f"one of the scan's arbitrary units became one {word}, so its size is not true"
        return [f"  {text}{f' ({note})' if note else ''}"]
    scaled = "" if units == short else f"; scaled from {units}"
    return [f"  written in {word}s{scaled}{f' ({note})' if note else ' (STL states no unit itself)'}"]


def _solid(exported: "Exported") -> list[str]:
    return [
        "  a closed solid; what nobody saw ends flat at the convex hull of what was seen",
        *_agreement(exported.surface),
    ]


def _removed(surface: "Surface") -> list[str]:
    trimmed = surface.trimmed
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
    return [*lines, *_agreement(surface)]


def _agreement(surface: "Surface") -> list[str]:
    residual = float("nan") if surface.trimmed is None else surface.trimmed.residual_px
    if residual != residual:
        return []
    lines = [f"  predicted and decoded pattern coordinates differ by {residual:.2g} px (median)"]
    if residual > _SUSPICIOUS_PX:
        lines.append("  warning: that is a lot. Poses or intrinsics are wrong, or the training has not converged.")
    return lines


def _filled(config: ExportConfig, surface: "Surface", unit: str) -> list[str]:
    filled = surface.filled
    if filled is None:
        return []
    limit = f"{config.fill_holes:g} {'units' if unit == 'units' else 'mm'}"
    lines = [
        f"  --fill-holes closed {filled.closed:,} holes of up to {limit} with the field's surface "
        f"({filled.area:.3g} square {unit})"
    ]
    still = [
        f"{count:,} {what}"
        for count, what in ((filled.too_large, "that are larger"), (filled.denied, "that frames look through"))
        if count
    ]
    return lines + ([f"    holes that stay open: {', '.join(still)}"] if still else [])


def _cut(config: ExportConfig, surface: "Surface", unit: str) -> list[str]:
    """What --object-only removed, and which planes it kept."""
    cut = surface.cut
    if cut is None:
        return []
    from sl_nerfstudio.processing.selection.object_words import plane_sentence

    share = cut.area_removed / cut.area_before if cut.area_before else 0.0
    lines = [
        f"  --object-only removed {cut.area_removed:.4g} square {unit} ({share:.0%} of the surface) with "
        f"{len(cut.removed)} planes around the object"
    ]
    if config.watertight and cut.removed:
        lines = [f"  --object-only cut the solid off flat at {len(cut.removed)} planes around the object"]
    return lines + [f"    {plane_sentence(plane, plane in cut.removed)}" for plane in cut.planes]


def _pieces(config: ExportConfig, surface: "Surface") -> list[str]:
    if not config.largest_component:
        return []
    return [f"  --largest-component removed {surface.other_pieces:,} other pieces"]


def _invented(config: ExportConfig, exported: "Exported") -> list[str]:
    if not (config.watertight or config.keep_unobserved or config.fill_holes is not None):
        return []
    share = exported.invented_share
    return [f"  {_percent(share)} of the area is invented: no frame observed it (`invented` in a .ply is 1 there)"]


def _percent(share: float) -> str:
    if 0 < share < 5e-4:
        return "less than 0.1%"
    return f"{share:.1%}" if share < 0.1 else f"{share:.0%}"


def _decimated(exported: "Exported", unit: str) -> list[str]:
    done = exported.decimated
    if done is None:
        return []
    if len(done.mesh.faces) == done.triangles_before:
        return [f"  --target-faces: the surface has only {done.triangles_before:,} triangles, and stays as it is"]
    return [
        f"  decimated from {done.triangles_before:,} triangles: that moved the surface by {done.rms_error:.2g} {unit} "
        f"(RMS), {done.largest_error:.2g} {unit} at most; `sigma` includes it"
    ]


def _colours(exported: "Exported") -> list[str]:
    colours = exported.colours
    if colours is None:
        return []
    grey = f"; {1 - colours.seen.mean():.1%} of the vertices are in none of them and grey" * (not colours.seen.all())
    return [f"  colours from {colours.pictures} pictures without the pattern{grey}"]


def _texture(textured: "Textured", unit: str) -> list[str]:
    side, charts = len(textured.texture.image), textured.texture.charts.count
    unseen = f"; {_percent(1 - textured.seen)} of the surface is in none of them and grey" * (textured.seen < 1)
    lines = [
        f"  texture of {side} x {side} pixels, {textured.texel:.2g} {unit} each, in {charts:,} charts, from "
        f"{textured.pictures} pictures without the pattern{unseen}"
    ]
    if textured.layout_seconds > _LONG_SECONDS:
        lines.append(f"    laying the mesh out flat took {textured.layout_seconds:.0f} s; fewer triangles "
                     "(--target-faces 100000) take less")  # fmt: skip
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


def _other_files(config: ExportConfig, scan: "Scan", exported: "Exported", unit: str) -> list[str]:
    lines = []
    if config.points is not None:
        lines.append(f"{config.points}: {exported.points:,} points that frames confirm, with normals, sigma and views")
        lines += _las_unit(config.points, scan.units)
    sigma = exported.pose_sigma
    if config.pose_files:
        known = ""
        if sigma is not None:
            known = f", camera known to {_rms(sigma[:, 0]):.2g} {unit} / {_rms(sigma[:, 1]):.2g} deg (1 sigma)"
        lines.append(f"{config.pose_files[0]}: poses of {len(scan.frames)} frames{known}")
    metres = "the scan's arbitrary units" if unit == "units" else "metres"
    notes = {
        "colmap": f"COLMAP model in {unit}; the projector is its last camera",
        "blender": f"script for Blender, in {metres}, z up",
        "tum": f"trajectories, device to world, +y down, in {metres}; without unplaced frames",
        "kitti": f"trajectories, device to world, +y down, in {metres}",
    }
    for kind, paths in config.settings(scan.units).device_files.items():
        lines += [f"{paths[0].parent}: {', '.join(path.name for path in paths)}", f"  {notes[kind]}"]
    return lines


def _las_unit(path: Path, units: str) -> list[str]:
    if path.suffix.lower() != ".las":
        return []
    return ["  one of the scan's arbitrary units became one metre" if units == "arbitrary" else "  written in metres"]


def _rms(values: "ndarray") -> float:
    return float((values**2).mean() ** 0.5)
