"""Small pictures of a frame for the report."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.object_separation.separate import Part
from sl_nerfstudio.scan.images import as_grey

_SIDE, _SMALLEST = 640, 200  # longest side of a picture, pixels
_PICTURES = 60  # of that size: about 3 MB in the report; those of more frames are smaller
_TINTS = {Part.PLANE: (0.85, 0.15, 0.1), Part.BEYOND: (0.95, 0.6, 0.0)}
_TINT = 0.6  # opacity


@dataclass(frozen=True)
class Preview:
    """A capture and its decoded coordinates, RGB in [0, 1]; None where there is nothing to show."""

    image: Float32[ndarray, "h w 3"] | None
    coords: Float32[ndarray, "h w 3"] | None
    left_out: Float32[ndarray, "h w 3"] | None = None  # the capture with surroundings in colour


def make_preview(
    image: UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"] | None,
    coords: Float32[ndarray, "_h _w 2"] | None,
    size: tuple[int, int],
    part: UInt8[ndarray, "_h _w"] | None = None,
    frames: int = 1,
) -> Preview:
    """Reduced pictures of one of `frames` frames.

    `part` is what each pixel shows (`Part`), if surroundings were looked for.
    `size` is the pattern's (w, h): x gives red, y gives blue; grey where nothing was decoded.
    """
    picture = colours = None
    side = max(_SMALLEST, round(_SIDE * min(1.0, _PICTURES / (2 * frames)) ** 0.5))
    if image is not None:
        step = _step(image.shape, side)
        grey = as_grey(image[::step, ::step])
        picture = np.repeat((grey / max(float(grey.max()), 1e-6))[..., None], 3, -1)
    if coords is not None:
        step = _step(coords.shape, side)
        thin = coords[::step, ::step]
        place = np.nan_to_num(thin) / np.array(size, dtype=np.float32)
        colours = np.stack([place[..., 0], np.full(thin.shape[:2], 0.35), place[..., 1]], -1).astype(np.float32)
        colours[np.isnan(thin).any(-1)] = 0.85
    if picture is None or part is None:
        return Preview(picture, colours)
    step = _step(part.shape, side)
    return Preview(picture, colours, _tinted(picture, part[::step, ::step]))


def _tinted(picture: Float32[ndarray, "h w 3"], part: UInt8[ndarray, "h w"]) -> Float32[ndarray, "h w 3"]:
    """The picture with what was left out in colour."""
    out = picture.copy()
    for kind, colour in _TINTS.items():
        out[part == kind] = (1 - _TINT) * out[part == kind] + _TINT * np.array(colour, dtype=np.float32)
    return out


def _step(shape: tuple[int, ...], side: int) -> int:
    return max(1, -(-max(shape[:2]) // side))
