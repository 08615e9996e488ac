"""Local intensity normalisation: makes a captured image look like the pattern that was projected on the object."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from sl_nerfstudio.pattern.gaussian_window import gaussian_window


def normalise_locally(
    image: Float[ndarray, "h w"],
    mask: Bool[ndarray, "h w"],
    sigma: float,
    mean: float = 0.5,
    contrast: float = 0.25,
) -> Float32[ndarray, "h w"]:
    """Remove albedo, shading and fall-off: the local mean and standard deviation become those of the pattern.

    Both are computed in a Gaussian window of `sigma` pixels (about the period of the pattern in the image), and only
    from pixels inside the mask. The result is clipped to [0, 1], and is 0 outside the mask.
    """
    weight = mask.astype(np.float32)
    values = np.where(mask, image, 0).astype(np.float32)
    known, mean_of_all = cv2.split(gaussian_window(np.dstack([weight, values]), sigma))
    known = np.maximum(known, np.float32(1e-6))
    local_mean = mean_of_all / known
    spread = np.where(mask, values - local_mean, np.float32(0))
    local_std = np.sqrt(gaussian_window(spread * spread, sigma) / known)
    floor = 1e-3 * max(float(values.max(initial=0)), 1e-12)  # flat regions stay flat
    normalised = mean + contrast * (values - local_mean) / np.maximum(local_std, floor)
    return np.where(mask, np.clip(normalised, 0, 1), 0).astype(np.float32)
