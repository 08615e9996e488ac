"""Photographs without the pattern, named like the frames from whose places they were taken: colours of the surface."""

import os
from collections import Counter
from pathlib import Path

from sl_nerfstudio.processing.captures import CapturedFrame, Captures, with_others
from sl_nerfstudio.review.verdict import listed
from sl_nerfstudio.scan.document import FileError, unreadable
from sl_nerfstudio.scan.images import ENDINGS, RAW, photograph_header, raw_file


def find_pictures(folder: Path, captures: Captures) -> dict[str, Path]:
    """The picture of each frame that has one, by the frame's name; with several cameras, in a folder for each.

    Raises FileError if no frame has one, if two pictures have the name of one frame, and for all pictures that cannot
    be read, have another size than the captures, or are captures themselves.
    """
    if not os.path.isdir(folder):  # Path.is_dir raises for a name that is too long
        raise FileError(folder, "is no folder", "a typing error in --color", "give the folder with the photographs")
    found: dict[str, list[Path]] = {}
    try:
        for camera in captures.sizes:
            for path in sorted((folder / camera).iterdir()) if (folder / camera).is_dir() else ():
                if path.suffix.lower() in (*ENDINGS, *RAW) and not path.name.startswith("."):
                    found.setdefault("_".join(filter(None, (camera, path.stem))), []).append(path)
    except OSError as error:
        raise unreadable(folder, error) from error
    frames = {frame.name: frame for frame in captures.frames}
    used = {name: paths for name, paths in found.items() if name in frames}
    if not used:
        there = listed([path.name for paths in found.values() for path in paths], 3) or "no images"
        raise FileError(
            folder, f"has no picture of any frame (it holds {there})",
            "pictures are found by the name of the frame, without its ending",
            f"name each like its frame: {next(iter(frames))}.jpg shows the place of {next(iter(frames))} without the "
            "pattern",
        )  # fmt: skip
    faults = [fault for name, paths in used.items() if (fault := _fault(frames[name], paths, captures)) is not None]
    if faults:
        raise with_others(faults)
    return {name: paths[0] for name, paths in used.items()}


def _fault(frame: CapturedFrame, paths: list[Path], captures: Captures) -> FileError | None:
    path, wanted = paths[0], captures.sizes[frame.camera]
    try:
        if len(paths) > 1:
            raise FileError(path, f"and {paths[1].name} are both for frame {frame.name}", "two formats", "keep one")
        if path.suffix.lower() in RAW:
            raise raw_file(path)
        header = photograph_header(path)
        if (header.w, header.h) != wanted:
            raise FileError(
                path, f"is {header.w} x {header.h} pixels, the captures are {wanted[0]} x {wanted[1]}",
                "it was taken with another setting of the camera, or reduced or cropped",
                "give the picture as the camera took it, with the same setting as the captures",
            )  # fmt: skip
        if any(os.path.samefile(path, image) or path.read_bytes() == image.read_bytes() for image in frame.images):
            raise FileError(
                path, f"is the capture of frame {frame.name} itself, which shows the pattern",
                "--color and --images name the same folder, or the capture was copied",
                "give pictures that were taken without the pattern",
            )  # fmt: skip
    except FileError as error:
        return error
    return None


def picture_sentences(pictures: dict[str, Path], captures: Captures) -> tuple[str, ...]:
    """How many frames have a picture, and which have none."""
    without = [frame.name for frame in captures.frames if frame.name not in pictures]
    missing = f"; none of {listed(without, 20)}" if without else ""
    sizes = Counter(path.suffix.lower().lstrip(".") for path in pictures.values())
    kinds = ", ".join(f"{count} {kind}" for kind, count in sizes.items())
    return (f"colours from {len(pictures)} photographs without the pattern ({kinds}){missing}",)
