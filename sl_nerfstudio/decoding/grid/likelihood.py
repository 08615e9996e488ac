"""How well coordinates agree with the symbols that the network read around them.

Phases can run on smoothly from one surface to another whose lines happen to continue those of the first; the symbols
show that the second one is elsewhere in the pattern. Even where the network is certain, it may have misread a symbol:
all likelihoods allow for that.
"""

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int8
from numpy import ndarray
from scipy.special import log_softmax

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
    row, column = np.nonzero(np.isfinite(coords[..., 0]))
    place = coords[row, column]
    cell = np.rint(place).astype(int)
    j, i = np.clip(cell[:, 0], 0, codes.shape[1] - 1), np.clip(cell[:, 1], 0, codes.shape[0] - 1)
    at = np.rint(np.stack([column, row], -1) @ to_map[:, :2].T + to_map[:, 2]).astype(int)
    x, y = np.clip(at[:, 0], 0, symbol.shape[2] - 1), np.clip(at[:, 1], 0, symbol.shape[1] - 1)
    probability = np.exp(log_softmax(symbol, axis=0))[codes[i, j], y, x]
    ratio = np.log((1 - _MISREAD) * symbol.shape[0] * probability + _MISREAD)
    weight = np.exp(-(((place - cell) / _READABLE) ** 2).sum(-1))
    sums = np.zeros((*coords.shape[:2], 2), dtype=np.float32)
    sums[row, column] = np.stack([weight, weight * ratio], -1)
    sums = cv2.GaussianBlur(sums, (0, 0), _WINDOW * pixels_a_period, borderType=cv2.BORDER_CONSTANT)
    return (sums[..., 1] / np.maximum(sums[..., 0], 1e-6)).astype(np.float32)
