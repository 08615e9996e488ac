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
_MOST_BLUR = 0.18  # sigma, periods: a line is a fifth of a period wide


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
    causes = _of_exposure(measure_exposure(grey))
    if found is not None and detector.assign(mirrored(found.graph)).known.sum() >= LEAST_NODES:
        causes.append(
            Cause("the image is mirrored: its mirror image fits the pattern", "turn mirroring off in the camera")
        )
    elif found is not None and shows_readable_symbols(found.graph):
        causes.append(
            Cause(
                "it shows another pattern: the symbols of its grid can be read, and fit this pattern nowhere",
                "give the pattern.json of the pattern that was projected",
            )
        )
    causes += _of_sharpness(grey, found, pattern)
    if causes:
        return causes
    if found is None or found.nodes < LEAST_NODES:
        return [
            Cause(
                "the pattern is out of view: the image is neither dark, saturated nor blurred, and no part of it shows "
                "a grid",
                "point the camera at what the projector lights, with a period at least 8 pixels wide",
            )
        ]
    return [
        Cause(
            "not known; the image is neither mirrored, dark, saturated nor blurred, and no readable grid of another "
            "pattern is in it: its crossings may belong to a texture",
            "capture again with the pattern brighter than other light, and a period at least 8 pixels wide",
        )
    ]


def _of_exposure(exposure: Exposure) -> list[Cause]:
    causes = []
    if exposure.saturated > _MOST_SATURATED:
        share = f"{100 * exposure.saturated:.0f} %"
        causes.append(
            Cause(f"it is saturated: {share} of the pixels have the highest value", "capture again with less exposure")
        )
    if exposure.contrast < _LEAST_CONTRAST * exposure.noise:
        facts = f"details of {255 * exposure.contrast:.1f} grey levels in noise of {255 * exposure.noise:.1f}"
        words = f"it is too dark: {facts}" if exposure.bright < _DARK else f"the pattern is too weak: {facts}"
        causes.append(Cause(words, "capture again with more light of the projector, or a longer exposure"))
    return causes


def _of_sharpness(grey: Float32[ndarray, "h w"], found: DetectedGrid | None, pattern: GridPattern) -> list[Cause]:
    if found is None:
        return []
    remedy, period = "capture again in focus and with nothing moving", found.appearance.period
    width = edge_width(grey)
    if width > _MOST_BLUR * period:
        return [Cause(f"it is blurred: its sharpest edges have a sigma of {width:.1f} pixels", remedy)]
    if not shows_grid(found.graph):
        return []
    blur = line_blur(found.rectified, found.maps, clear_places(found.maps), pattern)
    if blur is None or blur < _MOST_BLUR:
        return []
    return [Cause(f"it is blurred: the lines have a sigma of {blur:.2f} periods", remedy)]
