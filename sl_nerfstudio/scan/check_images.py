"""Do coordinates belong to the pattern and to the image? Shifted ones, those of another frame, or of no image."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray
from scipy.ndimage import uniform_filter

from sl_nerfstudio.scan.check_conventions import OTHER_AXES, Interpretation, converted_coords, describe_coords
from sl_nerfstudio.scan.document import Problem

# Are coordinates shifted relative to the pattern, for example because pixels are counted from their centres?
#
# The pattern, looked up at the coordinates, must resemble the captured pattern. The shift that makes the two most alike
# is estimated from the correlation at five places. Poses are not used.

_STEP = 1.0  # px
_PIXELS = 20000  # of a frame that are used
_FEWEST_SHIFTED = 500
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
    """Measure the shift to add to one frame's coordinates, in pattern pixels, for the best match; None if unclear."""
    chosen = np.flatnonzero(where)
    chosen = chosen[:: max(1, len(chosen) // _PIXELS)]
    if len(chosen) < _FEWEST_SHIFTED:
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
        cause, remedy = "half a pixel was added although it was already there", "subtract 0.5 from"
        if sign > 0:
            cause, remedy = "pixel centres are at whole numbers (OpenCV) instead of at .5", "add 0.5 to"
        yield Problem(
            f"are shifted relative to the pattern by half a pixel in x and y, in {same.sum()} of {len(known)} frames",
            cause,
            f"{remedy} both coordinates everywhere",
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


# Does a frame show the pattern where its coordinates say? Poses are not used.
#
# The pattern, looked up at the coordinates, must resemble the captured image. If it resembles it better after a move by
# whole pixels, the coordinates are shifted; if it never does, they are of another image, or of none.

_FEWEST_COMPARED = 200
_KEPT = 1000  # pixels that are compared with the images of other frames

_DETAILS = 10  # of a pattern's width: what is larger is no detail
_WINDOW = 256  # side of the square, around the middle of the decoded pixels, in which a move is looked for


@dataclass(frozen=True)
class ImagePrediction:
    """Prediction of a frame's image at some of its pixels."""

    rows: Int64[ndarray, "n"]
    columns: Int64[ndarray, "n"]
    values: Float32[ndarray, "n"]

    def correlation(
        self, shown: Float32[ndarray, "h w"], allowed: Bool[ndarray, "h w"], x: int = 0, y: int = 0
    ) -> float:
        """Correlation with an image, moved by (x, y) pixels, where `allowed` is True; 0 where too little is left."""
        rows, columns = self.rows + y, self.columns + x
        inside = (rows >= 0) & (rows < shown.shape[0]) & (columns >= 0) & (columns < shown.shape[1])
        inside[inside] = allowed[rows[inside], columns[inside]]
        if inside.sum() < _FEWEST_COMPARED:
            return 0.0
        with np.errstate(invalid="ignore", divide="ignore"):
            found = np.corrcoef(self.values[inside], shown[rows[inside], columns[inside]])[0, 1]
        return float(np.nan_to_num(found))

    def thinned(self, count: int) -> "ImagePrediction":
        """Copy about `count` of the pixels, without the memory of the others."""
        step = max(1, len(self.rows) // count)
        return ImagePrediction(self.rows[::step].copy(), self.columns[::step].copy(), self.values[::step].copy())


@dataclass(frozen=True)
class ImageMatch:
    """Correlation of one image of a frame with the pattern at the frame's coordinates."""

    correlation: float
    moved: float  # the same after the best move
    x: int  # the best move of the coordinates, pixels to the right and down
    y: int
    other_axes: Interpretation  # of the coordinates: exchanged or mirrored axes with the largest correlation
    interpreted: float  # that correlation
    prediction: ImagePrediction  # at a few pixels: it is kept of every frame


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
    if len(chosen) < _FEWEST_COMPARED or not allowed.any() or np.ptp(shown[where]) == 0:
        return None
    expected = np.zeros(where.shape, dtype=np.float32)
    expected[where] = look_up(pattern, coords[where])
    chosen = chosen[:: max(1, len(chosen) // _PIXELS)]
    rows, columns = np.divmod(chosen, where.shape[1])
    prediction = ImagePrediction(rows, columns, expected[rows, columns])
    x, y = _best_move(expected, where, shown, allowed)
    size = (pattern.shape[1], pattern.shape[0])
    uv = coords[rows, columns]
    found = [
        ImagePrediction(rows, columns, look_up(pattern, converted_coords(uv, how, size))).correlation(shown, allowed)
        for how in OTHER_AXES
    ]
    return ImageMatch(
        correlation=prediction.correlation(shown, allowed),
        moved=prediction.correlation(shown, allowed, x, y),
        x=x,
        y=y,
        other_axes=OTHER_AXES[int(np.argmax(found))],
        interpreted=max(found),
        prediction=prediction.thinned(_KEPT),
    )


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


# Correlations. Right frames have 0.5 to 0.95, or little in all frames (coarse images, stripes in another light).
CLEAR = 0.4  # from here on, the pattern is recognised
_GAIN = 0.05  # of a move from there on: right frames gain nothing, and one pixel costs at least this
_FAINT, _LARGE_GAIN = 0.25, 0.15  # the same for images too coarse to show the pattern well
_RESTORED = 0.6  # share of the better frames' correlation that the right move gives back; a wrong one gives less
_NOTHING = 0.25  # share of the better frames' correlation below which a frame does not show the pattern at all
_OTHERS_GAIN = 0.3  # by which the coordinates fit the image of another frame better than their own
_AXES_GAIN = 0.1  # by which they fit with exchanged or mirrored axes: grids look alike, so it is less
_BETTER = 0.75  # quantile of the frames to which the others are compared


Shown = tuple[Float32[ndarray, "h w"], Bool[ndarray, "h w"]]
"""An image, and where it shows the object."""


def image_problems(
    matches: Mapping[str, ImageMatch | None], read_shown: Callable[[str], Shown | None]
) -> Iterator[tuple[str, Problem]]:
    """(frame, problem) of coordinates that do not belong to the image; `read_shown` gives the image of a frame.

    `matches` says by the frame's name how well its image fits; None if it could not be compared.
    """
    known = {name: match for name, match in matches.items() if match is not None}
    usual = float(np.quantile([match.correlation for match in known.values()], _BETTER)) if known else 0.0
    strange = {name: match for name, match in known.items() if match.correlation < max(_NOTHING * usual, CLEAR / 2)}
    others = _fitting_others(strange, matches, read_shown)
    for name, match in known.items():
        other = others.get(name, ("", 0.0))
        if _is_shifted(match, usual) and match.moved > other[1]:
            yield name, _shifted(match)
        elif match.interpreted >= CLEAR and match.interpreted - match.correlation >= _AXES_GAIN:
            yield name, _other_axes(match)
        elif other[0]:
            yield name, _of_another_frame(match, *other)
        elif usual >= CLEAR and match.correlation < _NOTHING * usual:
            yield name, _of_no_image(match, usual)


def _is_shifted(match: ImageMatch, usual: float) -> bool:
    gain = match.moved - match.correlation
    enough = (match.moved >= CLEAR and gain >= _GAIN) or (match.moved >= _FAINT and gain >= _LARGE_GAIN)
    return (match.x, match.y) != (0, 0) and enough and match.moved >= _RESTORED * usual


def _fitting_others(
    strange: dict[str, ImageMatch], names: Iterable[str], read_shown: Callable[[str], Shown | None]
) -> dict[str, tuple[str, float]]:
    """Find for each frame another one whose image its coordinates fit, with the correlation; read each image once."""
    found: dict[str, tuple[str, float]] = {}
    for other in names if strange else ():
        shown = read_shown(other)
        if shown is None:
            continue
        for name, match in strange.items():
            correlation = 0.0 if name == other else match.prediction.correlation(*shown)
            enough = max(CLEAR, match.correlation + _OTHERS_GAIN)
            if correlation >= max(enough, found.get(name, ("", 0.0))[1]):
                found[name] = (other, correlation)
    return found


def _shifted(match: ImageMatch) -> Problem:
    return Problem(
        f"is shifted against the image: moved by {match.x} pixels to the right and {match.y} down it fits (correlation "
        f"with the pattern {match.moved:.2f} instead of {match.correlation:.2f})",
        "image or coordinates were cropped, padded or rolled after decoding",
        "give the image from which the coordinates were decoded, or decode it again",
    )


def _other_axes(match: ImageMatch) -> Problem:
    return describe_coords(
        match.other_axes,
        f"do not fit the image in this frame (correlation with the pattern {match.correlation:.2f}, otherwise "
        f"{match.interpreted:.2f})",
    )


def _of_another_frame(match: ImageMatch, other: str, correlation: float) -> Problem:
    return Problem(
        f"fits the image of frame {other} instead (correlation with the pattern {correlation:.2f}, with its own image "
        f"{match.correlation:.2f})",
        "files were renamed or mixed up",
        "give the coordinates that were decoded from this frame's image",
    )


def _of_no_image(match: ImageMatch, usual: float) -> Problem:
    return Problem(
        f"does not fit the image: correlation with the pattern {match.correlation:.2f}, in other frames {usual:.2f}",
        "the coordinates are noise, transposed, or those of another image, or the image is another one",
        "decode the image again, or leave the frame out",
    )
