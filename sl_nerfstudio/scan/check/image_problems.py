"""Frames whose coordinates are not those of their image: shifted, of another frame, or of no image at all."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from sl_nerfstudio.scan.check.convention_words import describe_coords
from sl_nerfstudio.scan.check.image_match import ImageMatch
from sl_nerfstudio.scan.problem import Problem

# Correlations. Right frames have 0.5 to 0.95, or little in all frames (coarse images, stripes in another light).
CLEAR = 0.4  # from here on, the pattern is recognised
_GAIN = 0.05  # of a move from there on: right frames gain nothing, and one pixel costs at least this
_FAINT, _LARGE_GAIN = 0.25, 0.15  # the same for images too coarse to show the pattern well
_RESTORED = 0.6  # share of the better frames' correlation that the right move gives back; a wrong one gives less
_NOTHING = 0.25  # share of the better frames' correlation below which a frame does not show the pattern at all
_OTHERS_GAIN = 0.3  # by which the coordinates fit the image of another frame better than their own
_AXES_GAIN = 0.1  # by which they fit with exchanged or mirrored axes: grids look alike, so it is less
_BETTER = 0.75  # quantile of the frames to which the others are compared


@dataclass(frozen=True)
class MatchedFrame:
    """A frame and how well its image fits its coordinates; None if it could not be compared."""

    name: str
    match: ImageMatch | None


Shown = tuple[Float32[ndarray, "h w"], Bool[ndarray, "h w"]]
"""An image, and where it shows the object."""


def image_problems(
    frames: Sequence[MatchedFrame], read_shown: Callable[[str], Shown | None]
) -> Iterator[tuple[str, Problem]]:
    """(frame, problem) of coordinates that do not belong to the image; `read_shown` gives the image of a frame."""
    known = [(frame.name, frame.match) for frame in frames if frame.match is not None]
    usual = float(np.quantile([match.correlation for _, match in known], _BETTER)) if known else 0.0
    strange = {name: match for name, match in known if match.correlation < max(_NOTHING * usual, CLEAR / 2)}
    others = _fitting_others(strange, [frame.name for frame in frames], read_shown)
    for name, match in known:
        other = others.get(name, ("", 0.0))
        if _is_shifted(match, usual) and match.moved > other[1]:
            yield name, _shifted(match)
        elif match.interpreted >= CLEAR and match.interpreted - match.correlation >= _AXES_GAIN:
            yield name, _other_axes(match)
        elif other[0]:
            yield name, _of_another_frame(match, *other)
        elif usual >= CLEAR and match.correlation < _NOTHING * usual:
            yield name, _of_no_image(match, usual)


def _is_shifted(match: ImageMatch, usual: float) -> bool:
    gain = match.moved - match.correlation
    enough = (match.moved >= CLEAR and gain >= _GAIN) or (match.moved >= _FAINT and gain >= _LARGE_GAIN)
    return (match.x, match.y) != (0, 0) and enough and match.moved >= _RESTORED * usual


def _fitting_others(
    strange: dict[str, ImageMatch], names: Sequence[str], read_shown: Callable[[str], Shown | None]
) -> dict[str, tuple[str, float]]:
    """For each frame, another one whose image its coordinates fit, with the correlation; each image is read once."""
    found: dict[str, tuple[str, float]] = {}
    for other in names if strange else ():
        shown = read_shown(other)
        if shown is None:
            continue
        for name, match in strange.items():
            correlation = 0.0 if name == other else match.prediction.correlation(*shown)
            enough = max(CLEAR, match.correlation + _OTHERS_GAIN)
            if correlation >= max(enough, found.get(name, ("", 0.0))[1]):
                found[name] = (other, correlation)
    return found


def _shifted(match: ImageMatch) -> Problem:
    return Problem(
        f"is shifted against the image: moved by {match.x} pixels to the right and {match.y} down it fits (correlation "
        f"with the pattern {match.moved:.2f} instead of {match.correlation:.2f})",
        "image or coordinates were cropped, padded or rolled after decoding",
        "give the image from which the coordinates were decoded, or decode it again",
    )


def _other_axes(match: ImageMatch) -> Problem:
    return describe_coords(
        match.other_axes,
        f"do not fit the image in this frame (correlation with the pattern {match.correlation:.2f}, otherwise "
        f"{match.interpreted:.2f})",
    )


def _of_another_frame(match: ImageMatch, other: str, correlation: float) -> Problem:
    return Problem(
        f"fits the image of frame {other} instead (correlation with the pattern {correlation:.2f}, with its own image "
        f"{match.correlation:.2f})",
        "files were renamed or mixed up",
        "give the coordinates that were decoded from this frame's image",
    )


def _of_no_image(match: ImageMatch, usual: float) -> Problem:
    return Problem(
        f"does not fit the image: correlation with the pattern {match.correlation:.2f}, in other frames {usual:.2f}",
        "the coordinates are noise, transposed, or those of another image, or the image is another one",
        "decode the image again, or leave the frame out",
    )
