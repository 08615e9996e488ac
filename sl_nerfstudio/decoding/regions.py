"""Connected regions of a coordinate image: small ones are decoding errors."""

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.geometry.connectivity import component_labels


def drop_small_regions(
    coords: Float32[ndarray, "h w 2"], largest_step: float, least_pixels: int
) -> Float32[ndarray, "h w 2"]:
    """Set connected regions of fewer than `least_pixels` pixels to NaN.

    Neighbouring pixels (4 directions) are connected if both are decoded and neither coordinate differs by more than
    `largest_step` projector pixels.
    """
    h, w = coords.shape[:2]
    known = np.isfinite(coords).all(-1)
    index = np.full((h, w), -1, dtype=np.int32)
    index[known] = np.arange(known.sum(), dtype=np.int32)
    pairs = []
    for here, there in (((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
                        ((slice(None, -1), slice(None)), (slice(1, None), slice(None)))):  # fmt: skip
        near = np.abs(coords[here] - coords[there]).max(-1) <= largest_step  # False for NaN
        pairs.append(np.stack([index[here][near], index[there][near]]))
    a, b = np.concatenate(pairs, 1)
    n = int(known.sum())
    label = component_labels(a, b, n)
    small = np.bincount(label, minlength=1)[label] < least_pixels
    out = coords.copy()
    out[known] = np.where(small[:, None], np.float32(np.nan), coords[known])
    return out
