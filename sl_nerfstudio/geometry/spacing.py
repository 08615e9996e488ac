"""Evenly spaced indices."""

import numpy as np
from jaxtyping import Int64
from numpy import ndarray


def evenly_spaced(length: int, count: int) -> Int64[ndarray, "count"]:
    """`count` indices from 0 to `length` - 1, both included, evenly spaced; some twice if `count` exceeds `length`.

    Exact for any length: the arithmetic is in whole numbers.
    """
    steps = max(count - 1, 1)
    return (2 * np.arange(count, dtype=np.int64) * (length - 1) + steps) // (2 * steps)
