"""Residual maps of every frame, small, collected while the frames stream past."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.evaluation.capture_fit import FrameFit, FramePixels
from sl_nerfstudio.evaluation.report.pictures import ColourScale, data_uri, pixel_map, residual_colours, shrink
from sl_nerfstudio.scan import Frame

COORDINATE = ColourScale("YlOrRd", 0.0, 2.0)  # pattern pixels
EPIPOLAR = ColourScale("RdBu_r", -1.5, 1.5)
PATTERN = ColourScale("YlOrRd", 0.0, 0.5)  # of full brightness
_SIDE = 150


@dataclass(frozen=True)
class FrameThumbnails:
    """Data addresses of one frame's maps."""

    name: str
    figures: FrameFit
    coordinate: str
    epipolar: str
    pattern: str


class ThumbnailCollector:
    """Makes the small maps of each frame it is shown; usable as `evaluate`'s `on_frame`."""

    def __init__(self) -> None:
        self.frames: list[FrameThumbnails] = []

    def __call__(self, frame: Frame, figures: FrameFit, pixels: FramePixels) -> None:
        """Take one frame in."""
        missed = ~pixels.hit
        difference = np.abs(pixels.captured - pixels.rendered * brightness_ratio(pixels))
        self.frames.append(
            FrameThumbnails(
                frame.name,
                figures,
                coordinate=_map(pixels, residual_colours(pixels.coordinate, COORDINATE, missed & pixels.decoded)),
                epipolar=_map(pixels, residual_colours(pixels.epipolar, EPIPOLAR, np.zeros_like(missed))),
                pattern=_map(pixels, residual_colours(difference, PATTERN, missed)),
            )
        )


def brightness_ratio(pixels: FramePixels) -> float:
    """Factor that brings the rendered pattern to the captured one's brightness, in least squares."""
    known = pixels.lit & np.isfinite(pixels.rendered)
    a, b = pixels.captured[known], pixels.rendered[known]
    return float(a @ b / (b @ b)) if (b @ b) > 0 else 1.0


def _map(pixels: FramePixels, rgb: Float[ndarray, "n 3"]) -> str:
    return data_uri(shrink(pixel_map(pixels.row, pixels.column, pixels.stride, rgb), _SIDE))
