"""Which pixels are never used for training: small blocks, chosen by a hash of frame and block."""

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt64
from numpy import ndarray

BLOCK = 8  # pixels; larger than the neighbourhood that bilinear look-up or interpolated coordinates share
FRACTION = 0.02
_SEED = 0x5EED


def block_hash(frame: int, height: int, width: int) -> Float[ndarray, "rows columns"]:
    """A number in [0, 1) for every block of one frame, the same on every machine and in every run."""
    rows = np.arange(-(-height // BLOCK), dtype=np.uint64)[:, None]
    columns = np.arange(-(-width // BLOCK), dtype=np.uint64)[None, :]
    key = np.uint64(_SEED) + (np.uint64(frame) << np.uint64(40)) + (rows << np.uint64(20)) + columns
    return (_mix(key) >> np.uint64(11)).astype(np.float64) / 2.0**53


def held_out_pixels(frame: int, height: int, width: int) -> Bool[ndarray, "height width"]:
    """True where a pixel of frame number `frame` is excluded from training; about FRACTION of all."""
    return spread(block_hash(frame, height, width) < FRACTION, height, width)


def spread(blocks: Shaped[ndarray, "rows columns"], height: int, width: int) -> Shaped[ndarray, "height width"]:
    """Values of blocks at their pixels."""
    return blocks.repeat(BLOCK, 0)[:height].repeat(BLOCK, 1)[:, :width]


def _mix(key: UInt64[ndarray, "..."]) -> UInt64[ndarray, "..."]:
    """SplitMix64's finaliser (Steele et al., OOPSLA 2014): every bit of the key affects every bit of the result."""
    with np.errstate(over="ignore"):
        key = key * np.uint64(0x9E3779B97F4A7C15)
        key = (key ^ (key >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        key = (key ^ (key >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return key ^ (key >> np.uint64(31))
