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
from sl_nerfstudio.parallel import results, threads
from sl_nerfstudio.scan.check_conventions import convention_problems
from sl_nerfstudio.scan.check_geometry import Correspondences, GeometricFit, fit_geometry, sample_pixels
from sl_nerfstudio.scan.check_images import (
    CLEAR,
    ImageMatch,
    MatchedFrame,
    Shown,
    has_detail,
    image_problems,
    match_image,
    pattern_shift,
    shift_problems,
)
from sl_nerfstudio.scan.document import TRANSFORMS, Faults, FileError, Problem
from sl_nerfstudio.scan.images import as_grey, read_coords, read_image
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
_NOISE = 0.7  # of a typical distance from the median; a surface across 16 pixels has 0.25, independent values 1 to 1.5


def coordinate_problems(coords: Float32[ndarray, "h w 2"], projector: Device | None) -> Iterator[Problem]:
    """Everything that is wrong with one frame's coordinates; fewer checks if the projector is None."""
    x, y = coords[..., 0], coords[..., 1]  # separately: numpy is slow along an axis of two
    infinite = int((np.isinf(x) | np.isinf(y)).sum())
    if infinite:
        yield Problem(
            f"holds infinities at {infinite} pixels",
            "a division by zero in the decoder, or a marker for 'not decoded'",
            "write NaN where a pixel was not decoded",
        )
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
    value = pairs[most : most + 1].view(np.float32)
    count = int(counts[most])
    known = any((value == sentinel).all() for sentinel in _SENTINELS)
    if count <= _FEW or (not known and count <= _MANY_EQUAL * len(values)):
        return None
    return Problem(
        f"has the value ({value[0]:g}, {value[1]:g}) at {count} pixels",
        "it stands for 'not decoded'" if known else "it stands for 'not decoded', or the file is a placeholder",
        "write NaN where a pixel was not decoded",
    )


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
    outside, absurd = _beyond(values, size, _OUTSIDE), _beyond(values, size, _ABSURD)
    if outside.mean() > _MANY_OUTSIDE or absurd.any():
        many = bool(outside.mean() > _MANY_OUTSIDE)
        count = int(absurd.sum())
        some = "1 pixel" if count == 1 else f"{count} pixels"
        share = f"{100 * outside.mean():.0f} % of the pixels" if many else some
        yield Problem(
            f"puts {share} outside the pattern ({span})",
            _outside_cause(values, size, many),
            "store (x, y) in pixels of pattern.png, NaN where not decoded",
        )
    elif projector.model == "DOE":
        yield from _doe_problems(values, projector)


def _beyond(values: Float32[ndarray, "n 2"], size: Float32[ndarray, "2"], margin: float) -> Bool[ndarray, "n"]:
    """Find values outside a pattern of `size` by more than `margin` sizes."""
    x, y = values[:, 0] / size[0], values[:, 1] / size[1]
    return (x < -margin) | (x > 1 + margin) | (y < -margin) | (y > 1 + margin)


def _outside_cause(values: Float32[ndarray, "n 2"], size: Float32[ndarray, "2"], many: bool) -> str:
    if not many:
        return "a marker for 'not decoded', or a decoder that diverged"
    if _beyond(values, size[::-1], _OUTSIDE).mean() <= _MANY_OUTSIDE:
        return "x and y are swapped: the other way round they fit the pattern"
    return "they are coordinates of a pattern of another size, or in another unit"


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


def check_pattern(partial: PartialScan, good: set[Path], faults: Faults) -> PatternImage | None:
    """The projected pattern; None after adding a fault."""
    if partial.pattern_path is None or partial.pattern_path not in good:
        return None
    pattern = _read_image(partial.pattern_path, partial, None, faults)
    if pattern is None:
        return None
    if pattern.min() == pattern.max():
        faults.add(_nothing_in_it("the pattern"), relative(partial.pattern_path, partial.root))
        return None
    grey = as_grey(pattern)
    return PatternImage(grey, has_detail(grey))


def check_content(
    frame: PartialFrame, partial: PartialScan, pattern: PatternImage | None, good: set[Path], faults: Faults
) -> FrameContent:
    """Decode all files of a frame that are in `good`, and report what is wrong with their pixels."""
    image_path, pattern_path, coords_path, mask_path = (
        path if (path := frame.paths.get(key)) in good else None
        for key in ("file_path", "sl_pattern_path", "sl_coords_path", "mask_path")
    )
    coords = None if coords_path is None else _check_coords(coords_path, frame, partial, faults)
    mask = None if mask_path is None else _check_mask(mask_path, frame, partial, faults)
    decoded = None if coords is None else np.isfinite(coords[..., 0])  # and so is the other, or it would be a fault
    where = decoded if mask is None else mask
    both = None if decoded is None else (decoded if mask is None else decoded & mask)
    if mask_path and mask is not None and decoded is not None and _excludes_all(mask, decoded):
        problem = Problem(
            "excludes every pixel that has coordinates",
            "it is inverted, or is the mask of another frame",
            "mark with 255 where the pattern falls on the object, with 0 elsewhere",
        )
        faults.add(problem, relative(mask_path, partial.root), frame.name)
    image = None if image_path is None else _read_image(image_path, partial, frame.name, faults)
    shown, shown_path = image, image_path
    if "sl_pattern_path" in frame.paths:
        shown_path = pattern_path
        shown = None if pattern_path is None else _read_image(pattern_path, partial, frame.name, faults)
    compared = where if both is None else both
    if shown is not None and shown_path is not None and compared is not None and compared.shape == shown.shape[:2]:
        inside = shown[compared]
        if inside.size and inside.min() == inside.max():
            faults.add(_nothing_in_it("the image, where the mask is"), relative(shown_path, partial.root), frame.name)
    digest = None if image is None or coords is None else _digest(image, coords)
    shift = match = image_match = None
    if coords is not None and both is not None and where is not None and shown is not None and pattern is not None:
        grey = as_grey(shown)
        shift = pattern_shift(coords, both, grey, pattern.grey)
        if pattern.detailed:
            match = match_image(coords, both, pattern.grey, grey, where)
            if image is not None and shown is not image and image.shape[:2] == both.shape:
                image_match = match_image(coords, both, pattern.grey, as_grey(image), where)
    _check_color(frame, partial, match, where, good, faults)
    return FrameContent(
        frame.name,
        digest,
        0.0 if where is None else float(where.mean()),
        0.0 if both is None or where is None or not where.any() else float(both.sum() / where.sum()),
        _correspondences(frame, partial, coords, both),
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
        if content.digest is None:
            continue
        first = seen.setdefault(content.digest, content.name)
        if first != content.name:
            yield (
                content.name,
                Problem(
                    f"has the same image and coordinates as frame {first}",
                    "a frame was copied under another name",
                    "remove the copy; a frame counted twice makes uncertainties look too small",
                ),
            )


def _check_coords(
    path: Path, frame: PartialFrame, partial: PartialScan, faults: Faults
) -> Float32[ndarray, "h w 2"] | None:
    name = relative(path, partial.root)
    try:
        coords = read_coords(path)
    except FileError as error:
        faults.add(error, name, frame.name)
        return None
    problems = list(coordinate_problems(coords, partial.projector))
    for problem in problems:
        faults.add(problem, name, frame.name)
    return None if problems else coords


def _check_mask(path: Path, frame: PartialFrame, partial: PartialScan, faults: Faults) -> Bool[ndarray, "h w"] | None:
    mask = _read_image(path, partial, frame.name, faults)
    if mask is None:
        return None
    full = np.iinfo(mask.dtype).max
    values = np.flatnonzero(np.bincount(mask.ravel(), minlength=2))
    problem = None
    if values.max() == 0:
        problem = Problem(
            "is 0 everywhere",
            "the pattern was not found in this image, or the mask was never drawn",
            "mark the pixels where the pattern falls on the object with 255, or leave the frame out",
        )
    elif values.max() == 1:
        problem = Problem("has 0 and 1 instead of 0 and 255", "booleans were saved unchanged", "multiply it by 255")
    elif not set(values.tolist()) <= {0, full}:
        between = [value for value in values.tolist() if value not in (0, full)]
        problem = Problem(
            f"has grey levels between black and white ({between[0]}{', ..' if len(between) > 1 else ''})",
            "it was resized or saved with lossy compression, or is another kind of image",
            f"save it with 0 and {full} only, without lossy compression",
        )
    if problem is None:
        return mask == full
    faults.add(problem, relative(path, partial.root), frame.name)
    return None


def _check_color(
    frame: PartialFrame,
    partial: PartialScan,
    match: ImageMatch | None,
    where: Bool[ndarray, "_ _"] | None,
    good: set[Path],
    faults: Faults,
) -> None:
    """The picture without the pattern: can it be decoded, and does it really not show the pattern?"""
    path = frame.paths.get("sl_color_path")
    color = _read_image(path, partial, frame.name, faults) if path is not None and path in good else None
    if path is None or color is None:
        return
    problem = None
    if color.min() == color.max():
        problem = Problem(
            "has the same value everywhere",
            "a covered lens, or a dark room while the projector was off",
            "take the picture in even light, or leave sl_color_path out",
        )
    elif match is not None and where is not None:
        correlation = match.prediction.correlation(as_grey(color), where)
        if correlation >= CLEAR:
            problem = Problem(
                f"shows the pattern (correlation {correlation:.2f})",
                "it was taken with the pattern, or is another file",
                "give the picture that was taken without the pattern, or leave sl_color_path out",
            )
    if problem is not None:
        faults.add(problem, relative(path, partial.root), frame.name)


def _excludes_all(mask: Bool[ndarray, "h w"], decoded: Bool[ndarray, "_ _"]) -> bool:
    return mask.shape == decoded.shape and bool(decoded.any()) and not (mask & decoded).any()


def _read_image(path: Path, partial: PartialScan, frame: str | None, faults: Faults) -> ndarray | None:
    try:
        return read_image(path)
    except FileError as error:
        faults.add(error, relative(path, partial.root), frame)
        return None


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
    partial: PartialScan,
    coords: Float32[ndarray, "h w 2"] | None,
    where: Bool[ndarray, "h w"] | None,
) -> Correspondences | None:
    if coords is None or where is None or not where.any() or partial.projector is None:
        return None
    if frame.camera is None or frame.T_world_camera is None or frame.T_world_projector is None:
        return None
    uv_camera, uv_projector = sample_pixels(coords, where)
    return Correspondences(
        frame.name,
        frame.camera,
        frame.T_world_camera,
        frame.T_world_projector,
        uv_camera,
        uv_projector,
        frame.pose_sigma,
    )


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
        faults.add(problem, TRANSFORMS, None, "sl_coords_path")
    _check_conventions(partial, contents, faults)
    _check_images(frames, contents, good, faults)
    found = faults.found
    scan = None if found else partial.complete()
    if scan is not None:
        bar = scan.scale.bar
        found = _faults_raised(lambda: bar and measured_length(scan, bar, scan.poses)) + [
            replace(fault, file=f"{GROUND_TRUTH}/{fault.file}")
            for fault in _faults_raised(lambda: read_ground_truth(scan))
        ]
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
            faults.take(some)


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
            faults.add(problem, TRANSFORMS, frame, key)


def _check_images(
    frames: Sequence[PartialFrame], contents: Sequence[FrameContent], good: set[Path], faults: Faults
) -> None:
    """Do the coordinates of each frame belong to its images? Not asked where another fault was found in them."""
    by_name = {frame.name: frame for frame in frames}
    matched = [MatchedFrame(content.name, content.match) for content in contents]
    found = dict(image_problems(matched, lambda name: read_shown(by_name[name], good)))
    captured = [MatchedFrame(content.name, content.image_match) for content in contents]
    found = {**dict(image_problems(captured, lambda _: None)), **found}
    explained = {fault.frame for fault in faults.found if fault.field == "sl_coords_path"}
    for content in contents:
        if content.name in found and not {content.name, None} & explained:
            faults.add(found[content.name], TRANSFORMS, content.name, "sl_coords_path")


def _faults_raised(read: Callable[[], object]) -> list[Fault]:
    try:
        read()
    except ScanError as error:
        return error.faults
    return []
