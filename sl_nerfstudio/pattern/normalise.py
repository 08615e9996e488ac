"""Local intensity normalisation: makes a captured image look like the pattern that was projected on the object."""

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from scipy.ndimage import gaussian_filter


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
    known = np.maximum(gaussian_filter(weight, sigma, truncate=3.0), 1e-6)
    local_mean = gaussian_filter(values, sigma, truncate=3.0) / known
    spread = np.where(mask, values - local_mean, 0)
    local_std = np.sqrt(gaussian_filter(spread * spread, sigma, truncate=3.0) / known)
    floor = 1e-3 * max(float(values.max(initial=0)), 1e-12)  # flat regions stay flat
    normalised = mean + contrast * (values - local_mean) / np.maximum(local_std, floor)
    return np.where(mask, np.clip(normalised, 0, 1), 0).astype(np.float32)
