"""The sequence of a Gray code that another program showed: by its name, by the images, or both."""

import re
from collections.abc import Sequence
from pathlib import Path

from sl_nerfstudio.decoding.decoded import DecodingError
from sl_nerfstudio.decoding.graycode.decode import check_count
from sl_nerfstudio.decoding.graycode.recognition import layout_of_images, possible_layouts
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.pattern.sequence import SequenceName
from sl_nerfstudio.processing.captures import Captures
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.photographs import read_photograph

_RESOLUTION = re.compile(r"([1-9]\d{1,4})x([1-9]\d{1,4})")
_LOOKED_AT = 3  # frames


def resolution(pattern: Path) -> tuple[int, int] | None:
    """(w, h) of a --pattern like 1024x768; None for a file."""
    found = _RESOLUTION.fullmatch(str(pattern))
    return None if found is None or pattern.exists() else (int(found[1]), int(found[2]))


def describe_sequence(layout: GrayCode) -> str:
    """One line for the output."""
    return (
        f"Gray code of {layout.w} x {layout.h} pixels in cells of {layout.cell}: {layout.images} images, order "
        f"{layout.order}"
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
    gaps = [n for n in range(numbers[0], numbers[-1]) if n not in set(numbers)] if len(numbers) > 1 else []
    return [str(n) for n in gaps] if len(gaps) <= len(numbers) // 4 + 1 else []


def recognise_sequence(
    captures: Captures, size: tuple[int, int], name: SequenceName | None, cell: int | None
) -> GrayCode:
    """The sequence that the captures show, for a projector of `size`; frames with faults are not looked at.

    Sequences that differ only where no image could tell are one. Raises UserError with the frame's folder if its images
    fit no known sequence, or more than one, and if two frames show different ones.
    """
    whole = captures.require_whole()
    found: dict[GrayCode, Path] = {}
    errors: list[UserError] = []
    for frame in whole[:_LOOKED_AT]:
        folder = frame.images[0].parent
        try:
            possible = possible_layouts(len(frame.images), size, name, cell)
            if len(possible) == 1 and possible[0].bit_images(0) and name is not None:
                found.setdefault(possible[0], folder)  # nothing to recognise: a frame that does not fit says so itself
                continue
            found.setdefault(layout_of_images([read_photograph(p) for p in frame.images], size, name, cell), folder)
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
    return next(iter(found))
