"""How probable it is that a decoded pixel is wrong, by what can be measured around it.

A logistic model of a few features, trained on random captures (`python -m training.reliability`). Wrong is what is off
by more than a tenth of a period, and what lies where the pattern is not.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

_MOVE_WINDOW = 0.15  # sigma, periods
_BEND_WINDOW = 0.2  # sigma, periods
_LARGEST_RATIO = 1.6  # of the symbols' log-likelihoods
_LEAST_MOVE, _LEAST_BEND = 0.01, 0.002  # periods: less is as good


@dataclass(frozen=True)
class Evidence:
    """What is known about the pixels of a capture; NaN or anything where not decoded."""

    read: Float32[ndarray, "h w 2"]  # coordinates that the network read, pattern pixels
    fitted: Float32[ndarray, "h w 2"]  # the same, fitted to the image
    agreement: Float32[ndarray, "h w"]  # correlation of image and drawn pattern
    log_ratio: Float32[ndarray, "h w"]  # mean log-likelihood ratio of the symbols
    probability: Float32[ndarray, "h w"]  # that the pattern is there

    def features(self, period: float, pixels_a_period: float) -> Float32[ndarray, "h w 5"]:
        """Agreement, ratio, probability, and logarithms of how far the fit moved and how much coordinates bend.

        They bend where they do not continue the plane around them: at borders, tears and folds.
        """
        known = np.isfinite(self.fitted[..., 0])
        weight = known.astype(np.float32)
        fitted = np.where(known[..., None], self.fitted, 0)
        move = np.where(known, np.linalg.norm(fitted - np.nan_to_num(self.read), axis=-1), 0) / period
        mean = _means(fitted, weight, _BEND_WINDOW * pixels_a_period)
        bend = np.linalg.norm(mean - fitted, axis=-1) / period
        features = [
            self.agreement,
            np.minimum(self.log_ratio, _LARGEST_RATIO),
            self.probability,
            np.log(_means(move[..., None], weight, _MOVE_WINDOW * pixels_a_period)[..., 0] + _LEAST_MOVE),
            np.log(bend + _LEAST_BEND),
        ]
        return np.stack(features, -1).astype(np.float32)


@dataclass(frozen=True)
class Reliability:
    """The trained model: log odds that a pixel is wrong are `bias` plus the features times `weight`."""

    weight: Float32[ndarray, "5"]
    bias: float

    def wrong(self, features: Float32[ndarray, "*n 5"]) -> Float32[ndarray, "*n"]:
        """Probability that each pixel is wrong."""
        return (1 / (1 + np.exp(-(features @ self.weight + self.bias)))).astype(np.float32)


def _means(
    values: Float32[ndarray, "h w k"], weight: Float32[ndarray, "h w"], sigma: float
) -> Float32[ndarray, "h w k"]:
    """Gaussian means over the pixels that have weight."""
    total = cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    sums = cv2.GaussianBlur(values.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return np.atleast_3d(sums) / np.maximum(total, 1e-6)[..., None]
