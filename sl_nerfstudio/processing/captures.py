"""The photographs of each frame, with the pattern and without, and the Gray-code sequence that they show."""

import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import DecodingError
from sl_nerfstudio.decoding.gray_code import check_count, decode_gray_code, take_samples
from sl_nerfstudio.decoding.gray_code_order import check_order, layout_of_images, possible_layouts, with_numbering
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.layout import CENTRED, PatternLayout, SequenceName
from sl_nerfstudio.processing.config import FEWEST_FRAMES
from sl_nerfstudio.review.verdict import listed
from sl_nerfstudio.scan.document import FileError, unreadable
from sl_nerfstudio.scan.images import (
    ENDINGS,
    RAW,
    Pixels,
    photograph_header,
    raw_file,
    read_photograph,
    turned_by_tag,
)

Size = tuple[int, int]  # (w, h)
_LISTED = 5  # faults of a frame in a message


@dataclass(frozen=True)
class CapturedFrame:
    """One frame: one photograph, or the photographs of a sequence in the order of projection."""

    name: str
    images: tuple[Path, ...]
    camera: str = ""  # the name of its camera; "" if there is only one
    shrink: int = 1  # squares of so many pixels are read as one

    def read(self, place: int) -> Pixels:
        """One of the photographs at the size that is decoded. Raises FileError."""
        return read_photograph(self.images[place], self.shrink)


class SeveralFaults(FileError):
    """All faults of one frame, in one message."""

    def __init__(self, folder: Path, errors: Sequence[FileError]) -> None:
        """`folder` holds the frame's images."""
        same: dict[str, list[str]] = {}
        for e in errors:
            same.setdefault(e.problem, []).append(e.path.name if e.path != folder else "the folder")
        found = [f"{listed(n, _LISTED)}{': each' if len(n) > 1 else ''} {problem}" for problem, n in same.items()]
        more = f"; and {len(found) - _LISTED} more" if len(found) > _LISTED else ""
        causes, remedies = (dict.fromkeys(getattr(e, key) for e in errors) for key in ("cause", "remedy"))
        problem = f"has {len(errors)} faults: {'; '.join(found[:_LISTED])}{more}"
        super().__init__(folder, problem, "; ".join(causes), "; ".join(remedies))
        self.errors = tuple(errors)


@dataclass(frozen=True)
class Captures:
    """All frames, and the faults of those that cannot be used."""

    frames: tuple[CapturedFrame, ...]  # sorted by name, with numbers sorted as numbers; cameras take turns
    sizes: dict[str, Size]  # of the photographs of each camera, by its name
    faults: dict[str, FileError]  # by the frame's name

    @property
    def size(self) -> Size:
        """The size of the first camera's images."""
        return next(iter(self.sizes.values()))

    def shrunk(self, factor: int) -> "Captures":
        """The same captures, to be read with squares of `factor` pixels as one."""
        return replace(self, frames=tuple(replace(frame, shrink=factor) for frame in self.frames))

    def require_whole(self) -> list[CapturedFrame]:
        """The frames without faults. Raises the first fault if there are none."""
        whole = [frame for frame in self.frames if frame.name not in self.faults]
        if not whole:
            raise next(iter(self.faults.values()))
        return whole

    def whole_of(self, camera: str) -> list[CapturedFrame]:
        """The frames of a camera that have no faults."""
        return [frame for frame in self.frames if frame.camera == camera and frame.name not in self.faults]

    def with_faults(self, found: dict[str, FileError]) -> "Captures":
        """Add faults; those of one frame become one."""
        both = {name: [e for e in (self.faults.get(name), found.get(name)) if e] for name in {*self.faults, *found}}
        named = {frame.name: frame for frame in self.frames}
        return replace(self, faults={name: _together(named[name], errors) for name, errors in both.items()})


def find_captures(
    root: Path,
    sequences: bool,
    cameras: Sequence[str] = (),
    needs: str = f"a scan needs at least {FEWEST_FRAMES} frames",
) -> Captures:
    """Frames in a folder: one image each or, with `sequences`, one sub-folder of images each.

    With the names of several `cameras`, the frames of each are in a sub-folder of that name. Of each camera the most
    frequent image size is taken to be right. Images of another size, and images that cannot be read, are faults of
    their frames. Raises FileError, which says what `needs` how many, if there are fewer than two frames, or no folder
    for a camera.
    """
    if not os.path.isdir(root):  # Path.is_dir raises for a name that is too long
        raise FileError(root, "is no folder", "a typing error in --images", "give the folder with the captures")
    try:
        found = _of_cameras(root, sequences, cameras) if cameras else [_frames(root, sequences)]
        frames = [frame for turn in zip_longest(*found) for frame in turn if frame is not None]
        if len(frames) < FEWEST_FRAMES:
            raise _too_few(root, sequences, len(frames), needs)
    except OSError as error:
        raise unreadable(root, error) from error
    duplicates = [name for name, count in Counter(f.name for f in frames).items() if count > 1]
    if duplicates:
        raise FileError(
            root, f"holds several images named {duplicates[0]}", "the same capture in two formats", "keep one of them"
        )
    return _checked(frames)


def _too_few(root: Path, sequences: bool, count: int, needed: str) -> FileError:
    folders = (path for path in sorted(root.iterdir()) if path.is_dir())
    inside = [path for path in folders if len(_frames(path, sequences)) > max(count, 1)]
    if len(inside) == 1 and not _images(root):
        return FileError(
            root,
            f"holds its captures in a folder of its own, {inside[0].name}",
            "--images is the folder with the captures, not the one around it",
            f"give --images {inside[0]}",
        )
    raw = _images(root, RAW)
    if raw:
        return raw_file(raw[0])
    what = "folders with images" if sequences else "images"
    cause, remedy = "a typing error in --images, or images of another format", ""
    if count:
        cause = f"too few were captured, or {cause}"
    if len(_frames(root, not sequences)) > 1:
        cause = "the captures do not suit the pattern: a coded grid needs one image per frame, Gray code one sub-folder"
        remedy = "" if sequences else '; for several cameras, name them under "cameras" in the intrinsics file'
    wanted = "sub-folders, one for each frame" if sequences else f"{', '.join(ENDINGS)} files"
    return FileError(root, f"holds {count} {what}; {needed}", cause, f"give a folder of {wanted}{remedy}")


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
        own = [frame for frame in frames if frame.camera == camera]
        known = [sizes[path] for frame in own for path in frame.images if path in sizes]
        if not known:
            raise _of_a_kind([error for frame in own for error in faults[frame.name]])[0]
        usual[camera] = Counter(known).most_common(1)[0][0]
    for frame in frames:
        for path in frame.images:
            if path in sizes and sizes[path] != usual[frame.camera]:
                faults.setdefault(frame.name, []).append(_other_size(path, sizes[path], usual[frame.camera]))
    named = {frame.name: frame for frame in frames}
    return Captures(tuple(frames), usual, {name: _together(named[name], found) for name, found in faults.items()})


def describe_faults(captures: Captures) -> list[str]:
    """What is wrong with the frames that cannot be used, in one message for each kind of fault."""
    return list(map(str, _of_a_kind(list(captures.faults.values()))))


def _of_a_kind(errors: Sequence[FileError]) -> list[FileError]:
    """One error for all files with the same problem, which names them."""
    same: dict[str, list[FileError]] = {}
    for error in errors:
        same.setdefault(error.problem, []).append(error)
    out = []
    for first, *others in same.values():
        names = [error.path.name for error in others]
        more = f" (and so {'are' if len(names) > 1 else 'is'} {listed(names, _LISTED)})"
        out.append(first.with_more(more) if names else first)
    return out


def with_others(faults: Sequence[FileError], most: int = 20) -> FileError:
    """The first fault, with the names of at most so many of the other files that cannot be used."""
    first, *others = faults
    names = listed([fault.path.name for fault in others], most)
    return first.with_more(f" (and {len(others)} more cannot be used: {names})") if others else first


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


def _frames(root: Path, sequences: bool) -> list[CapturedFrame]:
    """The images in a folder, or the folders in it that hold images."""
    if not sequences:
        return [CapturedFrame(path.stem, (path,)) for path in _images(root)]
    folders = sorted((p for p in root.iterdir() if p.is_dir() and not p.name.startswith(".")), key=_natural)
    return [CapturedFrame(folder.name, images) for folder in folders if (images := tuple(_images(folder)))]


def _images(folder: Path, endings: Sequence[str] = ENDINGS) -> list[Path]:
    found = (p for p in folder.iterdir() if p.suffix.lower() in endings and not p.name.startswith("."))
    return sorted(found, key=_natural)


def _natural(path: Path) -> list[tuple[int, int | str]]:
    """Sorting key with which image 10 comes after image 9."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in parts if part]


# The resolution of a projector of which only the captured Gray code is known.

STANDARD = (
    (640, 480), (854, 480), (800, 600), (1024, 768), (1280, 720), (1280, 800), (1280, 1024), (1400, 1050), (1920, 1080),
    (1920, 1200), (2560, 1440), (2560, 1600), (3840, 2160), (4096, 2160),
)  # fmt: skip
"""Resolutions of projectors, (w, h)."""
_BEYOND = 1e-3  # share of the pixels that may be misread as beyond the edge
_LOOKED_AT = 3  # frames


def likely_layout(captures: Captures, name: SequenceName) -> GrayCode:
    """The sequence of cells of one pixel with the smallest usual resolution that has room for all codes in the images.

    Raises FileError if no usual resolution has as many images.
    """
    whole = captures.require_whole()
    count = len(whole[0].images)
    if name in CENTRED:
        raise UserError(
            f"--sequence {name}: does not tell the projector's resolution\n    cause:  its codes depend on it\n"
            "    remedy: give the resolution, as --pattern 1024x768"
        )
    fitting = [layout for w, h in STANDARD if (layout := GrayCode.in_order(name, w, h)).images == count]
    if not fitting:
        raise FileError(
            whole[0].images[0].parent,
            f"holds {count} images, which the sequence {name} of no usual projector has, with cells of one pixel",
            "images are missing or too many, cells are larger, or the order is another",
            "give the projector's resolution, as --pattern 1024x768, or the pattern.json of what was projected",
        )
    reached = np.zeros(2)
    for _, cells in _cells_of(whole, fitting[-1], 1):
        reached = np.maximum(reached, _reach(cells))
    return next((layout for layout in fitting if layout.w >= reached[0] and layout.h >= reached[1]), fitting[-1])


def _cells_of(
    frames: Sequence[CapturedFrame], layout: GrayCode, step: int
) -> Iterator[tuple[CapturedFrame, Float32[ndarray, "h w 2"]]]:
    """Place in cells of every `step`th pixel of the first frames, whatever their bits say; NaN where not decoded."""
    columns, rows = (2**bits for bits in layout.bits)
    largest = GrayCode(columns, rows, 1, layout.shown)
    for frame in frames[:_LOOKED_AT]:
        try:
            images = [np.ascontiguousarray(read_photograph(path)[::step, ::step]) for path in frame.images]
            if check_order(take_samples(images), largest).misplaced:
                continue
            yield frame, decode_gray_code(images, largest).coords
        except (DecodingError, FileError):
            continue  # said when this frame is read


def _reach(cells: Float32[ndarray, "h w 2"]) -> Float64[ndarray, "2"]:
    """How far the cells of a frame reach, but for misread ones."""
    return np.nanquantile(cells.reshape(-1, 2), 1 - _BEYOND, axis=0)


# Whether the pattern has the stated resolution: by cells that it cannot have, and by where its edge is.

_IMPOSSIBLE = 5e-3  # share of a frame's decoded pixels beyond the edge that no misreading explains
_SIDE = 800  # pixels of a photograph's longer side that are looked at
_BANDS, _FEWEST_BANDS = 16, 6  # along an edge, that are compared
_STRAIGHT = 0.75  # share of the bands in which the pattern must end at the same cell
_LARGEST_CELL = 32
_NEAR = 0.03  # distance of an edge from where a resolution has it, as a share: the camera may see it coarsely
_MOST_LIKELY = 3  # resolutions that are named


def _require_resolution(captures: Captures, layout: GrayCode) -> None:
    """Raise FileError if the captures show that the projector has another resolution than that of `layout`.

    Cells beyond the stated ones cannot be. Cells that are missing tell where the edge of the pattern is seen: all rows
    end at the same column.
    """
    if any(layout.sines(axis) or not layout.bit_images(axis) for axis in (0, 1)):
        return
    whole = captures.require_whole()
    w, h = captures.size
    stated = np.array([layout.columns, layout.rows])
    for frame, cells in _cells_of(whole, layout, max(1, max(w, h) // _SIDE)):
        known = cells[all_finite(cells)]
        beyond = (known > stated + 0.5).mean(0) > _IMPOSSIBLE
        centred = (2 ** np.array(layout.bits) - stated) / 2  # by programs that count from the middle
        low = np.quantile(known, _BEYOND, axis=0)
        beyond &= ~((low > centred - 1) & (known < centred + stated + 1).all(0)) | (centred == 0)
        edge = np.array([_edge(known, axis) for axis in (0, 1)])
        missing = edge < (1 - _NEAR) * stated - 1.5
        if not beyond.any() and not missing.all():
            continue
        reach = np.where(np.isfinite(edge), edge, np.ceil(_reach(cells))).astype(int)
        likely = _likely_resolutions(layout, reach, edge)
        given, cells = f"{layout.w} x {layout.h} pixels", f"{stated[0]} x {stated[1]} cells"
        if beyond.any():
            cannot = f"which {given} cannot have ({cells} of {layout.cell})"
        elif likely:
            cannot = f"where it ends, and {given} have {cells}"
        else:
            continue  # something else than the edge of the pattern may have a straight border
        size = f"--pattern {likely[0].split()[0]}" if likely else "the resolution of the projector"
        raise FileError(
            frame.images[0].parent,
            f"shows {reach[0]} columns and {reach[1]} rows of cells, {cannot}",
            "--pattern gives another resolution than that of the projector, or of the window that showed the pattern"
            + (f"; likely: {' or '.join(likely)}" if likely else ""),
            f"give {size}, or the pattern.json of what was projected",
        )


def _edge(known: Float32[ndarray, "n 2"], axis: int) -> float:
    """The cell at which the pattern ends along an axis, in most bands of the other; NaN if its edge is not seen."""
    other = known[:, 1 - axis]
    band = np.clip((_BANDS * (other - other.min()) / max(float(np.ptp(other)), 1e-9)).astype(int), 0, _BANDS - 1)
    ends = [np.quantile(known[band == k, axis], 0.99) for k in range(_BANDS) if (band == k).sum() >= _BANDS]
    if len(ends) < _FEWEST_BANDS:
        return math.nan
    end = float(np.quantile(ends, 0.75))
    return float(round(end)) if np.mean(np.abs(np.array(ends) - end) < 1) >= _STRAIGHT else math.nan


def _likely_resolutions(layout: GrayCode, reach: Int64[ndarray, "2"], edge: Float64[ndarray, "2"]) -> list[str]:
    """Usual resolutions whose sequences have as many bits and room for these cells, "640x480 (cells of 2)".

    Where the edge of the pattern is seen, theirs must be there; the nearest and the smallest come first.
    """
    found = []
    for w, h in STANDARD:
        for cell in range(1, min(_LARGEST_CELL, h // 2) + 1):
            other = GrayCode(w, h, cell)
            beyond = np.array([other.columns, other.rows]) - reach
            far = np.where(np.isfinite(edge), np.abs(beyond) / reach, 0.0).max()
            another = other.bits == layout.bits and (w, h) != (layout.w, layout.h)
            if another and (beyond >= -1).all() and far < _NEAR:
                found.append((round(far, 2), cell, f"{w}x{h} (cells of {cell})"))
    return [text for *_, text in sorted(found)[:_MOST_LIKELY]]


# The sequence of a Gray code that another program showed: by its name, by the images, or both.

_RESOLUTION = re.compile(r"([1-9]\d{1,4})x([1-9]\d{1,4})")


def resolution(pattern: Path) -> tuple[int, int] | None:
    """(w, h) of a --pattern like 1024x768; None for a file."""
    found = _RESOLUTION.fullmatch(str(pattern))
    return None if found is None or pattern.exists() else (int(found[1]), int(found[2]))


def describe_sequence(layout: GrayCode) -> str:
    """One line for the output."""
    return (
        f"Gray code of {layout.w} x {layout.h} pixels in cells of {layout.cell}: {layout.images} images, order "
        f"{layout.order}{', cells numbered from the middle of the code' if layout.centred else ''}"
    )


def layout_in_order(path: Path, name: SequenceName | None) -> PatternLayout:
    """The pattern of a file, in the order of a program if one is named. Raises UserError unless it is a Gray code."""
    layout = read_layout(path)
    if name is None:
        return layout
    if not isinstance(layout, GrayCode):
        raise UserError(
            f"{path}: describes {layout.description}, which has no --sequence\n    cause:  the flag is for Gray code\n"
            "    remedy: leave --sequence out, or give the pattern.json of a Gray code"
        )
    return GrayCode.in_order(name, layout.w, layout.h, layout.cell)


def incomplete(captures: Captures, layout: GrayCode) -> dict[str, FileError]:
    """The fault of every frame that has not one image for each pattern, and the number that its names lack."""
    faults = {}
    for frame in captures.frames:
        try:
            check_count(len(frame.images), layout)
        except DecodingError as error:
            missing = _missing_numbers([path.stem for path in frame.images])
            gap = f" (by the names, {', '.join(missing[:3])} is missing)" if missing else ""
            problem = error.problem + gap
            faults[frame.name] = FileError(frame.images[0].parent, problem, error.cause, error.remedy)
    return faults


def _missing_numbers(stems: Sequence[str]) -> list[str]:
    """Numbers left out where names end in successive numbers, as "17"."""
    found = [re.search(r"(\d+)$", stem) for stem in stems]
    numbers = [int(match[1]) for match in found if match is not None]
    if len(numbers) != len(stems) or numbers != sorted(set(numbers)):
        return []
    gaps = sorted({*range(numbers[0], numbers[-1])} - {*numbers})
    return [str(n) for n in gaps] if len(gaps) <= len(numbers) // 4 + 1 else []


def recognise_sequence(
    captures: Captures, size: tuple[int, int], name: SequenceName | None, cell: int | None
) -> GrayCode:
    """The sequence that the captures show, for a projector of `size`; frames with faults are not looked at.

    Sequences that differ only where no image could tell are one. Raises UserError with the frame's folder if its images
    fit no known sequence, or more than one, if two frames show different ones, and if the projector has another size.
    """
    whole = captures.require_whole()
    found: dict[GrayCode, Path] = {}
    errors: list[UserError] = []
    centred = False
    for frame in whole[:_LOOKED_AT]:
        folder = frame.images[0].parent
        try:
            possible = possible_layouts(len(frame.images), size, name, cell)
            images = [read_photograph(path) for path in frame.images]
            if len(possible) == 1 and possible[0].bit_images(0) and name is not None:
                layout = with_numbering(possible[0], images)  # a frame that does not fit says so itself
            else:
                layout = layout_of_images(images, size, name, cell)
            centred = centred or layout.centred  # a frame that shows the middle alone does not tell
            found.setdefault(replace(layout, centred=False), folder)
        except FileError as error:
            errors.append(error)
        except DecodingError as error:
            errors.append(UserError(f"{folder}: {error}"))
    if not found:
        raise errors[0]
    if len(found) > 1:
        (first, here), (second, there) = list(found.items())[:2]
        raise UserError(
            f"{here} shows the sequence {first.order} (cells of {first.cell}), {there} {second.order} (cells of "
            f"{second.cell})\n    cause:  the folders hold captures of several sequences\n"
            "    remedy: process them separately, or name the sequence with --sequence"
        )
    layout = replace(next(iter(found)), centred=centred)
    _require_resolution(captures, layout)
    return layout


# Photographs without the pattern, from the same places: colours of the surface.


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
