"""The inverse distances that are tried for every pixel of an image, and where its epipolar lines really run."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy import ndarray

from sl_nerfstudio.matching.epipolar_lines import EpipolarLines
from sl_nerfstudio.matching.semi_global import UNKNOWN
from sl_nerfstudio.matching.settings import HypothesisSettings
from sl_nerfstudio.pattern.gaussian_window import gaussian_window


def with_offset(
    lines: EpipolarLines,
    coords: Float32[ndarray, "h w 2"],
    period: float,
    pixels_a_period: float,
    settings: HypothesisSettings,
) -> EpipolarLines:
    """Lines that run through decoded coordinates, on average over a window: poses and lenses are not known exactly."""
    apart = coords - lines.at(lines.nearest(coords))
    good = np.hypot(apart[..., 0], apart[..., 1]) < settings.agreement * period  # False for NaN
    values = np.dstack([np.where(good[..., None], apart, np.float32(0)), good.astype(np.float32)])
    means = gaussian_window(values, settings.offset_window * pixels_a_period)
    offset = means[..., :2] / (means[..., 2:] + np.float32(settings.offset_prior))
    return replace(lines, offset=lines.offset + offset)


def hypotheses(
    lines: EpipolarLines,
    coords: Float32[ndarray, "h w 2"],
    w: Float64[ndarray, "h w"],
    mask: Bool[ndarray, "h w"],
    period: float,
    settings: HypothesisSettings,
) -> Float64[ndarray, "k"] | None:
    """Evenly spaced inverse distances around those of the decoded pixels; None where hardly any is near its line.

    `w` are the inverse distances nearest to the decoded coordinates. What the mask shows may be as deep as it is wide:
    parts of which nothing was decoded may lie before or behind.
    """
    apart = np.linalg.norm(coords - lines.at(w), axis=-1)
    good = apart < settings.agreement * period
    if good.sum() < settings.fewest:
        return None
    low, middle, high = np.quantile(w[good], [settings.quantile, 0.5, 1 - settings.quantile])
    depth = _half_width(lines.ray[mask | good], settings.quantile)
    low, high = min(low, middle / (1 + depth)), max(high, middle / (1 - depth))
    margin = settings.margin * (high - low)
    low, high = max(low - margin, low / 2), high + margin
    slope = np.linalg.norm(lines.slopes(np.full(w.shape, (low + high) / 2)), axis=-1)[good]
    length = float(np.median(slope)) * (high - low)
    count = int(np.clip(np.ceil(length / (settings.step * period)), settings.fewest, settings.most))
    return np.linspace(low, high, count)


def numbers_of(w: Float64[ndarray, "h w"], tried: Float64[ndarray, "k"]) -> Int32[ndarray, "h w"]:
    """The nearest of the inverse distances that are tried; `UNKNOWN` for NaN and beyond their range."""
    number = np.rint((w - tried[0]) / (tried[1] - tried[0]))
    inside = (number >= 0) & (number < len(tried))  # False for NaN
    return np.where(inside, number, UNKNOWN).astype(np.int32)


def _half_width(rays: Float64[ndarray, "n 3"], quantile: float) -> float:
    """Of what the rays see, as a share of its distance; at most a half."""
    rays = rays[np.isfinite(rays[:, 0])]
    centre = rays.mean(0)
    cosine = np.quantile(rays @ (centre / np.linalg.norm(centre)), quantile)
    return min(float(np.sqrt(1 - min(cosine, 1.0) ** 2)), 0.5)
