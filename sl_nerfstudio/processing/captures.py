"""The photographs of each frame."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sl_nerfstudio.scan.file_error import FileError, unreadable
from sl_nerfstudio.scan.images import read_header

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


@dataclass(frozen=True)
class CapturedFrame:
    """One frame: one photograph, or the photographs of a sequence in the order of projection."""

    name: str
    images: tuple[Path, ...]


@dataclass(frozen=True)
class Captures:
    """All frames, and the faults of those that cannot be used."""

    frames: tuple[CapturedFrame, ...]  # sorted by name, with numbers sorted as numbers
    size: tuple[int, int]  # (w, h) of the images
    faults: dict[str, FileError]  # by the frame's name


def find_captures(root: Path, sequences: bool) -> Captures:
    """Frames in a folder: one image each or, with `sequences`, one sub-folder of images each.

    The most frequent image size is taken to be right. Images of another size, and images that cannot be read, are
    faults of their frames. Raises FileError if there are fewer than two frames.
    """
    if not os.path.isdir(root):  # Path.is_dir raises for a name that is too long
        raise FileError(root, "is no folder", "a typing error in --images", "give the folder with the captures")
    try:
        frames = _folders(root) if sequences else _single_images(root)
    except OSError as error:
        raise unreadable(root, error) from error
    if len(frames) < 2:
        what = "folders with images" if sequences else "images"
        other = _single_images(root) if sequences else _folders(root)
        cause = (
            "the captures do not suit the pattern: a coded grid needs one image per frame, Gray code one sub-folder"
            if len(other) > 1
            else "a typing error in --images, or images of another format"
        )
        raise FileError(
            root, f"holds {len(frames)} {what}; a scan needs at least 2 frames", cause,
            f"give a folder of {'sub-folders, one for each frame' if sequences else ', '.join(ENDINGS) + ' files'}",
        )  # fmt: skip
    duplicates = [name for name, count in Counter(f.name for f in frames).items() if count > 1]
    if duplicates:
        raise FileError(
            root, f"holds several images named {duplicates[0]}", "the same capture in two formats", "keep one of them"
        )
    return _checked(frames)


def _checked(frames: Sequence[CapturedFrame]) -> Captures:
    sizes: dict[Path, tuple[int, int]] = {}
    faults: dict[str, FileError] = {}
    for frame in frames:
        for path in frame.images:
            try:
                header = read_header(path)
                sizes[path] = (header.w, header.h)
            except FileError as error:
                faults.setdefault(frame.name, error)
    if not sizes:
        raise next(iter(faults.values()))
    usual = Counter(sizes.values()).most_common(1)[0][0]
    for frame in frames:
        for path in frame.images:
            if path in sizes and sizes[path] != usual:
                faults.setdefault(frame.name, _other_size(path, sizes[path], usual))
    return Captures(tuple(frames), usual, faults)


def _other_size(path: Path, size: tuple[int, int], usual: tuple[int, int]) -> FileError:
    turned = size == usual[::-1]
    return FileError(
        path,
        f"is {size[0]} x {size[1]} pixels, most images are {usual[0]} x {usual[1]}",
        "the camera was held on its side and the image rotated afterwards"
        if turned
        else "resized, cropped, or taken by another camera or with another setting",
        "give all images as the camera took them; intrinsics are valid for one size only",
    )


def _single_images(root: Path) -> list[CapturedFrame]:
    return [CapturedFrame(path.stem, (path,)) for path in _images(root)]


def _folders(root: Path) -> list[CapturedFrame]:
    folders = sorted((p for p in root.iterdir() if p.is_dir() and not p.name.startswith(".")), key=_natural)
    return [CapturedFrame(folder.name, images) for folder in folders if (images := tuple(_images(folder)))]


def _images(folder: Path) -> list[Path]:
    found = (p for p in folder.iterdir() if p.suffix.lower() in ENDINGS and not p.name.startswith("."))
    return sorted(found, key=_natural)


def _natural(path: Path) -> list[tuple[int, int | str]]:
    """Sorting key with which image 10 comes after image 9."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in parts if part]
