"""Coordinates measured in one image: the predicted pattern is moved until it agrees with what was captured."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.redecoding.ambiguity import Ambiguity
from sl_nerfstudio.redecoding.correlation import Fit, View, Window, correlations, drawn, fit_shifts

SEARCHED = 0.45  # pitches to both sides along the line on which a wrong depth moves a coordinate
_STEP = 1 / 16  # pitch
_NARROW, _WIDE = 0.45, 0.9  # standard deviations of the windows for the place, and for what it can be confused with
_CONVERGED = 0.1  # pitch: a search with a longer last step found nothing
_SAMPLES = 7  # pixels per pitch that tell places apart


@dataclass(frozen=True)
class Shown:
    """A pattern as a camera shows it."""

    pattern: Float32[ndarray, "ph pw"]  # blurred as in the image
    ambiguity: Ambiguity
    pitch_px: float  # the ambiguity's pitch in camera pixels


@dataclass(frozen=True)
class Measured:
    """What was found at some pixels; lengths in pattern pixels."""

    places: Int64[ndarray, "n 2"]  # row, column
    coords: Float32[ndarray, "n 2"]
    along: Float32[ndarray, "n"]  # from the prediction, as a wrong depth would move it
    across: Float32[ndarray, "n"]  # from the prediction, as no wrong depth would move it
    correlation: Float32[ndarray, "n"]  # of image and pattern
    margin: Float32[ndarray, "n"]  # by which that is larger than at places with which this one can be confused
    roughness: Float32[ndarray, "n"]  # distance from the mean displacement in a window around it
    covered: Float32[ndarray, "n"]  # share of the window on the surface
    step: Float32[ndarray, "n"]  # the last one of the search
    sigma: Float32[ndarray, "n"]  # 1 sigma in the worse direction


def measure(view: View, along: Float32[ndarray, "h w 2"], shown: Shown, places: Int64[ndarray, "n 2"]) -> Measured:
    """Find the pattern around its predicted place, about each of the given pixels, which must be usable."""
    pitch, rows, columns = shown.ambiguity.pitch, *places.T
    narrow = Window.gaussian(_NARROW * shown.pitch_px)
    shifts = np.arange(-SEARCHED, SEARCHED + _STEP / 2, _STEP, dtype=np.float32) * np.float32(pitch)
    candidates = np.dstack([drawn(shown.pattern, view.coords + s * along) for s in shifts])
    some = Window.gaussian(_NARROW * shown.pitch_px, _stride(shown))
    best = correlations(view, candidates, places, some).argmax(1)
    direction = along[rows, columns]
    fit = fit_shifts(view, shown.pattern, places, shifts[best, None] * direction, narrow)
    mean = _spread(view, places, fit, _NARROW * shown.pitch_px, pitch)
    return Measured(
        places=places,
        coords=view.coords[rows, columns] + fit.shift,
        along=(fit.shift * direction).sum(1),
        across=fit.shift[:, 0] * direction[:, 1] - fit.shift[:, 1] * direction[:, 0],
        correlation=fit.correlation,
        margin=_margins(view, shown, places, fit.shift, mean),
        roughness=np.linalg.norm(fit.shift - mean[rows, columns], axis=1),
        covered=fit.covered,
        step=fit.step,
        sigma=fit.sigma,
    )


def correlation_at(
    view: View, shown: Shown, places: Int64[ndarray, "n 2"], coords: Float32[ndarray, "n 2"]
) -> Float32[ndarray, "n"]:
    """Correlation of image and pattern if the given coordinates were right."""
    start = coords - view.coords[places[:, 0], places[:, 1]]
    return fit_shifts(view, shown.pattern, places, start, Window.gaussian(_NARROW * shown.pitch_px), 0).correlation


def _margins(
    view: View,
    shown: Shown,
    places: Int64[ndarray, "n 2"],
    shift: Float32[ndarray, "n 2"],
    mean: Float32[ndarray, "h w 2"],
) -> Float32[ndarray, "n"]:
    """Correlation in a wide window, less the largest at displacements by which the pattern resembles itself."""
    rivals = shown.ambiguity.rivals
    if not len(rivals):
        return np.ones(len(places), dtype=np.float32)
    moved = view.coords + mean
    moved[places[:, 0], places[:, 1]] = view.coords[places[:, 0], places[:, 1]] + shift
    candidates = np.dstack([drawn(shown.pattern, moved + d) for d in (np.zeros(2, dtype=np.float32), *rivals)])
    wide = Window.gaussian(_WIDE * shown.pitch_px, _stride(shown))
    found = correlations(view, candidates, places, wide)
    return found[:, 0] - found[:, 1:].max(1)


def _stride(shown: Shown) -> int:
    """Every how many pixels are enough to tell places apart; for their exact position all pixels are used."""
    return max(1, round(shown.pitch_px / _SAMPLES))


def _spread(
    view: View, places: Int64[ndarray, "n 2"], fit: Fit, sigma: float, pitch: float
) -> Float32[ndarray, "h w 2"]:
    """Displacements at all pixels: Gaussian means of those at which the search converged."""
    good = fit.step < _CONVERGED * pitch
    rows, columns = places[good].T
    sums = np.zeros((*view.depth.shape, 3), dtype=np.float32)
    sums[rows, columns] = np.concatenate([fit.shift[good], np.ones((len(rows), 1), dtype=np.float32)], 1)
    sums = np.dstack([gaussian_filter(sums[..., k], sigma, truncate=3.0) for k in range(3)])
    return sums[..., :2] / np.maximum(sums[..., 2:], 1e-6)
