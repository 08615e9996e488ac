"""Matched coordinates fitted to the image.

Where surfaces are flat, so is the inverse distance over the image: matches are smoothed as planes of it. Then shifts of
the pattern are fitted as the decoder's dense fit does. A shift competes with the flat surface, each with its variance:
what noise explains is not taken for detail. Across the line there is no detail, but shifts are held back less there:
distances from the line tell how noisy coordinates are, and where the projector stands.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.decoding.grid.drawn_grid import DrawnGrid, Light
from sl_nerfstudio.decoding.grid.shift_fit import fit_shift, measure_light
from sl_nerfstudio.decoding.grid.smoothing import flattened
from sl_nerfstudio.decoding.regions import large_regions
from sl_nerfstudio.matching.epipolar_lines import EpipolarLines
from sl_nerfstudio.matching.settings import LineFitSettings


@dataclass(frozen=True)
class LineFit:
    """What the fit needs besides the matches: the pattern, and how large a period is in the image."""

    grid: DrawnGrid
    pixels_a_period: float
    settings: LineFitSettings

    def fitted(
        self, image: Float32[ndarray, "h w"], lines: EpipolarLines, w: Float64[ndarray, "h w"]
    ) -> Float32[ndarray, "h w 2"]:
        """Coordinates; NaN in small regions."""
        coords = lines.at(w)
        out = np.full_like(coords, np.nan)
        largest, least = self.settings.tear * self.grid.period, self.settings.least_area * self.pixels_a_period**2
        for box, inside in large_regions(coords, largest, least):
            out[box][inside] = self._region(image[box], lines.part(box), w[box], inside)[inside]
        return out

    def _region(
        self,
        image: Float32[ndarray, "h w"],
        lines: EpipolarLines,
        w: Float64[ndarray, "h w"],
        inside: Bool[ndarray, "h w"],
    ) -> Float32[ndarray, "h w 2"]:
        s, period, size = self.settings, np.float32(self.grid.period), self.pixels_a_period
        trust, light = inside.astype(np.float32), Light.even(image.shape)
        slope = lines.slopes(w)
        steep = np.hypot(slope[..., 0], slope[..., 1])
        flat = lines.at(self._smooth(w, inside, steep))
        # Where the image moves the matches, and flat again: steps of the inverse distance leave errors of their own.
        flat = flat + period * fit_shift(image, flat, trust, self.grid, light, size, s.window).shift
        light = measure_light(image, flat, trust, self.grid, size)
        flat = lines.at(self._smooth(lines.nearest(flat), inside, steep))
        direction = slope / np.maximum(steep[..., None], np.float32(1e-12))
        total = np.zeros_like(flat)
        for _ in range(s.rounds):
            fit = fit_shift(image, flat + total * period, trust, self.grid, light, size, s.window)
            _take(fit.shift, fit.variance, direction, (s.dependent, s.detail**2, s.across**2, s.largest), total)
        return flat + total * period

    def _smooth(
        self, w: Float64[ndarray, "h w"], inside: Bool[ndarray, "h w"], slope: Float32[ndarray, "h w"]
    ) -> Float64[ndarray, "h w"]:
        """On planes that are near the pixel's own match, along its line."""
        unit = float(np.median(w[inside]))
        scaled = np.where(inside, w / unit, 1).astype(np.float32)

        def is_near(apart: Float32[ndarray, "h w 2"], limit: float) -> Bool[ndarray, "h w"]:
            return np.abs(apart[..., 0]) * unit * slope < limit * self.grid.period

        windows = [(window * self.pixels_a_period, limit) for window, limit in self.settings.smoothing]
        both = np.dstack([scaled, scaled])  # planes are fitted to two values at a time
        return flattened(both, inside, windows, is_near)[..., 0].astype(np.float64) * unit


@compiled
def _take(
    shift: ndarray, variance: ndarray, direction: ndarray, limits: tuple[float, float, float, float], total: ndarray
) -> None:
    """Add shifts to the total, in place; both parts of it are then drawn back to zero by their variances."""
    dependent, detail, across, largest = limits
    for row in range(total.shape[0]):
        for column in range(total.shape[1]):
            x, y = total[row, column, 0] + shift[row, column, 0], total[row, column, 1] + shift[row, column, 1]
            dx, dy = direction[row, column, 0], direction[row, column, 1]
            noise = dependent * variance[row, column]
            a, b = x * dx + y * dy, y * dx - x * dy
            a, b = a * detail / (detail + noise), b * across / (across + noise)
            total[row, column, 0] = min(max(a * dx - b * dy, -largest), largest)
            total[row, column, 1] = min(max(a * dy + b * dx, -largest), largest)
