"""The two input channels of the U-Net: local contrast and brightness of an image."""

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

RECTIFIED_PERIOD = 14.0
"""Median period of the grid, in pixels, in the images that the network is given."""
CHANNELS = 2
_WINDOW = 0.8  # of the local statistics, in periods
_FLOOR = 0.015  # of the full brightness: weaker contrast is treated as none


def network_channels(image: Float32[ndarray, "h w"], full: float | None = None) -> Float32[ndarray, "2 h w"]:
    """Local contrast and brightness of a rectified image whose intensities are at least 0.

    `full` is the intensity of brightly lit lines, by default the 99.5 % quantile of the image.
    """
    bright = max(float(np.quantile(image, 0.995)) if full is None else full, 1e-4)
    sigma = _WINDOW * RECTIFIED_PERIOD
    mean = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
    spread = image - mean
    variance = cv2.GaussianBlur(spread * spread, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
    contrast = np.clip(spread / (2 * (np.sqrt(np.maximum(variance, 0)) + _FLOOR * bright)), -2, 2)
    return np.stack([contrast, np.sqrt(np.clip(image / bright, 0, 2))]).astype(np.float32)
