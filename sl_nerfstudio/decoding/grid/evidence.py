"""Coordinates held against the symbols that were read: do the codes around a pixel belong to the place it is given?

A field of phases may run on smoothly from one surface to another that only happens to continue its lines. Symbols tell.
"""

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int8
from numpy import ndarray
from scipy.special import log_softmax

_WINDOW = 0.7  # periods over which evidence is gathered
_NEAR = 0.3  # periods from a node at which a symbol can be read
_MISREAD = 0.15  # share of the symbols that may be wrong however sure the network is


def symbol_evidence(
    coords: Float32[ndarray, "h w 2"],
    codes: Int8[ndarray, "rows columns"],
    symbol: Float32[ndarray, "5 a b"],
    to_map: Float64[ndarray, "2 3"],
    pixels_a_period: float,
) -> Float32[ndarray, "h w"]:
    """Mean log-likelihood ratio, around each pixel, of its coordinates against symbols at random; 0 where none are.

    `coords` are periods in the array `codes`, `symbol` the logits that the network gave, `to_map` leads from pixels
    (x, y, first centre 0) to them.
    """
    row, column = np.nonzero(np.isfinite(coords[..., 0]))
    place = coords[row, column]
    cell = np.rint(place).astype(int)
    j, i = np.clip(cell[:, 0], 0, codes.shape[1] - 1), np.clip(cell[:, 1], 0, codes.shape[0] - 1)
    at = np.rint(np.stack([column, row], -1) @ to_map[:, :2].T + to_map[:, 2]).astype(int)
    x, y = np.clip(at[:, 0], 0, symbol.shape[2] - 1), np.clip(at[:, 1], 0, symbol.shape[1] - 1)
    probability = np.exp(log_softmax(symbol, axis=0))[codes[i, j], y, x]
    ratio = np.log((1 - _MISREAD) * symbol.shape[0] * probability + _MISREAD)
    weight = np.exp(-(((place - cell) / _NEAR) ** 2).sum(-1))
    sums = np.zeros((*coords.shape[:2], 2), dtype=np.float32)
    sums[row, column] = np.stack([weight, weight * ratio], -1)
    sums = cv2.GaussianBlur(sums, (0, 0), _WINDOW * pixels_a_period, borderType=cv2.BORDER_CONSTANT)
    return (sums[..., 1] / np.maximum(sums[..., 0], 1e-6)).astype(np.float32)
