"""Are coordinates shifted relative to the pattern, for example because pixels are counted from their centres?

The pattern, looked up at the coordinates, must resemble the captured pattern. The shift that makes the two most alike
is estimated from the correlation at five places. Poses are not used.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.scan.problem import Problem

_STEP = 1.0  # px
_PIXELS = 20000  # of a frame that are used
_FEWEST = 500
_ALIKE = 0.6  # correlation below which the pattern is not recognised well enough
_FLAT = 0.002  # change of the correlation over a step below which an axis is undetermined (stripes)
_HALF, _TOLERANCE, _TOLERANCE_FRAME = 0.5, 0.12, 0.25
_MOST = 0.8  # share of the frames that must show the same shift
_FEWEST_FRAMES = 2


def pattern_shift(
    coords: Float32[ndarray, "h w 2"],
    where: Bool[ndarray, "h w"],
    captured: Float32[ndarray, "h w"],
    pattern: Float32[ndarray, "rows columns"],
) -> Float64[ndarray, "2"] | None:
    """What to add to the coordinates of one frame, in pattern pixels, for the best match; None if unclear."""
    chosen = np.flatnonzero(where)
    chosen = chosen[:: max(1, len(chosen) // _PIXELS)]
    if len(chosen) < _FEWEST:
        return None
    uv = coords.reshape(-1, 2)[chosen]
    seen = captured.reshape(-1)[chosen]
    middle = _correlation(pattern, uv, seen)
    shift = np.zeros(2)
    for axis, step in enumerate(np.eye(2, dtype=np.float32) * np.float32(_STEP)):
        before, after = _correlation(pattern, uv - step, seen), _correlation(pattern, uv + step, seen)
        bend = 2 * middle - before - after
        if not (middle > _ALIKE and bend > _FLAT):  # also where a correlation is NaN
            return None
        shift[axis] = _STEP * (after - before) / (2 * bend)  # top of the parabola
    return shift


def shift_problems(shifts: Sequence[Float64[ndarray, "2"] | None]) -> Iterator[Problem]:
    """A shift by half a pixel, the same in all frames: another convention, not a decoding error."""
    known = [shift for shift in shifts if shift is not None]
    if len(known) < _FEWEST_FRAMES:
        return
    middle = np.median(known, axis=0)
    sign = np.copysign(1.0, middle[0])  # np.sign would call a shift of exactly 0 half a pixel
    half = sign * _HALF
    same = np.abs(np.array(known) - half).max(1) < _TOLERANCE_FRAME
    if np.abs(middle - half).max() < _TOLERANCE and same.mean() >= _MOST:
        yield Problem(
            f"are shifted relative to the pattern by half a pixel in x and y, in {same.sum()} of {len(known)} frames",
            "pixel centres are at whole numbers (OpenCV) instead of at .5"
            if sign > 0
            else "half a pixel was added although it was already there",
            f"{'add 0.5 to' if sign > 0 else 'subtract 0.5 from'} both coordinates everywhere",
        )


def _correlation(
    pattern: Float32[ndarray, "rows columns"], uv: Float32[ndarray, "n 2"], seen: Float32[ndarray, "n"]
) -> float:
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(np.corrcoef(look_up(pattern, uv), seen)[0, 1])


def look_up(pattern: Float32[ndarray, "rows columns"], uv: Float32[ndarray, "n 2"]) -> Float32[ndarray, "n"]:
    """Bilinear interpolation; outside, the value at the border."""
    rows, columns = pattern.shape
    x, y = np.clip(uv[:, 0] - 0.5, 0, columns - 1), np.clip(uv[:, 1] - 0.5, 0, rows - 1)
    x0, y0 = np.minimum(x.astype(np.int64), max(columns - 2, 0)), np.minimum(y.astype(np.int64), max(rows - 2, 0))
    x1, y1 = np.minimum(x0 + 1, columns - 1), np.minimum(y0 + 1, rows - 1)
    a, b = x - x0, y - y0
    upper = (1 - a) * pattern[y0, x0] + a * pattern[y0, x1]
    lower = (1 - a) * pattern[y1, x0] + a * pattern[y1, x1]
    return ((1 - b) * upper + b * lower).astype(np.float32)
