"""Does a frame show the pattern where its coordinates say? Poses are not used.

The pattern, looked up at the coordinates, must resemble the captured image. If it resembles it better after a move by
whole pixels, the coordinates are shifted; if it never does, they are of another image, or of none.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray
from scipy.ndimage import uniform_filter

from sl_nerfstudio.scan.check.interpretations import Interpretation
from sl_nerfstudio.scan.check.pattern_shift import look_up

_PIXELS = 20000  # of a frame whose correlation is measured
_FEWEST = 200
_KEPT = 1000  # pixels that are compared with the images of other frames
_OTHER_AXES = tuple(
    Interpretation(swapped=swapped, mirrored_x=x, mirrored_y=y)
    for swapped, x, y in product((False, True), (False, True), (False, True))
    if swapped or x or y
)
_DETAILS = 10  # of a pattern's width: what is larger is no detail
_WINDOW = 256  # side of the square, around the middle of the decoded pixels, in which a move is looked for


@dataclass(frozen=True)
class Prediction:
    """What a frame should show at some of its pixels."""

    rows: Int64[ndarray, "n"]
    columns: Int64[ndarray, "n"]
    values: Float32[ndarray, "n"]

    def correlation(
        self, shown: Float32[ndarray, "h w"], allowed: Bool[ndarray, "h w"], x: int = 0, y: int = 0
    ) -> float:
        """With an image, moved by (x, y) pixels, where `allowed` is True; 0 where too little is left."""
        rows, columns = self.rows + y, self.columns + x
        inside = (rows >= 0) & (rows < shown.shape[0]) & (columns >= 0) & (columns < shown.shape[1])
        inside[inside] = allowed[rows[inside], columns[inside]]
        if inside.sum() < _FEWEST:
            return 0.0
        with np.errstate(invalid="ignore", divide="ignore"):
            found = np.corrcoef(self.values[inside], shown[rows[inside], columns[inside]])[0, 1]
        return float(np.nan_to_num(found))

    def thinned(self, count: int) -> "Prediction":
        """At about `count` of the pixels, without the memory of the others."""
        step = max(1, len(self.rows) // count)
        return Prediction(self.rows[::step].copy(), self.columns[::step].copy(), self.values[::step].copy())


@dataclass(frozen=True)
class ImageMatch:
    """How well one image of a frame shows the pattern at the frame's coordinates."""

    correlation: float
    moved: float  # the same after the best move
    x: int  # the best move of the coordinates, pixels to the right and down
    y: int
    other_axes: Interpretation  # of the coordinates: exchanged or mirrored axes with the largest correlation
    interpreted: float  # that correlation
    prediction: Prediction  # at a few pixels: it is kept of every frame


def has_detail(pattern: Float32[ndarray, "rows columns"]) -> bool:
    """Whether lines or dots make most of a pattern's contrast: shading, and local normalisation, hide the rest."""
    smooth = uniform_filter(pattern, max(pattern.shape) // _DETAILS)
    return bool((pattern - smooth).var() > pattern.var() / 2)


def match_image(
    coords: Float32[ndarray, "h w 2"],
    where: Bool[ndarray, "h w"],
    pattern: Float32[ndarray, "rows columns"],
    shown: Float32[ndarray, "h w"],
    allowed: Bool[ndarray, "h w"],
) -> ImageMatch | None:
    """Compare the pattern at the `coords` of the pixels `where` with what is `shown` at the pixels `allowed`.

    The pattern must have detail. None if too little is decoded, or there is nothing in the image.
    """
    chosen = np.flatnonzero(where)
    if len(chosen) < _FEWEST or not allowed.any() or np.ptp(shown[where]) == 0:
        return None
    expected = np.zeros(where.shape, dtype=np.float32)
    expected[where] = look_up(pattern, coords[where])
    chosen = chosen[:: max(1, len(chosen) // _PIXELS)]
    rows, columns = np.divmod(chosen, where.shape[1])
    prediction = Prediction(rows, columns, expected[rows, columns])
    x, y = _best_move(expected, where, shown, allowed)
    size = (pattern.shape[1], pattern.shape[0])
    uv = coords[rows, columns]
    found = [
        Prediction(rows, columns, look_up(pattern, _interpreted(uv, how, size))).correlation(shown, allowed)
        for how in _OTHER_AXES
    ]
    return ImageMatch(
        correlation=prediction.correlation(shown, allowed),
        moved=prediction.correlation(shown, allowed, x, y),
        x=x,
        y=y,
        other_axes=_OTHER_AXES[int(np.argmax(found))],
        interpreted=max(found),
        prediction=prediction.thinned(_KEPT),
    )


def _interpreted(uv: Float32[ndarray, "n 2"], how: Interpretation, size: tuple[int, int]) -> Float32[ndarray, "n 2"]:
    x, y = uv.T[::-1] if how.swapped else uv.T
    return np.stack([size[0] - x if how.mirrored_x else x, size[1] - y if how.mirrored_y else y], -1)


def _best_move(
    expected: Float32[ndarray, "h w"],
    where: Bool[ndarray, "h w"],
    shown: Float32[ndarray, "h w"],
    allowed: Bool[ndarray, "h w"],
) -> tuple[int, int]:
    """The move (x, y) with the largest cross-correlation, by Fourier transform of a part of the images."""
    part = tuple(_around(np.nonzero(where)[axis], where.shape[axis]) for axis in (0, 1))
    a = np.where(where, expected - expected[where].mean(), np.float32(0))[part]
    b = np.where(allowed, shown - shown[allowed].mean(), np.float32(0))[part]
    size = (2 * a.shape[0], 2 * a.shape[1])  # room for moves in all directions
    together = np.fft.irfft2(np.conj(np.fft.rfft2(a, size)) * np.fft.rfft2(b, size), size)
    row, column = np.divmod(int(np.argmax(together)), size[1])
    y, x = (int(k) if k < n / 2 else int(k) - n for k, n in zip((row, column), size, strict=True))
    return x, y


def _around(places: Int64[ndarray, "n"], size: int) -> slice:
    start = int(np.clip(np.median(places) - _WINDOW // 2, 0, max(size - _WINDOW, 0)))
    return slice(start, start + _WINDOW)
