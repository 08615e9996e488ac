"""Holes of a mesh: places that a frame decoded and whose rays meet no surface there."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from numpy import ndarray
from scipy.ndimage import binary_opening, label

from sl_nerfstudio.evaluation.frame_pixels import FramePixels

_SIGMAS = 4.0  # pixels farther from their epipolar curve are wrong decodings and show nothing
_LEAST_DEPTH = (
    0.01  # of the mesh's size, by which a ray must pass the measured point for the surface to be missing there
)
_LEAST_WIDTH = 0.02  # of the side of a square as large as the decoded area: narrower gaps are rims of the surface


@dataclass(frozen=True)
class Holes:
    """Missing surface in one frame, as shares of its decoded pixels."""

    missing: float  # all of it
    largest: float  # the largest connected area; gaps along rims do not count


def find_holes(pixels: FramePixels, mesh_size: float) -> Holes:
    """Decoded pixels whose ray misses the mesh, or passes far behind the triangulated point before it hits.

    `mesh_size` is the diagonal of the mesh's box, in its unit.
    """
    trusted = pixels.decoded & (np.abs(pixels.epipolar) < _SIGMAS * pixels.noise_px)
    count = int(trusted.sum())
    if count == 0:
        return Holes(0.0, 0.0)
    through = (pixels.behind > _LEAST_DEPTH * mesh_size) & (pixels.coordinate > pixels.tolerance_px)
    missing = trusted & (~pixels.hit | through)
    return Holes(float(missing.sum() / count), _largest_area(_as_image(pixels, missing), count) / count)


def _as_image(pixels: FramePixels, flags: Bool[ndarray, "n"]) -> Bool[ndarray, "h w"]:
    row, column = pixels.row // pixels.stride, pixels.column // pixels.stride
    image = np.zeros((row.max() + 1, column.max() + 1), bool)
    image[row[flags], column[flags]] = True
    return image


def _largest_area(missing: Bool[ndarray, "h w"], count: int) -> int:
    """Pixels of the largest connected area that is wide enough; `count` pixels were decoded."""
    width = 1 + 2 * max(1, round(_LEAST_WIDTH * np.sqrt(count) / 2))
    wide = binary_opening(missing, np.ones((width, width), bool))
    areas = np.bincount(label(wide)[0].ravel())[1:]  # type: ignore[index]
    return int(areas.max()) if len(areas) else 0
