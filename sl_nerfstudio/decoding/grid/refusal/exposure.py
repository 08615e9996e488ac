"""Measurements of exposure: saturation, and how far details stand out from the noise."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

_SATURATED = 0.995  # of the full scale
_ROUNDING = 1 / 255 / np.sqrt(12)  # standard deviation of rounding to 8 bits
_DETAIL = 1.0  # sigma of the smoothing before contrast is measured, pixels
_WINDOW = 10.0  # sigma of the window in which it is measured, pixels
_BEST = 0.98  # quantile of the local contrast: where the capture is best
_BRIGHT = 0.995  # quantile of the brightness
_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
_NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal variable


@dataclass(frozen=True)
class Exposure:
    """Brightness, contrast and noise of an image, each as a share of the full scale."""

    saturated: float  # share of the pixels at full scale
    bright: float  # brightness of its brightest parts
    contrast: float  # standard deviation of its details where they are strongest, without the noise
    noise: float  # standard deviation of its noise


def measure_exposure(grey: Float32[ndarray, "h w"]) -> Exposure:
    """Exposure of an image in [0, 1].

    The noise is measured with a mask that is blind to planes and edges (Immerkaer, 1996), by the median.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), _DETAIL)
    mean = cv2.GaussianBlur(smooth, (0, 0), _WINDOW)
    variance = cv2.GaussianBlur((smooth - mean) ** 2, (0, 0), _WINDOW)
    noise = measure_noise(grey)
    left = noise**2 / (4 * np.pi * _DETAIL**2)  # what the smoothing leaves of the variance of white noise
    contrast = np.sqrt(max(float(np.quantile(variance, _BEST)) - left, 0.0))
    return Exposure(
        float((grey >= _SATURATED).mean()), float(np.quantile(grey, _BRIGHT)), float(contrast), float(noise)
    )


def measure_noise(grey: Float32[ndarray, "h w"]) -> float:
    """Standard deviation of the noise of an image in [0, 1]; at least that of rounding to 8 bits."""
    residual = np.abs(cv2.filter2D(grey, -1, _LAPLACIAN)) / 6
    return max(float(np.median(residual)) / _NORMAL_MEDIAN, float(_ROUNDING))
