"""Squares of the pattern: decoding errors of neighbouring pixels depend on each other, those of two squares do not."""

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.settings import PatternBlocks


def blocks_of(uv_projector: Float[ndarray, "n 2"], projector: Device, settings: PatternBlocks) -> Int64[ndarray, "n"]:
    """Number of the square in which each coordinate lies; the same number, the same square."""
    n = settings.along_longer_side
    side_px = max(projector.w, projector.h) / n
    # Coordinates outside the pattern have squares too, out to four times its longer side.
    column, row = np.floor(uv_projector / side_px).astype(np.int64).clip(-1, 4 * n).T
    return (row + 1) * (5 * n) + column + 1


def block_numbers(settings: PatternBlocks) -> int:
    """All numbers that `blocks_of` gives are below this."""
    return (5 * settings.along_longer_side) ** 2


def block_count(projector: Device, settings: PatternBlocks) -> int:
    """Number of squares of the whole pattern, with those that its border cuts."""
    n, (shorter, longer) = settings.along_longer_side, sorted((projector.w, projector.h))
    return n * -(-n * shorter // longer)
