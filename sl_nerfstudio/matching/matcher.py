"""A decoded photograph, matched again along the epipolar lines of its relative pose."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy import ndarray
from scipy.ndimage import find_objects

from sl_nerfstudio.decoding.grid.drawn_grid import DrawnGrid, draw_sharpnesses
from sl_nerfstudio.decoding.grid.smoothing import shrink
from sl_nerfstudio.decoding.regions import drop_small_regions
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.matching.confidence import RIGHT, features_of
from sl_nerfstudio.matching.costs import Statistics, correlations, image_statistics, matching_costs
from sl_nerfstudio.matching.epipolar_lines import EpipolarLines
from sl_nerfstudio.matching.hypotheses import hypotheses, numbers_of, with_offset
from sl_nerfstudio.matching.line_fit import LineFit
from sl_nerfstudio.matching.resolution import enlarged, pixels_a_period
from sl_nerfstudio.matching.semi_global import Matches, match_semi_globally
from sl_nerfstudio.matching.settings import MATCHING_DEFAULTS, MatchingSettings
from sl_nerfstudio.pattern.grid import GridPattern


@dataclass(frozen=True)
class DecodedImage:
    """What matching starts from."""

    grey: Float32[ndarray, "h w"]
    coords: Float32[ndarray, "h w 2"]  # decoded, pattern pixels; NaN where not
    mask: Bool[ndarray, "h w"]  # where the decoder saw the pattern

    @property
    def decoded(self) -> Bool[ndarray, "h w"]:
        """Pixels that have coordinates."""
        return np.isfinite(self.coords[..., 0])

    def part(self, box: tuple[slice, slice]) -> "DecodedImage":
        """The pixels in a box."""
        return DecodedImage(*(np.ascontiguousarray(one[box]) for one in (self.grey, self.coords, self.mask)))

    def shrunk(self, factor: int) -> "DecodedImage":
        """Squares of `factor` pixels as one: means of the image, and what the pixel in their middle has."""
        if factor == 1:
            return self
        h, w = self.mask.shape[0] // factor, self.mask.shape[1] // factor
        grey = shrink(self.grey[: h * factor, : w * factor, None], (w, h), factor)[..., 0]
        middle = (slice(factor // 2, h * factor, factor), slice(factor // 2, w * factor, factor))
        return DecodedImage(grey, np.ascontiguousarray(self.coords[middle]), np.ascontiguousarray(self.mask[middle]))


@dataclass(frozen=True)
class MatchedImage:
    """Matches of all pixels of an image, and what tells the right ones from the wrong ones."""

    coords: Float32[ndarray, "h w 2"]  # fitted to the image; NaN where not
    features: Float32[ndarray, "h w f"]


class LineMatcher:
    """Matches photographs of one pattern. Create it once for all frames."""

    def __init__(self, pattern: GridPattern, settings: MatchingSettings = MATCHING_DEFAULTS) -> None:
        self.pattern = pattern
        self._settings = settings

    def match(
        self, image: DecodedImage, camera: Device, projector: Device, T_camera_projector: Float64[ndarray, "4 4"]
    ) -> Float32[ndarray, "h w 2"]:
        """Coordinates in place of the decoded ones; these, where hardly any agree with what is matched.

        The pose's baseline may have any length. Coordinates are pattern pixels, NaN where none are probably right.
        """
        s, period = self._settings, self.pattern.period
        size = pixels_a_period(image.coords, period)
        if size is None:
            return image.coords
        factor = max(1, int(size / s.finest))
        small = image.shrunk(factor)
        h, w = small.mask.shape
        lines = EpipolarLines.of(replace(camera.scaled(1 / factor), w=w, h=h), projector, T_camera_projector)
        matched = self.matched(small, lines, size / factor)
        if matched is None or not self._agrees(small, matched):
            return image.coords
        right = RIGHT.probability(matched.features) > s.keeping.least_probability
        kept = np.where(right[..., None], matched.coords, np.float32(np.nan))
        least = round(s.keeping.smallest_region * (size / factor) ** 2)
        kept = drop_small_regions(kept, s.keeping.tear * period, least)
        return enlarged(kept, factor, (image.mask.shape[0], image.mask.shape[1]), period)

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
        s, period = self._settings, self.pattern.period
        lines = with_offset(lines, image.coords, period, size, s.hypotheses)
        decoded = lines.nearest(image.coords)
        tried = hypotheses(lines, image.coords, decoded, image.mask, period, s.hypotheses)
        if tried is None:
            return None
        sigma = s.costs.window * size
        statistics = image_statistics(image.grey, image.decoded, sigma, s.costs)
        grid = self._sharpness(image, statistics, sigma)
        matches = self._in_strips(image.grey, statistics, lines, numbers_of(decoded, tried), tried, grid, size)
        w = tried[0] + matches.index.astype(np.float64) * (tried[1] - tried[0])
        fitted = LineFit(grid, size, s.fit).fitted(image.grey, lines, w)
        correlation = correlations(image.grey, statistics, fitted, grid, sigma, s.costs)
        near, jump = s.keeping.near * period, s.keeping.jump * period
        features = features_of(matches, fitted, correlation, image.coords, image.mask, near, jump, size)
        return MatchedImage(fitted, features)

    def _in_strips(
        self,
        grey: Float32[ndarray, "h w"],
        statistics: Statistics,
        lines: EpipolarLines,
        decoded: Int32[ndarray, "h w"],
        tried: Float64[ndarray, "k"],
        grid: DrawnGrid,
        size: float,
    ) -> Matches:
        """Strips of rows that overlap, as high as memory allows."""
        s, (h, w) = self._settings, grey.shape
        margin = round(s.strip_margin * size)
        rows = max(s.most_bytes // (3 * w * len(tried)) - 2 * margin, margin, 1)
        parts = []
        for first in range(0, h, rows):
            begin, end = max(first - margin, 0), min(first + rows + margin, h)
            some = slice(begin, end)
            there = statistics[0][some], statistics[1][some]
            strip, sigma = lines.part((some, slice(None))), s.costs.window * size
            costs = matching_costs(grey[some], there, strip, tried, grid, sigma, s.costs)
            parts.append(
                match_semi_globally(costs, decoded[some], s.smoothness).part(slice(first - begin, first - begin + rows))
            )
        return Matches.joined(parts)

    def _sharpness(self, image: DecodedImage, statistics: Statistics, sigma: float) -> DrawnGrid:
        """The pattern as sharp as the image shows it."""

        def agreement(grid: DrawnGrid) -> float:
            found = correlations(image.grey, statistics, image.coords, grid, sigma, self._settings.costs)
            return float(found[image.decoded].mean())

        return max(self._drawn, key=agreement)

    def _agrees(self, image: DecodedImage, matched: MatchedImage) -> bool:
        """Whether most of what was decoded is matched where it was decoded."""
        s = self._settings.keeping
        apart = np.linalg.norm(matched.coords - image.coords, axis=-1)[image.decoded]
        return float((apart < s.near * self.pattern.period).mean()) >= s.least_agreement

    @cached_property
    def _drawn(self) -> tuple[DrawnGrid, ...]:
        return draw_sharpnesses(self.pattern.render(), self.pattern.period)


def _box(seen: Bool[ndarray, "h w"], margin: int) -> tuple[slice, slice]:
    """The rectangle that holds all pixels, of which there must be some, with a margin."""
    rows, columns = (slice(max(s.start - margin, 0), s.stop + margin) for s in find_objects(seen.astype(np.uint8))[0])
    return rows, columns
