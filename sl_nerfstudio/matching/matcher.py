"""A decoded photograph, matched again along the epipolar lines of its relative pose.

Inverse distances are matched semi-globally; the matches are fitted to the image, and a logistic model of what is known
of each says how probable it is that it is right.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy import ndarray
from scipy.ndimage import find_objects

from sl_nerfstudio.decoding.decoder import Coords, Layer, Mask, drop_small_regions, large_regions, torn
from sl_nerfstudio.decoding.grid_fit import DrawnGrid, GridLight, draw_sharpnesses, fit_shift, flattened, measure_light
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.matching.costs import Statistics, correlations, image_statistics, matching_costs
from sl_nerfstudio.matching.lines import (
    OUTSIDE_PX,
    TEAR,
    EpipolarLines,
    hypotheses,
    numbers_of,
    pixels_a_period,
    with_offset,
)
from sl_nerfstudio.matching.ranges import TILE, TriedRanges
from sl_nerfstudio.matching.semi_global import StereoMatches, match_semi_globally
from sl_nerfstudio.parallel import compiled
from sl_nerfstudio.pattern.grid import GridPattern

COST_WINDOW = 0.14  # standard deviation of the window of correlations, periods
MOST_BYTES = 2**28  # memory for costs; larger images are matched in strips
STRIP_MARGIN = 6.0  # by which strips overlap on each side, periods

# Which pixels are kept.
LEAST_PROBABILITY = 0.5  # that a pixel is right
NEAR = 0.1  # distance within which coordinates count as right, and as those that were decoded, periods
JUMP = 0.3  # difference between neighbouring pixels that counts as a jump in depth, periods
SMALLEST_REGION = 2.0  # periods squared
REGION_TEAR = 0.5  # difference between neighbouring pixels that separates such regions, periods
LEAST_AGREEMENT = 0.8  # share of the decoded pixels that must be matched there; otherwise nothing is replaced

# The fit of coordinates to the image.
SMOOTHING = ((0.25, 0.05), (0.12, 0.1))
"""Windows in which the surface is taken to be flat, and how far from them a pixel may be; periods."""
SHIFT_WINDOW = 0.38  # standard deviation of the window of a shift, periods
FIT_ROUNDS = 6  # each recovers a part of the detail that the window averages over
DETAIL = 0.06  # 1 sigma of coordinates along the line around that flat surface, periods
ACROSS = 0.02  # across the line: more than there is, because distances from it tell how large noise is
DEPENDENT = 16.0  # area, in pixels, over which the errors of an image depend on each other
LARGEST_SHIFT = 0.12  # limit of all shifts together, periods
LEAST_AREA = 1.0  # smaller regions are left out, periods squared


@dataclass(frozen=True)
class DecodedImage:
    """Input of the matching."""

    grey: Layer
    coords: Coords  # decoded, pattern pixels; NaN where not
    mask: Mask  # where the decoder saw the pattern

    @property
    def decoded(self) -> Mask:
        """Pixels that have coordinates."""
        return np.isfinite(self.coords[..., 0])

    def part(self, box: tuple[slice, slice]) -> "DecodedImage":
        """The pixels in a box."""
        return DecodedImage(*(np.ascontiguousarray(one[box]) for one in (self.grey, self.coords, self.mask)))


@dataclass(frozen=True)
class MatchedImage:
    """Matches of all pixels of an image, and what tells the right ones from the wrong ones."""

    coords: Coords  # fitted to the image; NaN where not
    features: Float32[ndarray, "h w f"]


class LineMatcher:
    """Matches photographs of one pattern. Create it once for all frames."""

    def __init__(self, pattern: GridPattern) -> None:
        self.pattern = pattern

    def match(
        self, image: DecodedImage, camera: Device, projector: Device, T_camera_projector: Float64[ndarray, "4 4"]
    ) -> Coords:
        """Coordinates in place of the decoded ones; these, where hardly any agree with what is matched.

        The pose's baseline may have any length. Coordinates are pattern pixels, NaN where none are probably right.
        """
        period = self.pattern.period
        size = pixels_a_period(image.coords, period)
        if size is None:
            return image.coords
        matched = self.matched(image, EpipolarLines.of(camera, projector, T_camera_projector), size)
        if matched is None or not self._agrees(image, matched):
            return image.coords
        right = RIGHT.probability(matched.features) > LEAST_PROBABILITY
        kept = np.where(right[..., None], matched.coords, np.float32(np.nan))
        return drop_small_regions(kept, REGION_TEAR * period, round(SMALLEST_REGION * size**2))

    def matched(self, image: DecodedImage, lines: EpipolarLines, size: float) -> MatchedImage | None:
        """Matches of all pixels; `size` is that of a period in the image. None where nothing that was decoded fits."""
        box = _box(image.mask | image.decoded, round(2 * size))
        inside = self._matched(image.part(box), lines.part(box), size)
        if inside is None:
            return None
        coords = np.full(image.coords.shape, np.nan, dtype=np.float32)
        features = np.zeros((*image.mask.shape, inside.features.shape[-1]), dtype=np.float32)
        coords[box], features[box] = inside.coords, inside.features
        return MatchedImage(coords, features)

    def _matched(self, image: DecodedImage, lines: EpipolarLines, size: float) -> MatchedImage | None:
        period = self.pattern.period
        lines = with_offset(lines, image.coords, period, size)
        decoded = lines.nearest(image.coords)
        w = hypotheses(lines, image.coords, decoded, image.mask, period)
        if w is None:
            return None
        numbers = numbers_of(decoded, w)
        tried = TriedRanges.near(numbers, image.mask, len(w))
        sigma = COST_WINDOW * size
        statistics = image_statistics(image.grey, image.decoded, sigma)
        grid = self._sharpness(image, statistics, sigma)
        matches = self._in_strips(image.grey, statistics, lines, w, tried, numbers, grid, size)
        matched = w[0] + matches.index.astype(np.float64) * (w[1] - w[0])
        fitted = LineFit(grid, size).fitted(image.grey, lines, matched, image.decoded)
        correlation = correlations(image.grey, statistics, fitted, grid, sigma)
        features = features_of(matches, fitted, correlation, image.coords, image.mask, period, size)
        return MatchedImage(fitted, features)

    def _in_strips(
        self,
        grey: Layer,
        statistics: Statistics,
        lines: EpipolarLines,
        w: Float64[ndarray, "k"],
        tried: TriedRanges,
        decoded: Int32[ndarray, "h w"],
        grid: DrawnGrid,
        size: float,
    ) -> StereoMatches:
        """Strips of rows of tiles that overlap, as high as memory allows."""
        margin, height = -(-round(STRIP_MARGIN * size) // TILE), len(tried.count)
        parts, first = [], 0
        while first < height:
            begin, end = max(first - margin, 0), first + 1
            while end < height and 3 * tried.part(slice(begin, end + 1 + margin)).cells <= MOST_BYTES:
                end += 1
            tiles, rows = tried.part(slice(begin, end + margin)), slice(begin * TILE, (end + margin) * TILE)
            there, strip = (statistics[0][rows], statistics[1][rows]), lines.part((rows, slice(None)))
            costs = matching_costs(grey[rows], there, strip, w, tiles, grid, COST_WINDOW * size)
            matches = match_semi_globally(costs, tiles, decoded[rows])
            parts.append(matches.part(slice((first - begin) * TILE, (end - begin) * TILE)))
            first = end
        return StereoMatches.joined(parts)

    def _sharpness(self, image: DecodedImage, statistics: Statistics, sigma: float) -> DrawnGrid:
        """The pattern as sharp as the image shows it."""

        def agreement(grid: DrawnGrid) -> float:
            found = correlations(image.grey, statistics, image.coords, grid, sigma)
            return float(found[image.decoded].mean())

        return max(self._drawn, key=agreement)

    def _agrees(self, image: DecodedImage, matched: MatchedImage) -> bool:
        """Whether most of what was decoded is matched where it was decoded."""
        apart = np.linalg.norm(matched.coords - image.coords, axis=-1)[image.decoded]
        return float((apart < NEAR * self.pattern.period).mean()) >= LEAST_AGREEMENT

    @cached_property
    def _drawn(self) -> tuple[DrawnGrid, ...]:
        return draw_sharpnesses(self.pattern.render(), self.pattern.period)


def _box(seen: Mask, margin: int) -> tuple[slice, slice]:
    """The rectangle that holds all pixels, of which there must be some, with a margin."""
    rows, columns = (slice(max(s.start - margin, 0), s.stop + margin) for s in find_objects(seen.astype(np.uint8))[0])
    return rows, columns


# Matched coordinates fitted to the image.
#
# Where surfaces are flat, so is the inverse distance over the image: matches are smoothed as planes of it. Then shifts
# of the pattern are fitted as the decoder's dense fit does. A shift competes with the flat surface, each with its
# variance: what noise explains is not taken for detail. Across the line there is no detail, but shifts are held back
# less there: distances from the line tell how noisy coordinates are, and where the projector stands.


@dataclass(frozen=True)
class LineFit:
    """Fit of matches to the image, for a pattern and the size of its period in the image."""

    grid: DrawnGrid
    pixels_a_period: float

    def fitted(self, image: Layer, lines: EpipolarLines, w: Float64[ndarray, "h w"], decoded: Mask) -> Coords:
        """Coordinates; NaN in small regions. Planes and shifts are those of the pixels that were `decoded`."""
        coords = lines.at(w)
        out = np.full_like(coords, np.nan)
        largest, least = TEAR * self.grid.period, LEAST_AREA * self.pixels_a_period**2
        for box, inside in large_regions(coords, largest, least):
            out[box][inside] = self._region(image[box], lines.part(box), w[box], inside, decoded[box])[inside]
        return out

    def _region(
        self, image: Layer, lines: EpipolarLines, w: Float64[ndarray, "h w"], inside: Mask, decoded: Mask
    ) -> Coords:
        period, size, light = np.float32(self.grid.period), self.pixels_a_period, GridLight.even(image.shape)
        trust = (inside & decoded).astype(np.float32)
        slope = lines.slopes(w)
        steep = np.hypot(slope[..., 0], slope[..., 1])
        flat = lines.at(self._smooth(w, inside, trust, steep))
        # Where the image moves the matches, and flat again: steps of the inverse distance leave errors of their own.
        flat = flat + period * fit_shift(image, flat, trust, self.grid, light, size, SHIFT_WINDOW).shift
        light = measure_light(image, flat, trust, self.grid, size)
        flat = lines.at(self._smooth(lines.nearest(flat), inside, trust, steep))
        direction = slope / np.maximum(steep[..., None], np.float32(1e-12))
        total = np.zeros_like(flat)
        for _ in range(FIT_ROUNDS):
            fit = fit_shift(image, flat + total * period, trust, self.grid, light, size, SHIFT_WINDOW)
            _take(fit.shift, fit.variance, direction, (DEPENDENT, DETAIL**2, ACROSS**2, LARGEST_SHIFT), total)
        return flat + total * period

    def _smooth(self, w: Float64[ndarray, "h w"], inside: Mask, trust: Layer, slope: Layer) -> Float64[ndarray, "h w"]:
        """Inverse distances of planes that are near the pixel's own match, along its line."""
        unit = float(np.median(w[inside]))
        scaled = np.where(inside, w / unit, 1).astype(np.float32)

        def is_near(apart: Coords, limit: float) -> Mask:
            return np.abs(apart[..., 0]) * unit * slope < limit * self.grid.period

        windows = [(window * self.pixels_a_period, limit) for window, limit in SMOOTHING]
        both = np.dstack([scaled, scaled])  # planes are fitted to two values at a time
        return flattened(both, inside, trust, windows, is_near)[..., 0].astype(np.float64) * unit


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


# How probable it is that a matched pixel is right, by a logistic model of what is known about it.
#
# Its weights come from `python -m training.matching`.

FEATURES = (
    "margin over the best rival, logarithm",
    "cost of the match",
    "matched where it was decoded",
    "matched elsewhere than it was decoded",
    "in the decoder's mask",
    "distance from a jump, periods, logarithm",
    "correlation after the fit",
    "share of opposite neighbours with it between them",
)
_REACH, _STRIDE = 4, 2  # of those neighbours, pixels
_BETWEEN = 2.0  # steps of the inverse distance from the middle of two neighbours
_FARTHEST = 2.0  # distance from a jump beyond which it does not count, periods
_NEAREST = 0.07  # added to that distance, periods


@dataclass(frozen=True)
class Logistic:
    """A constant, and a weight for each of `FEATURES`."""

    constant: float
    weights: tuple[float, ...]

    def probability(self, features: Float32[ndarray, "*pixels f"]) -> Float32[ndarray, "*pixels"]:
        """The probability that a pixel is right."""
        odds = features @ np.array(self.weights, dtype=np.float32) + np.float32(self.constant)
        return 1 / (1 + np.exp(-odds))


RIGHT = Logistic(-4.081, (0.0741, -0.0053, 2.5316, -0.7949, 2.3923, 0.5960, 3.2449, 0.5606))


def features_of(
    matches: StereoMatches,
    fitted: Coords,
    correlation: Layer,
    decoded: Coords,
    mask: Mask,
    period: float,
    pixels_a_period: float,
) -> Float32[ndarray, "h w f"]:
    """`FEATURES` of every pixel, `period` in pattern pixels. Unknown where nothing was fitted."""
    apart = np.linalg.norm(fitted - decoded, axis=-1)
    between = np.zeros(mask.shape, dtype=np.float32)
    _count_between(matches.index, np.float32(_BETWEEN), between)
    from_jump = np.minimum(_distance_from_jumps(fitted, JUMP * period) / pixels_a_period, _FARTHEST)
    return np.stack(
        [
            np.log1p(np.maximum(matches.margin, 0)),
            matches.cost,
            apart < NEAR * period,
            apart >= NEAR * period,  # both False for NaN
            mask,
            np.log(from_jump + _NEAREST),
            np.nan_to_num(correlation),
            between,
        ],
        axis=-1,
    ).astype(np.float32)


def _distance_from_jumps(coords: Coords, jump: float) -> Float64[ndarray, "h w"]:
    """Pixels to the nearest one beside which coordinates jump or end."""
    ended = np.where(np.isfinite(coords[..., :1]), coords, np.float32(OUTSIDE_PX))
    smooth = (~torn(ended, jump)).astype(np.uint8)
    return cv2.distanceTransform(smooth, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)


@compiled
def _count_between(index: ndarray, most: float, out: ndarray) -> None:
    """Share of the pairs of opposite pixels around, on a lattice, whose mean is nearly the pixel's own match.

    All are on a plane, however steep it is.
    """
    h, w = index.shape
    for row in range(h):
        for column in range(w):
            count, pairs = 0, 0
            for dr in range(0, _REACH + 1, _STRIDE):
                for dc in range(-_REACH, _REACH + 1, _STRIDE):
                    if dr == 0 and dc <= 0:
                        continue
                    a, b = min(row + dr, h - 1), min(max(column + dc, 0), w - 1)
                    c, d = max(row - dr, 0), min(max(column - dc, 0), w - 1)
                    pairs += 1
                    count += abs((index[a, b] + index[c, d]) / 2 - index[row, column]) < most
            out[row, column] = count / pairs
