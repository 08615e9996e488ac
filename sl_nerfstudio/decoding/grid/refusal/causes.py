"""The error of a capture that cannot be decoded, with the causes that its measurements show."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.decoding.decoded import DecodingError
from sl_nerfstudio.decoding.grid.detection import LEAST_NODES, DetectedGrid, GridDetector
from sl_nerfstudio.decoding.grid.phase_reader import clear_places
from sl_nerfstudio.decoding.grid.refusal.exposure import Exposure, measure_exposure
from sl_nerfstudio.decoding.grid.refusal.sharpness import edge_width, line_blur
from sl_nerfstudio.decoding.grid.refusal.symbols import mirrored, shows_grid, shows_readable_symbols
from sl_nerfstudio.pattern.grid import GridPattern

_BLANK = 4 / 255  # of brightness between the darkest and the brightest pixel
_MOST_SATURATED = 0.15  # share of the pixels
_LEAST_CONTRAST = 2.5  # of the details, in standard deviations of the noise
_DARK = 0.25  # brightness, of the brightest parts
_MOST_BLUR = 0.18  # sigma of the lines, periods: they are a fifth of a period wide
_WIDEST_EDGE = 1.8  # sigma of the sharpest edges, pixels: lines of a period of 10 are lost


@dataclass(frozen=True)
class Cause:
    """What was measured, and what to do about it."""

    words: str
    remedy: str


def refusal(
    grey: Float32[ndarray, "h w"], found: DetectedGrid | None, detector: GridDetector, pattern: GridPattern
) -> DecodingError:
    """The error for a capture in which too few crossings have a place in the pattern."""
    if float(np.ptp(grey)) < _BLANK:
        return DecodingError(
            "is blank: all pixels have nearly the same brightness",
            "the projector was off, or the exposure far too short or too long",
            "look at the image, and capture it again with the pattern visible",
        )
    nodes, known = (found.nodes, found.known) if found is not None else (0, 0)
    causes = _causes(grey, found, detector, pattern)
    problem = (
        f"shows no grid of lines ({nodes} crossings were found, {LEAST_NODES} are needed)"
        if nodes < LEAST_NODES
        else f"shows {nodes} crossings of lines, but only {known} of them fit the pattern"
    )
    return DecodingError(
        problem,
        "; ".join(cause.words for cause in causes),
        "; ".join(dict.fromkeys(cause.remedy for cause in causes)),
    )


def _causes(
    grey: Float32[ndarray, "h w"], found: DetectedGrid | None, detector: GridDetector, pattern: GridPattern
) -> list[Cause]:
    """Every cause that a measurement shows; if there is none, that the pattern was looked for and is not there."""
    exposure = measure_exposure(grey)
    saturated = exposure.saturated > _MOST_SATURATED
    causes = [_saturation(exposure)] if saturated else _weakness(exposure)
    if found is not None:
        causes += _misfit(found, detector)
    if not (saturated and found is not None and shows_grid(found.graph)):  # saturated lines are wide, not blurred
        causes += _blur(grey, found, pattern)
    return causes or [_not_there(found)]


def _saturation(exposure: Exposure) -> Cause:
    share = f"{100 * exposure.saturated:.0f} %"
    return Cause(f"it is saturated: {share} of the pixels have the highest value", "capture again with less exposure")


def _weakness(exposure: Exposure) -> list[Cause]:
    if exposure.contrast >= _LEAST_CONTRAST * exposure.noise:
        return []
    facts = f"details of {255 * exposure.contrast:.1f} grey levels in noise of {255 * exposure.noise:.1f}"
    words = f"it is too dark: {facts}" if exposure.bright < _DARK else f"the pattern is too weak: {facts}"
    return [Cause(words, "capture again with more light of the projector, or a longer exposure")]


def _misfit(found: DetectedGrid, detector: GridDetector) -> list[Cause]:
    """A grid that was read, and is not that of the pattern as it is."""
    if detector.assign(mirrored(found.graph)).known.sum() >= LEAST_NODES:
        words = "the image is mirrored: its mirror image fits the pattern"
        return [Cause(words, "turn mirroring off in the camera or the projector")]
    if shows_readable_symbols(found.graph):
        words = "it shows another pattern: the symbols of its grid can be read, and fit this pattern nowhere"
        return [Cause(words, "give the pattern.json of the pattern that was projected")]
    return []


def _blur(grey: Float32[ndarray, "h w"], found: DetectedGrid | None, pattern: GridPattern) -> list[Cause]:
    """Of the lines if there is a grid, of the sharpest edges if there is none."""
    remedy = "capture again in focus and with nothing moving"
    if found is None or not shows_grid(found.graph):
        width = edge_width(grey)
        facts = f"its sharpest edges have a sigma of {width:.1f} pixels"
        return [Cause(f"it is blurred: {facts}", remedy)] if width > _WIDEST_EDGE else []
    blur = line_blur(found.rectified, found.maps, clear_places(found.maps), pattern)
    facts = f"the lines have a sigma of {blur:.2f} periods" if blur is not None else ""
    return [Cause(f"it is blurred: {facts}", remedy)] if blur is not None and blur > _MOST_BLUR else []


def _not_there(found: DetectedGrid | None) -> Cause:
    remedy = "point the camera at what the projector lights, with the pattern brighter than other light and a period "
    remedy += "at least 8 pixels wide"
    if found is None or found.nodes < LEAST_NODES:
        return Cause(
            "the pattern is out of view: the image is neither dark, saturated nor blurred, and no part of it shows a "
            "grid",
            remedy,
        )
    return Cause(
        "not known: the image is neither dark, saturated, blurred nor mirrored, and its symbols cannot be read; the "
        "crossings may belong to a texture",
        remedy,
    )
