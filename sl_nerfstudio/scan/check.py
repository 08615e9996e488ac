"""The full check of a scan folder: everything `read_scan` checks, every pixel, and whether all of it fits together."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial as bound
from hashlib import blake2b
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.console import track
from sl_nerfstudio.errors import Fault, ScanError
from sl_nerfstudio.geometry.devices import Device, Intrinsics, unproject
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.parallel import results, threads
from sl_nerfstudio.scan.check_conventions import convention_problems
from sl_nerfstudio.scan.check_geometry import Correspondences, GeometricFit, fit_geometry, sample_pixels
from sl_nerfstudio.scan.check_images import (
    CLEAR,
    ImageMatch,
    Shown,
    has_detail,
    image_problems,
    match_image,
    pattern_shift,
    shift_problems,
)
from sl_nerfstudio.scan.coordinates import COORDS_KEYS, FULL, UNITS_KEY, CoordinateFiles
from sl_nerfstudio.scan.document import TRANSFORMS, Faults, FileError, Problem
from sl_nerfstudio.scan.images import as_grey, read_image
from sl_nerfstudio.scan.read import PartialFrame, PartialScan, check_headers, read_partial_scan, relative
from sl_nerfstudio.scan.types import UNITS, Scan, measured_length
from sl_nerfstudio.scan.write import GROUND_TRUTH, read_ground_truth

# What can be wrong with the numbers of a coordinate file.

_OUTSIDE = 0.05  # of the pattern's size: a decoder may extrapolate this far beyond the border
_MANY_OUTSIDE = 0.05  # share of the pixels that may be farther out: wrong decodings
_ABSURD = 4.0  # pattern sizes: no decoder puts a pixel this far beyond the border
_SENTINELS = ((-1.0, -1.0), (0.0, 0.0))
_MANY_EQUAL = 0.02  # share of the decoded pixels with one value; neighbours may share a coordinate, but not so many
_FEW = 20
_FEWEST_NEIGHBOURS = 200
_WRITE_NAN = "write NaN where a pixel was not decoded"
_WRITE_ZERO = "write 0 in the images of x and y where a pixel was not decoded"  # in 16 bits there is no NaN
_NOISE = 0.7  # of a typical distance from the median; a surface across 16 pixels has 0.25, independent values 1 to 1.5


def coordinate_problems(coords: Float32[ndarray, "h w 2"], projector: Device | None) -> Iterator[Problem]:
    """Everything that is wrong with one frame's coordinates; fewer checks if the projector is None."""
    x, y = coords[..., 0], coords[..., 1]  # separately: numpy is slow along an axis of two
    infinite = int((np.isinf(x) | np.isinf(y)).sum())
    if infinite:
        cause = "a division by zero in the decoder, or a marker for 'not decoded'"
        yield Problem(f"holds infinities at {infinite} pixels", cause, _WRITE_NAN)
        return
    has_x, has_y = ~np.isnan(x), ~np.isnan(y)
    half = int((has_x != has_y).sum())
    if half:
        yield Problem(
            f"has only one of x_p and y_p at {half} pixels",
            "the two were decoded separately and not combined",
            "write NaN for both where either is missing",
        )
    values = coords[has_x & has_y]
    if not len(values):
        yield Problem(
            "is NaN everywhere",
            "decoding failed: the pattern was not found in this image",
            "decode it again (exposure, focus, ambient light), or leave the frame out",
        )
        return
    sentinel = _sentinel_problem(values)
    if sentinel is not None:
        yield sentinel
        return
    if _is_noise(coords, values):
        yield Problem(
            "is noise: neighbouring pixels have coordinates as far apart as any two",
            "the array was written in another order or type, or nothing was decoded",
            "decode the image again, or leave the frame out",
        )
        return
    if (values == np.floor(values)).all():
        yield Problem(
            "holds whole numbers only",
            "they are pixel indices, as Gray-code decoders give them; here the centre of a pixel is at .5",
            "add 0.5 to both coordinates",
        )
    if projector is not None:
        yield from _range_problems(values, projector)


def _is_noise(coords: Float32[ndarray, "h w 2"], values: Float32[ndarray, "n 2"]) -> bool:
    """Whether most neighbours in a row differ like pixels anywhere; on a surface they are a footprint apart."""
    left, right = coords[:, :-1], coords[:, 1:]
    both = np.isfinite(left[..., 0]) & np.isfinite(right[..., 0])
    if both.sum() < _FEWEST_NEIGHBOURS:
        return False
    step = np.median(np.abs(right[both] - left[both]), 0)
    spread = np.median(np.abs(values - np.median(values, 0)), 0)
    return bool((step > _NOISE * spread).all())


def _sentinel_problem(values: Float32[ndarray, "n 2"]) -> Problem | None:
    """A value that stands for 'not decoded'."""
    pairs, counts = np.unique(np.ascontiguousarray(values).view(np.uint64).ravel(), return_counts=True)
    most = int(counts.argmax())
    value, count = pairs[most : most + 1].view(np.float32), int(counts[most])
    known = any((value == sentinel).all() for sentinel in _SENTINELS)
    if count <= _FEW or (not known and count <= _MANY_EQUAL * len(values)):
        return None
    cause = "it stands for 'not decoded'" + ("" if known else ", or the file is a placeholder")
    return Problem(f"has the value ({value[0]:g}, {value[1]:g}) at {count} pixels", cause, _WRITE_NAN)


def _range_problems(values: Float32[ndarray, "n 2"], projector: Device) -> Iterator[Problem]:
    size = np.array([projector.w, projector.h], dtype=np.float32)
    low, high = values.min(0), values.max(0)
    span = f"x_p {low[0]:g} to {high[0]:g}, y_p {low[1]:g} to {high[1]:g}; pattern {projector.w} x {projector.h}"
    if (size > 8).all() and (low >= -1.01).all() and (high <= 1.01).all():
        yield Problem(
            f"lies between -1 and 1 ({span})",
            "the coordinates are normalised",
            "store pattern pixels: multiply by the pattern's size, x to the right and y down",
        )
        return
    outside, absurd = float(_beyond(values, size, _OUTSIDE).mean()), int(_beyond(values, size, _ABSURD).sum())
    if outside > _MANY_OUTSIDE:
        share = f"{100 * outside:.0f} % of the pixels"
        cause = "they are coordinates of a pattern of another size, or in another unit"
        if _beyond(values, size[::-1], _OUTSIDE).mean() <= _MANY_OUTSIDE:
            cause = "x and y are swapped: the other way round they fit the pattern"
    elif absurd:
        share = "1 pixel" if absurd == 1 else f"{absurd} pixels"
        cause = "a marker for 'not decoded', or a decoder that diverged"
    else:
        if projector.model == "DOE":
            yield from _doe_problems(values, projector)
        return
    remedy = "store (x, y) in pixels of pattern.png, NaN where not decoded"
    yield Problem(f"puts {share} outside the pattern ({span})", cause, remedy)


def _beyond(values: Float32[ndarray, "n 2"], size: Float32[ndarray, "2"], margin: float) -> Bool[ndarray, "n"]:
    """Find values outside a pattern of `size` by more than `margin` sizes."""
    x, y = values[:, 0] / size[0], values[:, 1] / size[1]
    return (x < -margin) | (x > 1 + margin) | (y < -margin) | (y > 1 + margin)


def _doe_problems(values: Float32[ndarray, "n 2"], projector: Device) -> Iterator[Problem]:
    directions = unproject(Intrinsics.of(projector, torch.float64), torch.from_numpy(values.astype(np.float64)))
    beyond = int((~directions.isfinite().all(-1)).sum())
    if beyond:
        yield Problem(
            f"has {beyond} pixels more than 90 degrees from the axis of the DOE projector, where it sends no light",
            "the focal lengths of the projector are too small, or it is not a DOE",
            "check fl_x, fl_y and model of the projector",
        )


# The pixels of a scan: coordinates, masks, pattern images; one frame after another.


@dataclass(frozen=True)
class FrameContent:
    """Facts kept of a frame after its pixels were checked."""

    name: str
    digest: bytes | None  # of image and coordinates; None if either could not be read
    masked: float  # share of the image under the mask
    decoded: float  # share of the masked pixels that have coordinates
    correspondences: Correspondences | None  # None if the frame cannot be triangulated
    shift: Float64[ndarray, "2"] | None  # what to add to the coordinates for the pattern to fit; None if unclear
    match: ImageMatch | None  # of coordinates and normalised pattern (captured image); None if not comparable
    image_match: ImageMatch | None  # of coordinates and captured image, where the frame has both images


@dataclass(frozen=True)
class PatternImage:
    """The projected pattern, in [0, 1]."""

    grey: Float32[ndarray, "rows columns"]
    detailed: bool  # so that frames can be told by what they show of it


@dataclass(frozen=True)
class _Files:
    """The files of a frame that can be decoded, by their keys, and where their faults are collected."""

    paths: dict[str, Path]
    root: Path
    frame: str | None  # None: of all frames
    faults: Faults

    def read(self, key: str, read: Callable[[Path], ndarray] = read_image) -> ndarray | None:
        """The pixels; None if there are none, or after adding a fault."""
        try:
            return read(self.paths[key]) if key in self.paths else None
        except FileError as error:
            self.add(error, key)
            return None

    def add(self, problem: Problem | FileError, key: str) -> None:
        """Add a fault of one of the files."""
        self.faults.add(problem, relative(self.paths[key], self.root), self.frame)


def check_pattern(partial: PartialScan, good: set[Path], faults: Faults) -> PatternImage | None:
    """The projected pattern; None after adding a fault."""
    path = partial.pattern_path
    files = _Files({"pattern": path} if path is not None and path in good else {}, partial.root, None, faults)
    pattern = files.read("pattern")
    if pattern is None:
        return None
    if pattern.min() == pattern.max():
        files.add(_nothing_in_it("the pattern"), "pattern")
        return None
    grey = as_grey(pattern)
    return PatternImage(grey, has_detail(grey))


def check_content(
    frame: PartialFrame, partial: PartialScan, pattern: PatternImage | None, good: set[Path], faults: Faults
) -> FrameContent:
    """Decode all files of a frame that are in `good`, and report what is wrong with their pixels."""
    files = _Files({key: path for key, path in frame.paths.items() if path in good}, partial.root, frame.name, faults)
    coords, mask = _check_coords(files, frame, partial.projector), _check_mask(files)
    decoded = None if coords is None else np.isfinite(coords[..., 0])  # and so is the other, or it would be a fault
    where = decoded if mask is None else mask
    both = decoded if decoded is None or mask is None else decoded & mask
    if mask is not None and decoded is not None and decoded.any() and not (decoded & mask).any():
        files.add(
            Problem(
                "excludes every pixel that has coordinates",
                "it is inverted, or is the mask of another frame",
                "mark with 255 where the pattern falls on the object, with 0 elsewhere",
            ),
            "mask_path",
        )
    image = files.read("file_path")
    shown_key = "sl_pattern_path" if "sl_pattern_path" in frame.paths else "file_path"
    shown = image if shown_key == "file_path" else files.read(shown_key)
    compared = where if both is None else both
    if shown is not None and compared is not None and compared.shape == shown.shape[:2]:
        inside = shown[compared]
        if inside.size and inside.min() == inside.max():
            files.add(_nothing_in_it("the image, where the mask is"), shown_key)
    shift = match = image_match = None
    if coords is not None and both is not None and where is not None and shown is not None and pattern is not None:
        grey = as_grey(shown)
        shift = pattern_shift(coords, both, grey, pattern.grey)
        if pattern.detailed:
            match = match_image(coords, both, pattern.grey, grey, where)
            if image is not None and shown is not image and image.shape[:2] == both.shape:
                image_match = match_image(coords, both, pattern.grey, as_grey(image), where)
    _check_color(files, match, where)
    return FrameContent(
        frame.name,
        None if image is None or coords is None else _digest(image, coords),
        0.0 if where is None else float(where.mean()),
        0.0 if both is None or where is None or not where.any() else float(both.sum() / where.sum()),
        _correspondences(frame, partial.projector, coords, both),
        shift,
        match,
        image_match,
    )


def read_shown(frame: PartialFrame, good: set[Path]) -> Shown | None:
    """Read what a frame shows of the pattern, and where; None if one of its files is damaged or absent."""
    path, mask_path = frame.paths.get("sl_pattern_path", frame.paths.get("file_path")), frame.paths.get("mask_path")
    if path not in good:
        return None
    try:
        shown = as_grey(read_image(path))
        mask = np.ones(shown.shape, dtype=bool) if mask_path not in good else read_image(mask_path) > 0
    except FileError:
        return None
    return (shown, mask) if shown.shape == mask.shape else None


def duplicate_problems(contents: list[FrameContent]) -> Iterator[tuple[str, Problem]]:
    """(frame, problem) of each frame with the same image and the same coordinates as an earlier one."""
    seen: dict[bytes, str] = {}
    for content in contents:
        first = content.name if content.digest is None else seen.setdefault(content.digest, content.name)
        if first != content.name:
            problem = Problem(
                f"has the same image and coordinates as frame {first}",
                "a frame was copied under another name",
                "remove the copy; a frame counted twice makes uncertainties look too small",
            )
            yield content.name, problem


def _check_coords(files: _Files, frame: PartialFrame, projector: Device | None) -> Float32[ndarray, "h w 2"] | None:
    stored = frame.coords_files(projector)
    if stored is None or not set(stored.paths) <= set(files.paths.values()):
        return None
    try:
        coords = stored.read()
    except FileError as error:
        files.faults.add(error, relative(error.path, files.root), files.frame)
        return None
    problem = None if projector is None or not stored.are_images else _unit_problem(coords, stored)
    problems = list(coordinate_problems(coords, projector)) if problem is None else [problem]
    for problem in problems:
        if problem.remedy == _WRITE_NAN and len(stored.paths) == 2:
            problem = replace(problem, remedy=_WRITE_ZERO)
        files.add(problem, frame.coords_key)
    return None if problems else coords


def _unit_problem(coords: Float32[ndarray, "h w 2"], stored: CoordinateFiles) -> Problem | None:
    """What is wrong with the stated unit of images: their numbers make sense in the other one only."""
    values, size = coords[all_finite(coords)], np.array(stored.pattern, dtype=np.float32)
    if not len(values):
        return None
    low, high = values.min(0), values.max(0)
    span = f"x_p {low[0]:g} to {high[0]:g}, y_p {low[1]:g} to {high[1]:g}; pattern {size[0]:g} x {size[1]:g}"
    if stored.units == "parts_of_65535" and (high * FULL <= (1 + _OUTSIDE) * size**2).all():
        return Problem(
            f"shows no more than the first {100 * float((high / size).max()):.2g} % of the pattern ({span})",
            "the numbers are pattern pixels or shares of 1, not parts of 65535",
            f'state "{UNITS_KEY}": "pixels" if they are pixels; multiply shares of 1 by {FULL}',
        )
    if stored.units == "pixels" and (high <= FULL + 1).all():
        parts = values / FULL * size
        if _beyond(values, size, _OUTSIDE).mean() > _MANY_OUTSIDE and _beyond(parts, size, 0.0).mean() <= _MANY_OUTSIDE:
            share = 100 * float(_beyond(values, size, _OUTSIDE).mean())
            return Problem(
                f"puts {share:.0f} % of the pixels outside the pattern ({span})",
                "the numbers are parts of 65535, or pixels of a pattern of another size",
                f'state "{UNITS_KEY}": "parts_of_65535" if they are; else store pixels of pattern.png',
            )
    return None


def _check_mask(files: _Files) -> Bool[ndarray, "h w"] | None:
    mask = files.read("mask_path")
    if mask is None:
        return None
    full = np.iinfo(mask.dtype).max
    values = np.flatnonzero(np.bincount(mask.ravel(), minlength=2)).tolist()
    between = [value for value in values if value not in (0, full)]
    if values == [0]:
        problem = Problem(
            "is 0 everywhere",
            "the pattern was not found in this image, or the mask was never drawn",
            "mark the pixels where the pattern falls on the object with 255, or leave the frame out",
        )
    elif values[-1] == 1:
        problem = Problem("has 0 and 1 instead of 0 and 255", "booleans were saved unchanged", "multiply it by 255")
    elif between:
        problem = Problem(
            f"has grey levels between black and white ({between[0]}{', ..' if len(between) > 1 else ''})",
            "it was resized or saved with lossy compression, or is another kind of image",
            f"save it with 0 and {full} only, without lossy compression",
        )
    else:
        return mask == full
    files.add(problem, "mask_path")
    return None


def _check_color(files: _Files, match: ImageMatch | None, where: Bool[ndarray, "_ _"] | None) -> None:
    """The picture without the pattern: can it be decoded, and does it really not show the pattern?"""
    color = files.read("sl_color_path")
    if color is None:
        return
    if color.min() == color.max():
        problem = Problem(
            "has the same value everywhere",
            "a covered lens, or a dark room while the projector was off",
            "take the picture in even light, or leave sl_color_path out",
        )
        files.add(problem, "sl_color_path")
    elif match is not None and where is not None:
        correlation = match.prediction.correlation(as_grey(color), where)
        if correlation >= CLEAR:
            problem = Problem(
                f"shows the pattern (correlation {correlation:.2f})",
                "it was taken with the pattern, or is another file",
                "give the picture that was taken without the pattern, or leave sl_color_path out",
            )
            files.add(problem, "sl_color_path")


def _nothing_in_it(what: str) -> Problem:
    return Problem(
        f"has the same value everywhere in {what}",
        "an empty export, a covered lens, or a projector that was off",
        "give an image of the pattern; without contrast nothing can be compared with it",
    )


def _digest(image: ndarray, coords: Float32[ndarray, "h w 2"]) -> bytes:
    digest = blake2b(image.tobytes(), digest_size=16)
    digest.update(coords[np.isfinite(coords[..., 0])].tobytes())
    return digest.digest()


def _correspondences(
    frame: PartialFrame,
    projector: Device | None,
    coords: Float32[ndarray, "h w 2"] | None,
    where: Bool[ndarray, "h w"] | None,
) -> Correspondences | None:
    if coords is None or where is None or not where.any() or projector is None:
        return None
    if frame.camera is None or frame.T_world_camera is None or frame.T_world_projector is None:
        return None
    poses, pixels = (frame.T_world_camera, frame.T_world_projector), sample_pixels(coords, where)
    return Correspondences(frame.name, frame.camera, *poses, *pixels, frame.pose_sigma)


@dataclass(frozen=True)
class FolderCheck:
    """The result of a check: faults, or, if there are none, the scan with its figures."""

    faults: tuple[Fault, ...]
    scan: Scan | None  # None if there are faults
    fit: GeometricFit | None  # of the starting poses; None if there are faults
    contents: tuple[FrameContent, ...]


def check_folder(root: Path) -> FolderCheck:
    """Check a whole folder, with a progress bar; faults are returned, not raised. Memory holds a frame a thread."""
    root = Path(os.path.realpath(root))
    faults = Faults()
    partial = read_partial_scan(root, faults)
    good = check_headers(partial, faults)
    pattern = check_pattern(partial, good, faults)
    frames = list({frame.name: frame for frame in reversed(partial.frames)}.values())[::-1]  # a name twice is a fault
    contents = list(track(_contents(frames, partial, pattern, good, faults), "Checking the scan", len(frames)))
    for name, duplicate in duplicate_problems(contents):
        faults.add(duplicate, TRANSFORMS, name)
    for problem in shift_problems([content.shift for content in contents]):
        faults.add(problem, TRANSFORMS, None, frames[0].coords_key)
    _check_conventions(partial, contents, faults)
    _check_images(frames, contents, good, faults)
    found = faults.found
    scan = None if found else partial.complete()
    if scan is not None:
        bar = scan.scale.bar
        found = _faults_raised(lambda: bar and measured_length(scan, bar, scan.poses))
        truth = _faults_raised(lambda: read_ground_truth(scan))
        found += [replace(fault, file=f"{GROUND_TRUTH}/{fault.file}") for fault in truth]
    if scan is None or found:
        return FolderCheck(tuple(found), None, None, tuple(contents))
    usable = [c.correspondences for c in contents if c.correspondences is not None]
    return FolderCheck((), scan, fit_geometry(usable, scan.projector), tuple(contents))


def _contents(
    frames: Sequence[PartialFrame], partial: PartialScan, pattern: PatternImage | None, good: set[Path], faults: Faults
) -> Iterator[FrameContent]:
    """Check frames in threads; the faults come in the order of the frames, whichever was done first."""
    together = threads()
    for first in range(0, len(frames), together):
        group = frames[first : first + together]
        own = [Faults() for _ in group]
        pairs = zip(group, own, strict=True)
        yield from results([bound(check_content, frame, partial, pattern, good, f) for frame, f in pairs])
        for some in own:
            faults.take(some.found)


def check_scan(root: Path | str) -> list[Fault]:
    """All faults of a scan folder; empty if it is good."""
    return list(check_folder(Path(root)).faults)


def require_valid(root: Path) -> Scan:
    """The scan in a folder that passes the full check. Raises ScanError with all faults otherwise."""
    result = check_folder(root)
    if result.scan is None:
        raise ScanError(result.faults, str(root))
    return result.scan


def _check_conventions(partial: PartialScan, contents: list[FrameContent], faults: Faults) -> None:
    frames = [c.correspondences for c in contents if c.correspondences is not None]
    if partial.projector is None or not frames:
        return
    metres = None if partial.units is None else UNITS[partial.units]
    with np.errstate(all="ignore"):
        for frame, key, problem in convention_problems(frames, partial.projector, metres):
            where = [one for one in partial.frames if frame in (None, one.name)]
            faults.add(problem, TRANSFORMS, frame, where[0].coords_key if key in COORDS_KEYS else key)


def _check_images(
    frames: Sequence[PartialFrame], contents: Sequence[FrameContent], good: set[Path], faults: Faults
) -> None:
    """Do the coordinates of each frame belong to its images? Not asked where another fault was found in them."""
    by_name = {frame.name: frame for frame in frames}
    shown = image_problems({c.name: c.match for c in contents}, lambda name: read_shown(by_name[name], good))
    captured = image_problems({c.name: c.image_match for c in contents}, lambda _: None)
    found = {**dict(captured), **dict(shown)}
    explained = {fault.frame for fault in faults.found if fault.field in COORDS_KEYS}
    for content in contents:
        if content.name in found and not {content.name, None} & explained:
            faults.add(found[content.name], TRANSFORMS, content.name, by_name[content.name].coords_key)


def _faults_raised(read: Callable[[], object]) -> list[Fault]:
    try:
        read()
    except ScanError as error:
        return error.faults
    return []
