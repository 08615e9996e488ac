"""How well coordinates agree with the symbols that the network read around them.

Phases can run on smoothly from one surface to another whose lines happen to continue those of the first; the symbols
show that the second one is elsewhere in the pattern. Even where the network is certain, it may have misread a symbol:
all likelihoods allow for that.
"""

import math

import numpy as np
from jaxtyping import Float32, Float64, Int8
from numpy import ndarray
from scipy.special import log_softmax

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.pattern.gaussian_window import gaussian_window

_MISREAD = 0.15  # share of the symbols that may be wrong, however certain the network is
_WINDOW = 0.7  # periods over which symbols are averaged
_READABLE = 0.3  # periods from a node within which its symbol can be read


def symbol_log_likelihood(score: Float32[ndarray, "n 5"]) -> Float32[ndarray, "n 5"]:
    """Log probability of each symbol at each node, from the network's probabilities."""
    return np.log((1 - _MISREAD) * score + _MISREAD / score.shape[1]).astype(np.float32)


def symbol_log_ratio(
    coords: Float32[ndarray, "h w 2"],
    codes: Int8[ndarray, "rows columns"],
    symbol: Float32[ndarray, "5 a b"],
    to_map: Float64[ndarray, "2 3"],
    pixels_a_period: float,
) -> Float32[ndarray, "h w"]:
    """Mean log-likelihood ratio, around each pixel, of its coordinates against random symbols; 0 where none was read.

    `coords` are in periods within the array `codes`, `symbol` are the network's logits, and `to_map` maps pixels
    (x, y, first centre 0) to their places.
    """
    probability = np.exp(log_softmax(symbol, axis=0))
    ratio = np.log((1 - _MISREAD) * symbol.shape[0] * probability + _MISREAD)
    sums = np.zeros((*coords.shape[:2], 2), dtype=np.float32)
    _weigh(coords, codes, ratio, to_map, sums)
    sums = gaussian_window(sums, _WINDOW * pixels_a_period)
    return (sums[..., 1] / np.maximum(sums[..., 0], 1e-6)).astype(np.float32)


@compiled
def _weigh(coords: ndarray, codes: ndarray, ratio: ndarray, to_map: ndarray, sums: ndarray) -> None:
    """Weight of each pixel with coordinates, and its share of the sum: the ratio of the nearest node's symbol there."""
    h, w = coords.shape[:2]
    for row in range(h):
        for column in range(w):
            x, y = coords[row, column, 0], coords[row, column, 1]
            if np.isnan(x):
                continue
            j, i = round(x), round(y)
            weight = math.exp(-((x - j) ** 2 + (y - i) ** 2) / _READABLE**2)
            j, i = min(max(j, 0), codes.shape[1] - 1), min(max(i, 0), codes.shape[0] - 1)
            mx = round(to_map[0, 0] * column + to_map[0, 1] * row + to_map[0, 2])
            my = round(to_map[1, 0] * column + to_map[1, 1] * row + to_map[1, 2])
            mx, my = min(max(mx, 0), ratio.shape[2] - 1), min(max(my, 0), ratio.shape[1] - 1)
            sums[row, column, 0], sums[row, column, 1] = weight, weight * ratio[codes[i, j], my, mx]
