"""The coded grid: vertical and horizontal line segments with small gaps at the crossings.

Node (i, j) of the grid (row, column) lies at pattern pixel (x0 + j * period, y0 + i * period). Each node shifts the
ends of the segments that meet there, and a segment runs straight from one shifted end to the other. So the lines bend
a little, but the nodes stay on the regular grid.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int8
from numpy import ndarray

from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.pattern.codes import SYMBOL_NAMES, SYMBOLS, WINDOW, code_array, hamming_margins, is_generated
from sl_nerfstudio.pattern.layout import Lattice, PatternLayout, number, whole_number

# Means in Gaussian windows of any width.

_FINEST = 3  # squares per standard deviation: what is averaged over wide windows need not be known more finely


def gaussian_window(values: Float32[ndarray, "h w *k"], sigma: float) -> Float32[ndarray, "h w *k"]:
    """Means about each pixel in a Gaussian window of `sigma` pixels, with zeros outside the image; up to four channels.

    Quotients of two such means are means over the image, or a part of it, alone. Wide windows are applied to means over
    squares of pixels and interpolated in between, with the variance of both taken off the window's: this takes the same
    time for each pixel however wide the window is.
    """
    step = max(1, int(sigma / _FINEST))
    if step == 1:
        return cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    h, w = values.shape[:2]
    rows, columns = -(-h // step) + 2, -(-w // step) + 2  # with one square more on each side, to interpolate towards
    borders = step, (rows - 1) * step - h, step, (columns - 1) * step - w
    whole = cv2.copyMakeBorder(values, *borders, cv2.BORDER_CONSTANT)
    coarse = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    narrower = float(np.sqrt((sigma / step) ** 2 - 1 / 12 - 1 / 6))  # less what the squares and the interpolation add
    coarse = cv2.GaussianBlur(coarse, (0, 0), narrower, borderType=cv2.BORDER_CONSTANT)
    fine = cv2.resize(coarse, (columns * step, rows * step), interpolation=cv2.INTER_LINEAR)
    return fine[step : step + h, step : step + w]


# Local intensity normalisation: makes a captured image look like the pattern that was projected on the object.


def normalise_locally(
    image: Float[ndarray, "h w"], mask: Bool[ndarray, "h w"], sigma: float, mean: float = 0.5, contrast: float = 0.25
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


# How strongly a surface returns the projector's light: what remains of an image without the pattern and the room.

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
    known = all_finite(coords)
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
    """Fit one picture; `image_means` are those of the weight, of the grey and of its square."""
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


# Any image as a pattern: bilinear interpolation.


def sample_bilinear(image: Float32[ndarray, "h w"], uv: Float[ndarray, "*n 2"]) -> Float32[ndarray, "*n"]:
    """Value at pixel coordinates (x, y) whose first pixel centre is (0.5, 0.5).

    Beyond the outermost pixel centres the value at the border continues; NaN coordinates give NaN.
    """
    h, w = image.shape
    place = uv.astype(np.float32) - np.float32(0.5)
    x, y = np.clip(place[..., 0], 0, w - 1), np.clip(place[..., 1], 0, h - 1)
    unknown = np.isnan(place).any(-1)
    if unknown.any():
        x, y = np.where(unknown, 0, x), np.where(unknown, 0, y)
    left = np.minimum(x.astype(np.int32), max(w - 2, 0))
    top = np.minimum(y.astype(np.int32), max(h - 2, 0))
    fx, fy = x - left, y - top
    right, bottom = np.minimum(left + 1, w - 1), np.minimum(top + 1, h - 1)
    flat = image.reshape(-1)
    upper = flat[top * w + left] * (1 - fx) + flat[top * w + right] * fx
    lower = flat[bottom * w + left] * (1 - fx) + flat[bottom * w + right] * fx
    value = upper * (1 - fy) + lower * fy
    return np.where(unknown, np.float32(np.nan), value).astype(np.float32)


# Offsets, in half gaps, of the segments that meet at a node, by symbol: left, right (y down); above, below (x right).
_OFFSETS = np.array([[0, 0, 0, 0], [-1, 1, 0, 0], [1, -1, 0, 0], [0, 0, 1, -1], [0, 0, -1, 1]], dtype=np.float64)
MAX_NODES = 200  # a side
MAX_PIXELS = 100_000_000
_BAND = 16  # rows that are drawn at a time: they fit into the processor's cache
_LENGTHS = ("period", "line_width", "gap", "dark")


@dataclass(frozen=True, eq=False)
class GridPattern(PatternLayout):
    """Description of a coded grid; lengths in pattern pixels."""

    kind: ClassVar[str] = "grid"
    description: ClassVar[str] = "a coded grid"
    w: int = 800
    h: int = 800
    period: float = 20.0
    line_width: float = 4.0
    gap: float = 6.0
    dark: float = 0.0  # intensity between the lines; the lines have 1
    seed: int = 0
    codes: Int8[ndarray, "rows columns"] | None = None  # None: generated from the seed

    def __post_init__(self) -> None:
        """Check the lengths and fill in the codes. Raises ValueError for a grid that cannot be drawn."""
        if not 0 < self.line_width < self.period or not 0 <= self.gap < self.period - self.line_width:
            raise ValueError(
                f"a grid needs 0 < line_width < period and 0 <= gap < period - line_width, got "
                f"line_width {self.line_width:g}, gap {self.gap:g}, period {self.period:g}"
            )
        if not 0 <= self.dark < 1:
            raise ValueError(f"dark is {self.dark:g}; the lines have 1, so it must be from 0 to less than 1")
        if self.w * self.h > MAX_PIXELS or max(self.w, self.h) > MAX_NODES * self.period:
            raise ValueError(f"a {self.w} x {self.h} pattern of period {self.period:g} is too large")
        rows, columns = int(self.h // self.period), int(self.w // self.period)
        if min(rows, columns) < 3:
            raise ValueError(f"a {self.w} x {self.h} pattern of period {self.period:g} has fewer than 3 x 3 nodes")
        codes = code_array(rows, columns, self.seed) if self.codes is None else np.asarray(self.codes, dtype=np.int8)
        if codes.shape != (rows, columns):
            raise ValueError(f"the code array must be {rows} x {columns}, got {codes.shape[0]} x {codes.shape[1]}")
        object.__setattr__(self, "codes", codes)

    @property
    def rows(self) -> int:
        """Number of nodes from top to bottom."""
        return int(self.h // self.period)

    @property
    def columns(self) -> int:
        """Number of nodes from left to right."""
        return int(self.w // self.period)

    @property
    def x0(self) -> float:
        """x of the leftmost nodes; the grid is centred in the pattern."""
        return (self.w - (self.columns - 1) * self.period) / 2

    @property
    def y0(self) -> float:
        """y of the topmost nodes."""
        return (self.h - (self.rows - 1) * self.period) / 2

    @cached_property
    def margins(self) -> tuple[int, int]:
        """Smallest number of the 9 symbols in which 3 x 3 windows differ: upright, and where the camera may roll."""
        return hamming_margins(np.asarray(self.codes))

    @property
    def lattice(self) -> Lattice:
        """The nodes of the grid."""
        return Lattice(self.period, self.x0, self.y0, self.rows, self.columns)

    def nodes(self) -> Float[ndarray, "rows columns 2"]:
        """Pattern pixel (x, y) of every node."""
        x = self.x0 + self.period * np.arange(self.columns)
        y = self.y0 + self.period * np.arange(self.rows)
        return np.stack(np.meshgrid(x, y), -1)

    def intensity(self, uv: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n"]:
        """Brightness at pattern pixels (x, y): 1 on a line, `dark` between, with edges one pixel soft."""
        x = (uv[..., 0] - self.x0) / self.period
        y = (uv[..., 1] - self.y0) / self.period
        offset_y, offset_x = self._line_offsets
        across_h = (y - np.rint(y)) * self.period - _along(offset_y, y, x)
        across_v = (x - np.rint(x)) * self.period - _along(offset_x.transpose(1, 0, 2), x, y)
        distance = np.minimum(np.abs(across_h), np.abs(across_v))
        light = np.clip(self.line_width / 2 + 0.5 - distance, 0.0, 1.0)
        return self.dark + (1 - self.dark) * light

    def render(self, supersampling: int = 2) -> Float32[ndarray, "h w"]:
        """The pattern as an image in [0, 1]; each pixel is the mean of `supersampling`^2 samples."""
        step = (np.arange(supersampling) + 0.5) / supersampling
        image = np.zeros((self.h, self.w))
        for top in range(0, self.h, _BAND):
            band = image[top : top + _BAND]
            y = top + np.arange(len(band))
            for dy in step:
                for dx in step:
                    band += self.intensity(np.stack(np.meshgrid(np.arange(self.w) + dx, y + dy), -1))
        return (image / supersampling**2).astype(np.float32)

    def fields(self) -> dict[str, Any]:
        """Lengths, codes, and what the codes can correct."""
        return {
            **{key: getattr(self, key) for key in (*_LENGTHS, "seed", "x0", "y0", "rows", "columns")},
            "symbols": list(SYMBOL_NAMES),
            "window": WINDOW,
            "hamming_margin": self.margins[0],
            "hamming_margin_turned": self.margins[1],
            "codes": np.asarray(self.codes).tolist(),
        }

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> "GridPattern":
        """The grid that a pattern.json describes."""
        numbers = {key: number(document, key) for key in _LENGTHS}
        w, h, seed = (whole_number(document, key) for key in ("w", "h", "seed"))
        codes = np.array(document["codes"])
        if codes.dtype.kind != "i" or codes.ndim != 2 or codes.min(initial=0) < 0 or codes.max(initial=0) >= SYMBOLS:
            raise ValueError(f"codes must be rows of whole numbers from 0 to {SYMBOLS - 1}")
        pattern = cls(w=w, h=h, seed=seed, codes=codes.astype(np.int8), **numbers)
        for key in ("rows", "columns", "x0", "y0"):
            if number(document, key) != getattr(pattern, key):
                raise ValueError(f"{key} is {document[key]}, but w, h and period make it {getattr(pattern, key):g}")
        margins = (whole_number(document, key) for key in ("hamming_margin", "hamming_margin_turned"))
        if not is_generated(np.asarray(pattern.codes), seed, *margins):
            raise ValueError(
                f"codes are not those of seed {seed}: with other symbols than those projected, places are confused"
            )
        return pattern

    @cached_property
    def _line_offsets(self) -> tuple[Float[ndarray, "rows s 2"], Float[ndarray, "r columns 2"]]:
        """Offsets at both ends of each segment: segment k of a line runs from node k - 1 to node k.

        At the border of the pattern, where one of the two nodes does not exist, both ends have the other's offset.
        """
        left, right, above, below = np.moveaxis(_OFFSETS[self.codes] * self.gap / 2, -1, 0)
        start = np.concatenate([left[:, :1], right], 1)
        end = np.concatenate([left, right[:, -1:]], 1)
        top = np.concatenate([above[:1], below], 0)
        bottom = np.concatenate([above, below[-1:]], 0)
        return np.stack([start, end], -1), np.stack([top, bottom], -1)


def _along(
    offsets: Float[ndarray, "lines segments 2"], across: Float[ndarray, "*n"], along: Float[ndarray, "*n"]
) -> Float[ndarray, "*n"]:
    """Offset of the nearest line at a point; `across` and `along` count periods from the first node."""
    line = np.clip(np.rint(across), 0, offsets.shape[0] - 1).astype(np.int64)
    segment = np.clip(np.floor(along) + 1, 0, offsets.shape[1] - 1).astype(np.int64)
    t = np.clip(along - (segment - 1), 0.0, 1.0)
    ends = offsets[line, segment]
    return (1 - t) * ends[..., 0] + t * ends[..., 1]
