"""The headers of a scan's files: do the files exist, are they of the right kind and size? Decodes nothing."""

from pathlib import Path

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan.coordinates import read_coords_size
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.images import read_header
from sl_nerfstudio.scan.partial_scan import PartialFrame, PartialScan
from sl_nerfstudio.scan.problem import Faults, Problem

_MAY_BE_COLOUR = ("file_path", "sl_color_path")


def check_headers(partial: PartialScan, faults: Faults) -> set[Path]:
    """Check the headers of all files; return the files that can be decoded."""
    good: set[Path] = set()
    if partial.pattern_path is not None:
        size = None if partial.projector is None else (partial.projector.w, partial.projector.h)
        _check_image(partial.pattern_path, partial.root, None, size, True, "the projector", good, faults)
    for frame in partial.frames:
        _check_frame(frame, partial.root, good, faults)
    return good


def relative(path: Path, root: Path) -> str:
    """How messages name a file: its path below the folder, with slashes."""
    return path.relative_to(root).as_posix()


def _check_frame(frame: PartialFrame, root: Path, good: set[Path], faults: Faults) -> None:
    size = _size(frame.camera)
    for key in ("file_path", "sl_pattern_path", "mask_path", "sl_color_path"):
        if key in frame.paths:
            _check_image(
                frame.paths[key], root, frame.name, size, key not in _MAY_BE_COLOUR, "the camera", good, faults
            )
    path = frame.paths.get("sl_coords_path")
    if path is None:
        return
    try:
        found = read_coords_size(path)
    except FileError as error:
        faults.add(error, relative(path, root), frame.name)
        return
    if size is not None and found != size:
        faults.add(_wrong_size(found, size, "the camera"), relative(path, root), frame.name)
    else:
        good.add(path)


def _check_image(
    path: Path,
    root: Path,
    frame: str | None,
    size: tuple[int, int] | None,
    grey_only: bool,
    device: str,
    good: set[Path],
    faults: Faults,
) -> None:
    try:
        header = read_header(path)
    except FileError as error:
        faults.add(error, relative(path, root), frame)
        return
    found = (header.w, header.h)
    before = len(faults.found)
    if size is not None and found != size:
        faults.add(_wrong_size(found, size, device), relative(path, root), frame)
    if grey_only and header.mode != "grey":
        faults.add(
            Problem("is in colour", "it was saved by a program that writes only RGB", "save it as grey, 8 or 16 bit"),
            relative(path, root),
            frame,
        )
    if len(faults.found) == before:
        good.add(path)


def _size(device: Device | None) -> tuple[int, int] | None:
    return None if device is None else (device.w, device.h)


def _wrong_size(found: tuple[int, int], wanted: tuple[int, int], device: str) -> Problem:
    if found == wanted[::-1]:
        cause = "width and height are swapped: the image was rotated, or w and h were swapped"
    elif found[0] * wanted[1] == found[1] * wanted[0]:
        cause = "it was resized, or the intrinsics are those of another resolution"
    else:
        cause = "it was cropped, or comes from another camera or scan"
    return Problem(
        f"is {found[0]} x {found[1]} pixels, but {device} has {wanted[0]} x {wanted[1]}",
        cause,
        "give the original file, or the intrinsics (w, h, fl_x, fl_y, cx, cy) of this one",
    )
