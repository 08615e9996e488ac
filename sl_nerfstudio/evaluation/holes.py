"""Holes of a mesh: places that a frame decoded and whose rays meet no surface there."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray
from scipy.ndimage import binary_opening, label

from sl_nerfstudio.evaluation.frame_pixels import FramePixels

_SIGMAS = 4.0  # pixels farther from their epipolar curve are wrong decodings and show nothing
_LEAST_DEPTH = (
    0.01  # of the mesh's size, by which a ray must pass the measured point for the surface to be missing there
)
_LEAST_WIDTH = 0.02  # of the side of a square as large as the decoded area: narrower gaps are rims of the surface

_JUMP = 2.5  # usual steps between neighbouring pixels, beyond which coordinates jump
_LARGE_PATCH = 0.03  # of the decoded pixels: larger patches are no wrong decodings but surface that is missing


@dataclass(frozen=True)
class Holes:
    """Missing surface in one frame, as shares of its decoded pixels."""

    missing: float  # all of it
    largest: float  # the largest connected area; gaps along rims do not count


def find_holes(pixels: FramePixels, mesh_size: float) -> Holes:
    """Decoded pixels whose ray misses the mesh, or passes far behind the triangulated point before it hits.

    `mesh_size` is the diagonal of the mesh's box, in its unit. Patches of coordinates that are not continuous with what
    surrounds them are wrong decodings, unless they are large.
    """
    trusted = pixels.decoded & (np.abs(pixels.epipolar) < _SIGMAS * pixels.noise_px)
    count = int(trusted.sum())
    if count == 0:
        return Holes(0.0, 0.0)
    through = (pixels.behind > _LEAST_DEPTH * mesh_size) & (pixels.coordinate > pixels.tolerance_px)
    missing = _as_image(pixels, trusted & (~pixels.hit | through), False)
    missing &= ~_wrong_patches(pixels, missing, count)
    return Holes(float(missing.sum() / count), _largest_area(missing, count) / count)


def _as_image(pixels: FramePixels, values: ndarray, nothing: float | bool) -> ndarray:
    """Values on the grid of evaluated pixels."""
    row, column = pixels.row // pixels.stride, pixels.column // pixels.stride
    image = np.full((row.max() + 1, column.max() + 1, *values.shape[1:]), nothing, values.dtype)
    image[row, column] = values
    return image


def _wrong_patches(pixels: FramePixels, missing: Bool[ndarray, "h w"], count: int) -> Bool[ndarray, "h w"]:
    """Small patches, bounded by jumps of the coordinates, that are missing for the most part."""
    coords = _as_image(pixels, pixels.coords, np.nan)
    limit = _JUMP * pixels.footprint_px * pixels.stride + _SIGMAS * np.sqrt(2) * pixels.noise_px
    inside = np.isfinite(coords).all(-1)
    for axis in (0, 1):
        jump = np.linalg.norm(np.diff(coords, axis=axis), axis=-1) > limit
        inside &= ~np.insert(jump, jump.shape[axis], False, axis) & ~np.insert(jump, 0, False, axis)
    patch = _numbered(inside)
    size = np.bincount(patch.ravel())
    lost = np.bincount(patch[missing], minlength=len(size))
    wrong = (2 * lost > size) & (size < _LARGE_PATCH * count)
    wrong[0] = True  # at the jumps themselves
    return wrong[patch]


def _largest_area(missing: Bool[ndarray, "h w"], count: int) -> int:
    """Pixels of the largest connected area that is wide enough; `count` pixels were decoded."""
    width = 1 + 2 * max(1, round(_LEAST_WIDTH * np.sqrt(count) / 2))
    wide = binary_opening(missing, np.ones((width, width), bool))
    areas = np.bincount(_numbered(wide).ravel())[1:]
    return int(areas.max()) if len(areas) else 0


def _numbered(flags: Bool[ndarray, "h w"]) -> Int[ndarray, "h w"]:
    """The number of the connected area of each pixel, from 1; 0 elsewhere."""
    out = np.zeros(flags.shape, dtype=np.int32)
    label(flags, output=out)
    return out
