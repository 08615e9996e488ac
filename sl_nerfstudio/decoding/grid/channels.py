"""What the U-Net is shown of an image: local contrast, and brightness."""

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

VIEW_PERIOD = 14.0
"""Pixels that a period of the grid measures, in the median, in the image that the network is given."""
CHANNELS = 2
_WINDOW = 0.8  # of the local statistics, in periods
_FLOOR = 0.015  # of the full brightness: weaker contrast counts as none


def network_channels(view: Float32[ndarray, "h w"], full: float | None = None) -> Float32[ndarray, "2 h w"]:
    """Local contrast and brightness of a view of intensities from 0 up.

    `full` is the intensity of brightly lit lines, by default the 99.5 % quantile of the view.
    """
    bright = max(float(np.quantile(view, 0.995)) if full is None else full, 1e-4)
    sigma = _WINDOW * VIEW_PERIOD
    mean = cv2.GaussianBlur(view, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
    spread = view - mean
    variance = cv2.GaussianBlur(spread * spread, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
    contrast = np.clip(spread / (2 * (np.sqrt(np.maximum(variance, 0)) + _FLOOR * bright)), -2, 2)
    return np.stack([contrast, np.sqrt(np.clip(view / bright, 0, 2))]).astype(np.float32)
