"""What is wrong with the flags of sl-export, found before anything slow; all of it at once."""

import os
from collections.abc import Iterator
from pathlib import Path

from sl_nerfstudio.cli.exporting.config import ExportConfig
from sl_nerfstudio.errors import UserError

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
    from sl_nerfstudio.meshing.formats.las import require_laspy
    from sl_nerfstudio.meshing.formats.point_files import POINT_SUFFIXES
    from sl_nerfstudio.meshing.mesh_io import check_suffix

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
    yield from _texture(config)
    if config.fill_holes is not None and not 0 < config.fill_holes < float("inf"):
        yield f"--fill-holes {config.fill_holes:g}: must be a length greater than 0, in mm"


def _texture(config: ExportConfig) -> Iterator[str]:
    from sl_nerfstudio.meshing.mesh_io import SUFFIXES, TEXTURE_SUFFIXES

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
    if config.keep_unobserved and config.fill_holes is not None:
        yield (
            "--keep-unobserved and --fill-holes contradict each other\n"
            "    cause:  nothing is removed, so there are no holes to fill\n    remedy: leave one of them out"
        )


def _places(config: ExportConfig) -> Iterator[str]:
    from sl_nerfstudio.meshing.mesh_io import files_of

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
    for path in files:
        if absolute.count(path.absolute()) > 1 and path == config.points:
            yield f"--points {path}: is another output of this command\n    remedy: choose another name"
            continue
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


def require_other_files(paths: tuple[Path, ...], scan: Path) -> None:
    """Raise UserError if poses would replace the scan's own."""
    for path in paths:
        if path.resolve() == (scan / path.name).resolve():
            raise UserError(
                f"{path}: is the scan's own file\n    remedy: give --poses another folder, such as refined/"
            )
