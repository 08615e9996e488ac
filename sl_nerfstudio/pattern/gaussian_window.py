"""Means in Gaussian windows of any width."""

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

_FINEST = 3  # squares per standard deviation: what is averaged over wide windows need not be known more finely


def gaussian_window(values: Float32[ndarray, "h w *k"], sigma: float) -> Float32[ndarray, "h w *k"]:
    """Means about each pixel in a Gaussian window of `sigma` pixels, with zeros outside the image; up to four channels.

    Quotients of two such means are means over the image, or a part of it, alone. Wide windows are applied to means over
    squares of pixels and interpolated in between, with the variance of both taken off the window's: this takes the same
    time for each pixel however wide the window is.
    """
    step = max(1, int(sigma / _FINEST))
    if step == 1:
        return cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    h, w = values.shape[:2]
    rows, columns = -(-h // step) + 2, -(-w // step) + 2  # with one square more on each side, to interpolate towards
    borders = step, (rows - 1) * step - h, step, (columns - 1) * step - w
    whole = cv2.copyMakeBorder(values, *borders, cv2.BORDER_CONSTANT)
    coarse = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    narrower = float(np.sqrt((sigma / step) ** 2 - 1 / 12 - 1 / 6))  # less what the squares and the interpolation add
    coarse = cv2.GaussianBlur(coarse, (0, 0), narrower, borderType=cv2.BORDER_CONSTANT)
    fine = cv2.resize(coarse, (columns * step, rows * step), interpolation=cv2.INTER_LINEAR)
    return fine[step : step + h, step : step + w]
