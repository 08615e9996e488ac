"""The resolution of a projector of which only the captured Gray code is known."""

import numpy as np

from sl_nerfstudio.decoding.decoded import DecodingError
from sl_nerfstudio.decoding.graycode.decoder import GrayCodeDecoder
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.sequence import SequenceName
from sl_nerfstudio.processing.captures import Captures
from sl_nerfstudio.scan.file_error import FileError

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
    fitting = [layout for w, h in STANDARD if (layout := GrayCode.in_order(name, w, h)).images == count]
    if not fitting:
        raise FileError(
            whole[0].images[0].parent,
            f"holds {count} images, which the sequence {name} of no usual projector has, with cells of one pixel",
            "images are missing or too many, cells are larger, or the order is another",
            "give the projector's resolution, as --pattern 1024x768, or the pattern.json of what was projected",
        )
    reached = np.zeros(2)
    largest = GrayCode.in_order(name, *(2**bits for bits in fitting[-1].bits))
    for frame in whole[:_LOOKED_AT]:
        try:
            decoded = GrayCodeDecoder(largest).decode(frame.images)
        except (DecodingError, FileError):
            continue  # said when this frame is read
        codes = decoded.coords[decoded.decoded]
        reached = np.maximum(reached, np.quantile(codes, 1 - _BEYOND, axis=0)) if len(codes) else reached
    return next((layout for layout in fitting if layout.w >= reached[0] and layout.h >= reached[1]), fitting[-1])
