"""sl-export: the surface and the refined poses of a training run, in the scan's own unit and axes."""

import os
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sl_nerfstudio.cli.arguments import CONFIG, SCAN, given_flags, parse
from sl_nerfstudio.cli.run import load_run, run
from sl_nerfstudio.console import command, fitted, next_steps, phase, short_path, unit_word
from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from numpy import ndarray

    from sl_nerfstudio.meshing.mesh import VertexQuality
    from sl_nerfstudio.meshing.texture import Textured
    from sl_nerfstudio.runs.export import Exported, ExtractedSurface
    from sl_nerfstudio.runs.export_settings import ExportSettings
    from sl_nerfstudio.runs.run import TrainedRun
    from sl_nerfstudio.scan import Scan

# The flags of sl-export.


@dataclass(frozen=True)
class ExportConfig:
    """Write the surface of a training run, and optionally poses, cameras and points, in the scan's unit and axes."""

    load_config: Path
    """config.yml of the run; ns-train prints its path at the end."""
    output: Path
    """Mesh file to write: .ply (with all properties of vertices), .obj, .stl (in mm) or .glb (in metres, y up)."""
    poses: Path | None = None
    """Folder for transforms.json with the refined poses, and training.json with settings, versions and curves."""
    cameras: tuple[Literal["colmap", "blender"], ...] = ()
    """Cameras and projectors for other programs, in the --poses folder, else beside the mesh."""
    trajectory: tuple[Literal["tum", "kitti"], ...] = ()
    """Refined poses of cameras and of projectors as text files in the same folder, in metres."""
    points: Path | None = None
    """Point cloud to write, of what frames observed, with normals, sigma and views: .ply, or .las with laspy."""
    resolution: int = 512
    """Cells along each side of the scene's box; the time grows with its square."""
    align: Literal["z-up", "plane"] | None = None
    """Turn mesh and points: what was up for the cameras becomes +z, or the plane that the object stands on z = 0."""
    target_faces: int | None = None
    """Number of triangles to which the mesh is reduced (quadric decimation); what that changes is measured."""
    texture: int | None = None
    """Side in pixels of a square texture for .glb or .obj, from pictures without the pattern; 2048 is usual."""
    fill_holes: float | None = None
    """Size in mm (without a known length, in the scan's units) of holes that the field's own surface closes."""
    watertight: bool = False
    """Write a closed solid for printing; says which share of it no frame observed."""
    keep_unobserved: bool = False
    """Keep the surface that no frame observed. It closes the unseen sides, but is invented by the field."""
    object_only: bool = False
    """Remove the plane that the object stands on, walls, and what is not connected to the object."""
    largest_component: bool = False
    """Keep only the connected piece of the surface with the largest area."""
    data: Path | None = None
    """Scan folder, if it was moved since the training."""
    device: Literal["cuda", "cpu"] | None = None
    """Where the field is evaluated; default: on the GPU if there is one that works."""
    overwrite: bool = False
    """Replace existing files."""

    @property
    def pose_folder(self) -> Path | None:
        """The folder of --poses, which may also name the file in it."""
        if self.poses is None or self.poses.name != "transforms.json":
            return self.poses
        return self.poses.parent

    @property
    def pose_files(self) -> tuple[Path, ...]:
        """The files with the refined poses and with the training, if they are to be written."""
        folder = self.pose_folder
        return () if folder is None else (folder / "transforms.json", folder / "training.json")

    def settings(self, units: str) -> "ExportSettings":
        """The export that is asked for, of a scan whose lengths are in `units`."""
        from sl_nerfstudio.runs.export_settings import ExportSettings
        from sl_nerfstudio.scan.types import UNITS

        millimetre = 1e-3 / (UNITS[units] or 1e-3)
        return ExportSettings(
            mesh=self.output,
            pose_folder=self.pose_folder,
            resolution=self.resolution,
            keep_unobserved=self.keep_unobserved,
            object_only=self.object_only,
            largest_component=self.largest_component,
            largest_hole=None if self.fill_holes is None else self.fill_holes * millimetre,
            watertight=self.watertight,
            target_faces=self.target_faces,
            texture=self.texture,
            points=self.points,
            align=self.align,
            cameras=self.cameras,
            trajectories=self.trajectory,
        )


_GROUPS = {
    "the surface": ("resolution", "object_only", "largest_component", "keep_unobserved", "fill_holes", "watertight"),
    "for other programs": ("align", "target_faces", "texture", "points", "cameras", "trajectory"),
    "poses": ("poses",),
    "this run": ("data", "device", "overwrite"),
}


# What is wrong with the flags of sl-export, found before anything slow; all of it at once.

_FEWEST_FACES = 4  # of a closed surface
_TEXTURE_PX = (64, 8192)  # smallest and largest side; the largest one takes 5 GB of memory


def check_outputs(config: ExportConfig) -> None:
    """Known suffixes, sensible values, no contradictions, nothing overwritten, folders that can be written to.

    Raises UserError with everything that is wrong.
    """
    faults = [*_values(config), *_contradictions(config), *_places(config)]
    if faults:
        raise UserError("\n".join(faults))


def _values(config: ExportConfig) -> Iterator[str]:
    from sl_nerfstudio.meshing.files import POINT_SUFFIXES, check_suffix, require_laspy

    try:
        check_suffix(config.output)
        if config.points is not None and config.points.suffix.lower() == ".las":
            require_laspy(config.points)
    except UserError as error:
        yield str(error)
    if config.points is not None and config.points.suffix.lower() not in POINT_SUFFIXES:
        yield (
            f"--points {config.points}: unknown kind of point cloud {config.points.suffix!r}\n"
            f"    remedy: end the name in {' or '.join(POINT_SUFFIXES)}"
        )
    if config.resolution < 2:
        yield f"--resolution {config.resolution}: at least 2 cells are needed; 256 or 512 is usual"
    if config.target_faces is not None and config.target_faces < _FEWEST_FACES:
        yield f"--target-faces {config.target_faces}: at least {_FEWEST_FACES} triangles are needed; 100000 is usual"
    yield from _texture_faults(config)
    if config.fill_holes is not None and not 0 < config.fill_holes < float("inf"):
        yield f"--fill-holes {config.fill_holes:g}: must be a length greater than 0, in mm"


def _texture_faults(config: ExportConfig) -> Iterator[str]:
    from sl_nerfstudio.meshing.files import SUFFIXES, TEXTURE_SUFFIXES

    if config.texture is None:
        return
    least, most = _TEXTURE_PX
    if not least <= config.texture <= most:
        yield f"--texture {config.texture}: must be {least} to {most}, the side in pixels; 2048 is usual"
    suffix = config.output.suffix.lower()
    if suffix in SUFFIXES and suffix not in TEXTURE_SUFFIXES:
        yield (
            f"--texture {config.texture}: {suffix} files have no texture\n"
            f"    remedy: end the name of --output in {' or '.join(TEXTURE_SUFFIXES)}"
            + (", or leave --texture out: a .ply has the colours of its vertices" if suffix == ".ply" else "")
        )


def _contradictions(config: ExportConfig) -> Iterator[str]:
    if config.watertight and config.fill_holes is not None:
        yield (
            "--watertight and --fill-holes contradict each other\n"
            "    cause:  a closed solid has no holes left\n    remedy: leave --fill-holes out"
        )
    if config.watertight and config.keep_unobserved:
        yield (
            "--watertight and --keep-unobserved contradict each other\n"
            "    cause:  a closed solid keeps pieces that some frame observed, with what closes them, and no others\n"
            "    remedy: leave one of them out"
        )
    others = {"--poses": config.poses, "--cameras": config.cameras, "--trajectory": config.trajectory}
    for flag in (flag for flag, value in others.items() if config.align is not None and value):
        yield (
            f"--align {config.align} and {flag}: poses are written in the scan's axes, in which the mesh would not be\n"
            "    cause:  --align turns the mesh and the points alone\n"
            f"    remedy: export {flag} by itself, without --align"
        )
    if config.keep_unobserved and config.fill_holes is not None:
        yield (
            "--keep-unobserved and --fill-holes contradict each other\n"
            "    cause:  nothing is removed, so there are no holes to fill\n    remedy: leave one of them out"
        )


def _places(config: ExportConfig) -> Iterator[str]:
    from sl_nerfstudio.meshing.files import files_of

    folder = config.pose_folder
    if folder is not None and config.output.absolute() in (folder.absolute(), *folder.absolute().parents):
        yield (
            f"{config.output}: is to be the mesh, and --poses {config.poses} a folder there\n"
            "    remedy: choose another output"
        )
        return
    others = [] if config.points is None else [config.points]
    devices = [path for paths in config.settings("arbitrary").device_files.values() for path in paths]
    files = [*files_of(config.output, config.texture is not None), *others, *config.pose_files, *devices]
    absolute = [path.absolute() for path in files]
    if config.points is not None and absolute.count(config.points.absolute()) > 1:
        yield f"--points {config.points}: is another output of this command\n    remedy: choose another name"
        files = [path for path in files if path.absolute() != config.points.absolute()]
    for path in files:
        try:
            yield from _place(path, config.overwrite)
        except OSError as error:
            yield f"{path}: cannot be written ({error.strerror})\n    remedy: choose another output"


def _place(path: Path, overwrite: bool) -> Iterator[str]:
    if path.is_dir():
        yield f"{path}: is a folder\n    remedy: choose another output"
        return
    if os.path.lexists(path) and not overwrite:
        yield (
            f"{path}: already exists\n    cause:  an earlier export\n"
            "    remedy: choose another output, or add --overwrite"
        )
        return
    folder = next(p for p in path.absolute().parents if p.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        problem = "is not writable" if folder.is_dir() else "is a file, not a folder"
        yield f"{path}: cannot be written, {folder} {problem}\n    remedy: choose another output"


# What sl-export prints: what was written, what was removed or invented, and what to do next.

_SUSPICIOUS_PX = 3.0
_LONG_SECONDS = 15.0
_SAME_EXPOSURE = 1.02
_TURNED = {"z-up": "up for the cameras is +z", "plane": "it stands on z = 0, about the origin"}
_SOLID = "  a closed solid; what nobody saw ends flat at the convex hull of what was seen"


def summary(config: ExportConfig, scan: "Scan", exported: "Exported") -> str:
    """The whole text."""
    return "\n".join([description(config, scan, exported), *_next(config, scan, exported)])


def description(config: ExportConfig, scan: "Scan", exported: "Exported") -> str:
    """What was written, removed and invented, without what to do next."""
    unit = unit_word(scan.units)
    mesh, surface = exported.mesh, exported.surface
    extent = " x ".join(f"{side:.4g}" for side in mesh.vertices.max(0) - mesh.vertices.min(0))
    lines = [
        f"{config.output}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles, {extent} {unit}",
        *_file_unit(config.output, scan.units),
        *([] if config.align is None else [f"  turned: {_TURNED[config.align]}"]),
        *([_SOLID, *_agreement(surface)] if config.watertight else _removed(surface)),
        *_filled(config, surface, unit),
        *_cut(config, surface, unit),
        *([f"  --largest-component removed {surface.other_pieces:,} other pieces"] if config.largest_component else []),
        *_invented(config, exported),
        *_decimated(exported, unit),
        *(_colours(exported) if exported.textured is None else _texture_words(exported, exported.textured, unit)),
        *_uncertainty(exported.properties.quality, unit),
        *_other_files(config, scan, exported, unit),
    ]
    lines.append(f"time: surface {surface.extraction_seconds:.1f} s, everything else {exported.writing_seconds:.1f} s")
    return fitted("\n".join(lines))


def _next(config: ExportConfig, scan: "Scan", exported: "Exported") -> list[str]:
    """Say how to judge the mesh. It fits the captures only from the poses with which it was trained."""
    if config.align is not None:
        return [fitted("to judge the surface with sl-eval, export it without --align: it needs the scan's axes")]
    if config.watertight or config.keep_unobserved:
        flag = "--watertight" if config.watertight else "--keep-unobserved"
        return [fitted(f"to judge the surface with sl-eval, export it without {flag}: it judges what is invented, too")]
    steps, poses = [], config.pose_files[:1]
    if exported.poses_refined and not poses:
        again = replace(config, poses=_new_folder(config.output), overwrite=True)
        steps.append(command("sl-export", *given_flags(again)))
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


def _removed(surface: "ExtractedSurface") -> list[str]:
    trimmed = surface.trimmed
    if trimmed is None:
        return ["  nothing was removed: parts that no frame observed are invented by the field"]
    gone = _counted(
        (trimmed.unseen, "vertices that no frame saw"),
        (trimmed.contradicted, "that frames contradict"),
        (trimmed.loose_pieces, "loose piece" if trimmed.loose_pieces == 1 else "loose pieces"),
    )
    lines = [f"  removed, of {trimmed.total:,} vertices: {gone or 'nothing'} (--keep-unobserved keeps them)"]
    if trimmed.closed:
        lines.append(f"  kept, though no frame observed them: {trimmed.closed:,} vertices in small gaps")
    return [*lines, *_agreement(surface)]


def _counted(*counts: tuple[int, str]) -> str:
    """What there is of several things, but for those of which there is nothing."""
    return ", ".join(f"{count:,} {what}" for count, what in counts if count)


def _agreement(surface: "ExtractedSurface") -> list[str]:
    residual = float("nan") if surface.trimmed is None else surface.trimmed.residual_px
    if residual != residual:
        return []
    lines = [f"  predicted and decoded pattern coordinates differ by {residual:.2g} px (median)"]
    if residual > _SUSPICIOUS_PX:
        lines.append("  warning: that is a lot. Poses or intrinsics are wrong, or the training has not converged.")
    return lines


def _filled(config: ExportConfig, surface: "ExtractedSurface", unit: str) -> list[str]:
    filled = surface.filled
    if filled is None:
        return []
    limit = f"{config.fill_holes:g} {'units' if unit == 'units' else 'mm'}"
    lines = [
        f"  --fill-holes closed {filled.closed:,} holes of up to {limit} with the field's surface "
        f"({filled.area:.3g} square {unit})"
    ]
    still = _counted((filled.too_large, "that are larger"), (filled.denied, "that frames look through"))
    return lines + ([f"    holes that stay open: {still}"] if still else [])


def _cut(config: ExportConfig, surface: "ExtractedSurface", unit: str) -> list[str]:
    """What --object-only removed, and which planes it kept."""
    cut = surface.cut
    if cut is None:
        return []
    from sl_nerfstudio.processing.object_only import plane_sentence

    share = cut.area_removed / cut.area_before if cut.area_before else 0.0
    lines = [
        f"  --object-only removed {cut.area_removed:.4g} square {unit} ({share:.0%} of the surface) with "
        f"{len(cut.removed)} planes around the object"
    ]
    if config.watertight and cut.removed:
        lines = [f"  --object-only cut the solid off flat at {len(cut.removed)} planes around the object"]
    return lines + [f"    {plane_sentence(plane, plane in cut.removed)}" for plane in cut.planes]


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
    return [f"  colours from {_pictures(exported)}{grey}"]


def _pictures(exported: "Exported") -> str:
    """How many there are, and how much their exposures differ."""
    pictures = exported.pictures
    if pictures is None:
        return "no pictures"
    least, most = pictures.gains.min(), pictures.gains.max()
    differ = (
        f" (exposures from {least:.2f} to {most:.2f} of their mean, evened out)"
        if most > _SAME_EXPOSURE * least
        else ""
    )
    return f"{len(pictures)} pictures without the pattern{differ}"


def _texture_words(exported: "Exported", textured: "Textured", unit: str) -> list[str]:
    side, charts = len(textured.texture.image), textured.texture.charts.count
    unseen = f"; {_percent(1 - textured.seen)} of the surface is in none of them and grey" * (textured.seen < 1)
    lines = [
        f"  texture of {side} x {side} pixels, {textured.texel:.2g} {unit} each, in {charts:,} charts, from "
        f"{_pictures(exported)}{unseen}"
    ]
    if textured.layout_seconds > _LONG_SECONDS:
        lines.append(f"    laying the mesh out flat took {textured.layout_seconds:.0f} s; fewer triangles "
                     "(--target-faces 100000) take less")  # fmt: skip
    return lines


def _uncertainty(quality: "VertexQuality", unit: str) -> list[str]:
    """Say how well the surface is known, and how much of it is not."""
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
        if config.points.suffix.lower() == ".las":
            arbitrary = "  one of the scan's arbitrary units became one metre"
            lines.append(arbitrary if scan.units == "arbitrary" else "  written in metres")
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


def _rms(values: "ndarray") -> float:
    return float((values**2).mean() ** 0.5)


def main() -> None:
    """Entry point of the command."""
    run(lambda: export(parse(ExportConfig, "sl-export", {"load_config": CONFIG, "data": SCAN}, _GROUPS)))


def export(config: ExportConfig) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can correct."""
    check_outputs(config)
    from sl_nerfstudio.storage import locked, locked_file

    with ExitStack() as held:
        held.enter_context(locked_file(config.output))
        if config.points is not None:
            held.enter_context(locked_file(config.points))
        if config.pose_folder is not None:
            held.enter_context(locked(config.pose_folder))
        check_outputs(config)  # again: a process that held them until now may have written them
        with phase("load"):
            trained = load_run(config.load_config, config.data, config.device)
        with phase("export"):
            exported = export_trained(trained, config)
    print(summary(config, trained.model.scan, exported))


def export_trained(trained: "TrainedRun", config: ExportConfig) -> "Exported":
    """Export a loaded run. Raises UserError for anything a user can correct."""
    from sl_nerfstudio.runs.export import export_run

    scan = trained.model.scan
    for path in config.pose_files:
        if path.resolve() == (scan.root / path.name).resolve():
            raise UserError(
                f"{path}: is the scan's own file\n    remedy: give --poses another folder, such as refined/"
            )
    return export_run(trained, config.settings(scan.units))


if __name__ == "__main__":
    main()
