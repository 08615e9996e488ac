"""Smooth random fields on a square grid, from which surfaces and textures are made."""

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray


def smooth_field(rng: np.random.Generator, size: int, knots: int) -> Float32[ndarray, "n n"]:
    """Random values of unit variance at `knots` x `knots` places, smoothly interpolated to `size` x `size`."""
    coarse = rng.standard_normal((knots + 3, knots + 3)).astype(np.float32)
    step, start = knots / size, rng.uniform(0.5, 1.5, 2)
    place = np.array([[step, 0, start[0]], [0, step, start[1]]], dtype=np.float32)
    return cv2.warpAffine(coarse, place, (size, size), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A random number whose logarithm is uniform between those of `low` and `high`."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
