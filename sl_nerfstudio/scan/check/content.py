"""The pixels of a scan: coordinates, masks, pattern images; one frame after another."""

from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.scan.check.coordinate_problems import coordinate_problems
from sl_nerfstudio.scan.check.correspondences import Correspondences, sample_pixels
from sl_nerfstudio.scan.check.image_match import ImageMatch, has_detail, match_image
from sl_nerfstudio.scan.check.image_problems import CLEAR, Shown
from sl_nerfstudio.scan.check.pattern_shift import pattern_shift
from sl_nerfstudio.scan.coordinates import read_coords
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.headers import relative
from sl_nerfstudio.scan.images import as_grey, read_image
from sl_nerfstudio.scan.partial_scan import PartialFrame, PartialScan
from sl_nerfstudio.scan.problem import Faults, Problem


@dataclass(frozen=True)
class FrameContent:
    """What is kept of a frame after its pixels were checked."""

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
    frame: PartialFrame,
    partial: PartialScan,
    pattern: PatternImage | None,
    good: set[Path],
    faults: Faults,
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
    if mask_path and coords_path and mask is not None and decoded is not None:
        for problem in _together_problems(mask, decoded):
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
    """What a frame shows of the pattern, and where; None if a file of it is damaged or absent."""
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
    if color.min() == color.max():
        faults.add(_EMPTY_PICTURE, relative(path, partial.root), frame.name)
    elif match is not None and where is not None:
        correlation = match.prediction.correlation(as_grey(color), where)
        if correlation >= CLEAR:
            faults.add(_shows_pattern(correlation), relative(path, partial.root), frame.name)


_EMPTY_PICTURE = Problem(
    "has the same value everywhere",
    "a covered lens, or a dark room while the projector was off",
    "take the picture in even light, or leave sl_color_path out",
)


def _shows_pattern(correlation: float) -> Problem:
    return Problem(
        f"shows the pattern (correlation {correlation:.2f})",
        "it was taken with the pattern, or is another file",
        "give the picture that was taken without the pattern, or leave sl_color_path out",
    )


def _together_problems(mask: Bool[ndarray, "h w"], decoded: Bool[ndarray, "h w"]) -> Iterator[Problem]:
    if mask.shape == decoded.shape and decoded.any() and not (mask & decoded).any():
        yield Problem(
            "excludes every pixel that has coordinates",
            "it is inverted, or is the mask of another frame",
            "mark with 255 where the pattern falls on the object, with 0 elsewhere",
        )


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
        frame.name, frame.camera, frame.T_world_camera, frame.T_world_projector, uv_camera, uv_projector
    )
