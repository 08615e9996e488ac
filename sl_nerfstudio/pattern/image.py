"""Any image as a pattern: bilinear interpolation."""

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray


def sample_bilinear(image: Float32[ndarray, "h w"], uv: Float[ndarray, "*n 2"]) -> Float32[ndarray, "*n"]:
    """Value at pixel coordinates (x, y) whose first pixel centre is (0.5, 0.5).

    Beyond the outermost pixel centres the value at the border continues; NaN coordinates give NaN.
    """
    h, w = image.shape
    place = uv.astype(np.float32) - np.float32(0.5)
    x, y = np.clip(place[..., 0], 0, w - 1), np.clip(place[..., 1], 0, h - 1)
    unknown = np.isnan(place).any(-1)
    if unknown.any():
        x, y = np.where(unknown, 0, x), np.where(unknown, 0, y)
    left = np.minimum(x.astype(np.int32), max(w - 2, 0))
    top = np.minimum(y.astype(np.int32), max(h - 2, 0))
    fx, fy = x - left, y - top
    right, bottom = np.minimum(left + 1, w - 1), np.minimum(top + 1, h - 1)
    flat = image.reshape(-1)
    upper = flat[top * w + left] * (1 - fx) + flat[top * w + right] * fx
    lower = flat[bottom * w + left] * (1 - fx) + flat[bottom * w + right] * fx
    value = upper * (1 - fy) + lower * fy
    return np.where(unknown, np.float32(np.nan), value).astype(np.float32)
