"""Small residual maps of every frame, made while the frames are evaluated one by one."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.evaluation.capture_agreement import FrameAgreement
from sl_nerfstudio.evaluation.frame_pixels import FramePixels
from sl_nerfstudio.evaluation.report.pictures import ColourScale, data_uri, pixel_map, residual_colours, shrink
from sl_nerfstudio.scan import Frame

COORDINATE = ColourScale("YlOrRd", 0.0, 2.0)  # pattern pixels
EPIPOLAR = ColourScale("RdBu_r", -1.5, 1.5)
PATTERN = ColourScale("YlOrRd", 0.0, 0.5)  # of full brightness
_SIDE = 150


@dataclass(frozen=True)
class FrameThumbnails:
    """One frame's maps as data addresses."""

    name: str
    figures: FrameAgreement
    coordinate: str
    epipolar: str
    pattern: str


class ResidualThumbnails:
    """Makes the small maps of each frame it gets; meant as the `on_frame` of `evaluate`."""

    def __init__(self) -> None:
        self.frames: list[FrameThumbnails] = []

    def __call__(self, frame: Frame, figures: FrameAgreement, pixels: FramePixels) -> None:
        """Add one frame."""
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
    """Least-squares factor from the brightness of the rendered to that of the captured pattern."""
    known = pixels.lit & np.isfinite(pixels.rendered)
    a, b = pixels.captured[known], pixels.rendered[known]
    return float(a @ b / (b @ b)) if (b @ b) > 0 else 1.0


def _map(pixels: FramePixels, rgb: Float[ndarray, "n 3"]) -> str:
    return data_uri(shrink(pixel_map(pixels.row, pixels.column, pixels.stride, rgb), _SIDE))
