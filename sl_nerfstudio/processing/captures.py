"""The photographs of each frame."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

from sl_nerfstudio.scan.file_error import FileError, unreadable
from sl_nerfstudio.scan.photographs import ENDINGS, RAW, photograph_header, raw_file, turned_by_tag

Size = tuple[int, int]  # (w, h)
_LISTED = 5  # faults of a frame in a message


@dataclass(frozen=True)
class CapturedFrame:
    """One frame: one photograph, or the photographs of a sequence in the order of projection."""

    name: str
    images: tuple[Path, ...]
    camera: str = ""  # the name of its camera; "" if there is only one


class SeveralFaults(FileError):
    """All faults of one frame, in one message."""

    def __init__(self, folder: Path, errors: Sequence[FileError]) -> None:
        """`folder` holds the frame's images."""
        listed = [f"{e.path.name if e.path != folder else 'the folder'} {e.problem}" for e in errors]
        more = f"; and {len(listed) - _LISTED} more" if len(listed) > _LISTED else ""
        causes, remedies = (dict.fromkeys(getattr(e, key) for e in errors) for key in ("cause", "remedy"))
        problem = f"has {len(errors)} faults: {'; '.join(listed[:_LISTED])}{more}"
        super().__init__(folder, problem, "; ".join(causes), "; ".join(remedies))
        self.errors = tuple(errors)


@dataclass(frozen=True)
class Captures:
    """All frames, and the faults of those that cannot be used."""

    frames: tuple[CapturedFrame, ...]  # sorted by name, with numbers sorted as numbers; cameras take turns
    sizes: dict[str, Size]  # of the images of each camera, by its name
    faults: dict[str, FileError]  # by the frame's name

    @property
    def size(self) -> Size:
        """The size of the first camera's images."""
        return next(iter(self.sizes.values()))

    def require_whole(self) -> list[CapturedFrame]:
        """The frames without faults. Raises the first fault if there are none."""
        whole = [frame for frame in self.frames if frame.name not in self.faults]
        if not whole:
            raise next(iter(self.faults.values()))
        return whole

    def with_faults(self, found: dict[str, FileError]) -> "Captures":
        """With more faults; those of one frame become one."""
        both = {name: [e for e in (self.faults.get(name), found.get(name)) if e] for name in {*self.faults, *found}}
        named = {frame.name: frame for frame in self.frames}
        return replace(self, faults={name: _together(named[name], errors) for name, errors in both.items()})


def find_captures(root: Path, sequences: bool, cameras: Sequence[str] = ()) -> Captures:
    """Frames in a folder: one image each or, with `sequences`, one sub-folder of images each.

    With the names of several `cameras`, the frames of each are in a sub-folder of that name. Of each camera the most
    frequent image size is taken to be right. Images of another size, and images that cannot be read, are faults of
    their frames. Raises FileError if there are fewer than two frames, or no folder for a camera.
    """
    if not os.path.isdir(root):  # Path.is_dir raises for a name that is too long
        raise FileError(root, "is no folder", "a typing error in --images", "give the folder with the captures")
    try:
        found = _of_cameras(root, sequences, cameras) if cameras else [_frames(root, sequences)]
        frames = [frame for turn in zip_longest(*found) for frame in turn if frame is not None]
        if len(frames) < 2:
            raise _too_few(root, sequences, len(frames))
    except OSError as error:
        raise unreadable(root, error) from error
    duplicates = [name for name, count in Counter(f.name for f in frames).items() if count > 1]
    if duplicates:
        raise FileError(
            root, f"holds several images named {duplicates[0]}", "the same capture in two formats", "keep one of them"
        )
    return _checked(frames)


def _too_few(root: Path, sequences: bool, count: int) -> FileError:
    raw = _images(root, RAW)
    if raw:
        return raw_file(raw[0])
    what = "folders with images" if sequences else "images"
    other = _single_images(root) if sequences else _folders(root)
    cause, remedy = "a typing error in --images, or images of another format", ""
    if len(other) > 1:
        cause = "the captures do not suit the pattern: a coded grid needs one image per frame, Gray code one sub-folder"
        remedy = "" if sequences else '; for several cameras, name them under "cameras" in the intrinsics file'
    wanted = "sub-folders, one for each frame" if sequences else f"{', '.join(ENDINGS)} files"
    return FileError(
        root, f"holds {count} {what}; a scan needs at least 2 frames", cause, f"give a folder of {wanted}{remedy}"
    )


def _of_cameras(root: Path, sequences: bool, cameras: Sequence[str]) -> list[list[CapturedFrame]]:
    there = {path.name for path in root.iterdir() if path.is_dir() and not path.name.startswith(".")}
    if there != set(cameras):
        raise FileError(
            root,
            f"has the folders {', '.join(sorted(there)) or 'none'}, the intrinsics file the cameras "
            f"{', '.join(cameras)}",
            "each camera that the file names has a folder of its name, with its captures",
            "rename the folders, or the cameras in the file",
        )
    return [
        [CapturedFrame(f"{name}_{frame.name}", frame.images, name) for frame in _frames(root / name, sequences)]
        for name in cameras
    ]


def _frames(root: Path, sequences: bool) -> list[CapturedFrame]:
    return _folders(root) if sequences else _single_images(root)


def _checked(frames: Sequence[CapturedFrame]) -> Captures:
    sizes: dict[Path, Size] = {}
    faults: dict[str, list[FileError]] = {}
    for frame in frames:
        for path in frame.images:
            try:
                header = photograph_header(path)
                sizes[path] = (header.w, header.h)
            except FileError as error:
                faults.setdefault(frame.name, []).append(error)
    usual: dict[str, Size] = {}
    for camera in dict.fromkeys(frame.camera for frame in frames):
        own = [path for frame in frames if frame.camera == camera for path in frame.images]
        known = [sizes[path] for path in own if path in sizes]
        if not known:
            raise next(faults[frame.name][0] for frame in frames if frame.camera == camera)
        usual[camera] = Counter(known).most_common(1)[0][0]
    for frame in frames:
        for path in frame.images:
            if path in sizes and sizes[path] != usual[frame.camera]:
                faults.setdefault(frame.name, []).append(_other_size(path, sizes[path], usual[frame.camera]))
    named = {frame.name: frame for frame in frames}
    return Captures(tuple(frames), usual, {name: _together(named[name], found) for name, found in faults.items()})


def _together(frame: CapturedFrame, errors: Sequence[FileError]) -> FileError:
    """One error of a frame for all of its faults."""
    every = [one for error in errors for one in (error.errors if isinstance(error, SeveralFaults) else [error])]
    return every[0] if len(every) == 1 else SeveralFaults(frame.images[0].parent, every)


def _other_size(path: Path, size: Size, usual: Size) -> FileError:
    cause = "resized, cropped, or taken by another camera or with another setting"
    if size == usual[::-1]:
        cause = "the camera was held on its side and the image rotated afterwards"
        if turned_by_tag(path):
            cause = "the camera was held on its side, as the image's EXIF tag says; the image was turned"
    return FileError(
        path,
        f"is {size[0]} x {size[1]} pixels, most images are {usual[0]} x {usual[1]}",
        cause,
        "give all images as the camera took them; intrinsics are valid for one size only",
    )


def _single_images(root: Path) -> list[CapturedFrame]:
    return [CapturedFrame(path.stem, (path,)) for path in _images(root)]


def _folders(root: Path) -> list[CapturedFrame]:
    folders = sorted((p for p in root.iterdir() if p.is_dir() and not p.name.startswith(".")), key=_natural)
    return [CapturedFrame(folder.name, images) for folder in folders if (images := tuple(_images(folder)))]


def _images(folder: Path, endings: Sequence[str] = ENDINGS) -> list[Path]:
    found = (p for p in folder.iterdir() if p.suffix.lower() in endings and not p.name.startswith("."))
    return sorted(found, key=_natural)


def _natural(path: Path) -> list[tuple[int, int | str]]:
    """Sorting key with which image 10 comes after image 9."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in parts if part]
