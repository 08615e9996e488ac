"""Measurements of sharpness: of the edges of an image, and of the lines of a grid whose phases are known."""

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from sl_nerfstudio.decoding.grid.channels import RECTIFIED_PERIOD, network_channels
from sl_nerfstudio.decoding.grid.graph import PhaseMaps
from sl_nerfstudio.decoding.grid.rectify import RectifiedImage
from sl_nerfstudio.decoding.grid.unet import STRIDE
from sl_nerfstudio.pattern.grid import GridPattern

_SMOOTHING = 1.0  # sigma against noise, pixels
_AGAIN = 2.5  # sigma of the second blur, with which the first is compared, pixels
_DIFFERENCE = 1 / 3  # variance of what a central difference blurs, pixels squared
_STRONGEST = 0.01  # share of the pixels that count as edges
_BLURS = np.linspace(0.03, 0.33, 16)  # periods
_BETWEEN = 0.2  # periods from the lines of the other family
_LEAST_FIRST = 0.1  # of the local contrast, sum of both families: with less there are no lines
_FEWEST = 100  # places of the maps


def edge_width(grey: Float32[ndarray, "h w"]) -> float:
    """Sigma, in pixels, of the blur of the strongest edges; infinite without edges.

    A second blur of known width lowers the gradient of an edge the less, the wider the edge already is (Zhuo and Sim,
    2011).
    """
    once = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING)
    twice = cv2.GaussianBlur(once, (0, 0), _AGAIN)
    slope, slope_after = _slope(once), _slope(twice)
    edge = slope >= max(float(np.quantile(slope, 1 - _STRONGEST)), 1e-6)
    if not edge.any():
        return float("inf")
    ratio = float(np.median(slope[edge] / np.maximum(slope_after[edge], 1e-9)))
    if ratio <= 1:
        return float("inf")
    return float(np.sqrt(max(_AGAIN**2 / (ratio**2 - 1) - _SMOOTHING**2 - _DIFFERENCE, 0.0)))


def _slope(image: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    gy, gx = np.gradient(image)
    return np.hypot(gx, gy)


def line_blur(
    rectified: RectifiedImage, maps: PhaseMaps, where: Bool[ndarray, "h w"], pattern: GridPattern
) -> float | None:
    """Sigma, in periods, of the blur of a grid's lines at some places of the maps; None if they show no lines.

    The profile across the lines is compared with that of the drawn pattern at many blurs.
    """
    contrast = cv2.resize(
        network_channels(rectified.image)[0], None, fx=1 / STRIDE, fy=1 / STRIDE, interpolation=cv2.INTER_AREA
    )
    x = np.arctan2(maps.vector[1], maps.vector[0]) / (2 * np.pi)
    y = np.arctan2(maps.vector[3], maps.vector[2]) / (2 * np.pi)
    if where.sum() < _FEWEST:
        return None
    measured = _overtone(contrast[where], x[where], y[where])
    if measured is None:
        return None
    known = [overtone for overtone in _drawn_overtones(pattern) if overtone is not None]
    return float(np.interp(-measured, -np.array(known), _BLURS[: len(known)]))  # overtones fall as the blur grows


def _overtone(contrast: Float[ndarray, "n"], x: Float[ndarray, "n"], y: Float[ndarray, "n"]) -> float | None:
    """Strength of the second harmonic relative to the first, across both families of lines; None without a first."""
    first, second = 0.0, 0.0
    for across, along in ((x, y), (y, x)):
        between = np.abs(along) > _BETWEEN
        value = contrast[between] - contrast[between].mean()
        first += float((value * np.cos(2 * np.pi * across[between])).mean())
        second += float((value * np.cos(4 * np.pi * across[between])).mean())
    return second / first if first > _LEAST_FIRST else None


@lru_cache(maxsize=4)
def _drawn_overtones(pattern: GridPattern) -> tuple[float | None, ...]:
    """The same for the pattern as drawn with each of the blurs, at the scale of a rectified image."""
    scale = RECTIFIED_PERIOD / pattern.period
    size = (round(pattern.w * scale) // STRIDE * STRIDE, round(pattern.h * scale) // STRIDE * STRIDE)
    column, row = np.meshgrid(*((np.arange(n // STRIDE) + 0.5) / (n // STRIDE) for n in size))
    x, y = (column * pattern.w - pattern.x0) / pattern.period, (row * pattern.h - pattern.y0) / pattern.period
    to_line = (x - np.rint(x)).ravel(), (y - np.rint(y)).ravel()
    drawn = pattern.render(1)
    found = []
    for blur in _BLURS:
        picture = cv2.GaussianBlur(drawn, (0, 0), blur * pattern.period)
        image = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        channel = network_channels(image)[0]
        contrast = cv2.resize(channel, None, fx=1 / STRIDE, fy=1 / STRIDE, interpolation=cv2.INTER_AREA)
        found.append(_overtone(contrast.ravel(), *to_line))
    return tuple(found)
