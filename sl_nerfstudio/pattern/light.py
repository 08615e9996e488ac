"""How strongly a surface returns the projector's light: what remains of an image without the pattern and the room."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from sl_nerfstudio.pattern.gaussian_window import gaussian_window

_LEAST_KNOWN = 0.3  # of a window: fewer decoded pixels say too little
_LEAST_VARIANCE = 1e-4  # of the pattern in a window


class _Fit(NamedTuple):
    slope: Float32[ndarray, "h w"]
    explained: float  # share of the image's variance in the windows, median


def projected_light(
    image: Float[ndarray, "h w"],
    coords: Float32[ndarray, "h w 2"],
    pictures: Sequence[Float32[ndarray, "ph pw"]],
    sigma: float,
) -> Float32[ndarray, "h w"]:
    """Light that a pattern value of one adds at each decoded pixel, in the image's unit; NaN where that is unknown.

    The slope of the image over the pattern by least squares, in a Gaussian window of `sigma` pixels. Light that does
    not come from the pattern (the room, other surfaces) falls out. `coords` are pattern pixels, NaN where not decoded;
    `pictures` the pattern at several degrees of sharpness, of which the one counts that explains most: with another,
    fine parts of the pattern would seem darker than coarse ones.
    """
    known = np.isfinite(coords).all(-1)
    weight = known.astype(np.float32)
    grey = image.astype(np.float32) * weight
    image_means = gaussian_window(np.dstack([weight, grey, grey * grey]), sigma)
    place = np.nan_to_num(coords) - np.float32(0.5)
    fits = (_fit(grey, weight, image_means, place, picture, sigma) for picture in pictures)
    return max(fits, key=lambda fit: fit.explained).slope


def _fit(
    grey: Float32[ndarray, "h w"],
    weight: Float32[ndarray, "h w"],
    image_means: Float32[ndarray, "h w 3"],
    place: Float32[ndarray, "h w 2"],
    picture: Float32[ndarray, "ph pw"],
    sigma: float,
) -> _Fit:
    """With one picture; `image_means` are those of the weight, of the grey and of its square."""
    drawn = cv2.remap(picture, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    drawn = drawn * weight
    p, pp, ip = cv2.split(gaussian_window(np.dstack([drawn, drawn * drawn, grey * drawn]), sigma))
    n, i, ii = cv2.split(image_means)
    some = (weight > 0) & (n > _LEAST_KNOWN)
    n = np.maximum(n, np.float32(1e-6))
    p, i = p / n, i / n
    variance, common, contrast = pp / n - p * p, ip / n - i * p, ii / n - i * i
    some &= variance > _LEAST_VARIANCE
    slope = np.where(some, common / np.maximum(variance, np.float32(1e-9)), np.float32(np.nan)).astype(np.float32)
    explained = common[some] ** 2 / np.maximum(variance[some] * contrast[some], np.float32(1e-12))
    return _Fit(slope, float(np.median(explained)) if len(explained) else 0.0)
