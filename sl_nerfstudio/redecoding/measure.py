"""Coordinates measured in one image: the predicted pattern is moved until it agrees with what was captured."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray
from scipy.ndimage import gaussian_filter, maximum_filter

from sl_nerfstudio.decoding.decoder import Coords, Layer, Mask
from sl_nerfstudio.parallel import compiled, compiled_range

# Correlation of an image with a pattern in a window about each pixel, on one surface, whatever gain and offset.
#
# A window holds the pixels that lie on the same surface as its centre: a depth that differs by more than a steep
# surface would is another surface. The pattern is looked up at predicted coordinates, which bend and foreshorten it as
# the surface does; what is left is one displacement for the whole window.

STEEPEST = 6.0  # pixel widths of depth from one pixel to the next on one surface: seen at 9 degrees from its plane
_ROUNDS = 4
_ENOUGH = 0.01  # pattern pixels: a shorter step ends the search
_REACH = 2.0  # of a Gaussian window, standard deviations


@dataclass(frozen=True)
class PatternView:
    """One image, and what is predicted for its pixels."""

    image: Layer
    coords: Coords  # predicted, pattern pixels; only those that `usable` allows are read
    depth: Layer  # in pixel widths (see Prediction)
    usable: Mask  # on a predicted surface, and in the part of the image that shows the pattern


@dataclass(frozen=True)
class CorrelationWindow:
    """A Gaussian window: weights of every `stride`-th pixel about its centre."""

    offsets: Int64[ndarray, "k 2"]  # row, column
    weights: Float32[ndarray, "k"]

    @staticmethod
    def gaussian(sigma: float, stride: int = 1) -> "CorrelationWindow":
        """Up to two standard deviations; `sigma` in pixels."""
        reach = max(int(_REACH * sigma) // stride, 1)
        dy, dx = (stride * np.mgrid[-reach : reach + 1, -reach : reach + 1]).reshape(2, -1)
        distance = np.hypot(dy, dx)
        inside = distance <= max(_REACH * sigma, stride)
        weights = np.exp(-0.5 * (distance[inside] / sigma) ** 2)
        offsets = np.stack([dy[inside], dx[inside]], 1)
        return CorrelationWindow(offsets.astype(np.int64), (weights / weights.sum()).astype(np.float32))


@dataclass(frozen=True)
class Fit:
    """The displacement of the pattern that agrees best with the image, at some pixels."""

    shift: Float32[ndarray, "n 2"]  # to add to the predicted coordinate, pattern pixels
    correlation: Float32[ndarray, "n"]  # at this displacement
    covered: Float32[ndarray, "n"]  # share of the window that could be used
    step: Float32[ndarray, "n"]  # length of the last step: large where the search has not converged
    sigma: Float32[ndarray, "n"]  # 1 sigma in the worse direction, from what gain, offset and shift leave unexplained


def drawn(pattern: Float32[ndarray, "ph pw"], coords: Coords) -> Layer:
    """The pattern looked up at coordinates, bilinearly; the value at the border where they are outside or NaN."""
    place = np.nan_to_num(coords - np.float32(0.5))
    return cv2.remap(pattern, place[..., 0].copy(), place[..., 1].copy(), cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)


def correlations(
    view: PatternView, candidates: Float32[ndarray, "h w k"], places: Int64[ndarray, "n 2"], window: CorrelationWindow
) -> Float32[ndarray, "n k"]:
    """Correlation of the image with each of k pictures in the window about each place (row, column); 0 if undefined."""
    out = np.zeros((len(places), candidates.shape[2]), dtype=np.float32)
    _correlate(
        len(places), view.image, candidates, view.depth, view.usable, places, window.offsets, window.weights, out
    )
    return out


def fit_shifts(
    view: PatternView,
    pattern: Float32[ndarray, "ph pw"],
    places: Int64[ndarray, "n 2"],
    start: Float32[ndarray, "n 2"],
    window: CorrelationWindow,
    rounds: int = _ROUNDS,
) -> Fit:
    """Displacement of each window by least squares, with gain and offset unknown (Lucas and Kanade 1981).

    With `rounds` 0 the correlation at `start` is measured.
    """
    by_x, by_y = cv2.Sobel(pattern, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(pattern, cv2.CV_32F, 0, 1, scale=1 / 8)
    layers = np.ascontiguousarray(np.dstack([pattern, by_x, by_y]))
    out = np.zeros((len(places), 6), dtype=np.float32)
    out[:, :2] = start
    _fit(len(places), view.image, view.coords, view.depth, view.usable, layers, places, window.offsets, window.weights,
         rounds, out)  # fmt: skip
    return Fit(out[:, :2], out[:, 2], out[:, 3], out[:, 4], out[:, 5])


@compiled_range
def _correlate(
    first: int, last: int, image: ndarray, candidates: ndarray, depth: ndarray, usable: ndarray, places: ndarray,
    offsets: ndarray, weights: ndarray, out: ndarray,
) -> None:  # fmt: skip
    h, w, k = candidates.shape
    p, pp, ip = np.zeros(k, dtype=np.float32), np.zeros(k, dtype=np.float32), np.zeros(k, dtype=np.float32)
    for n in range(first, last):
        row, column = places[n, 0], places[n, 1]
        p[:], pp[:], ip[:] = 0, 0, 0
        one, i1, ii = np.float32(0), np.float32(0), np.float32(0)
        for m in range(len(offsets)):
            dy, dx = offsets[m, 0], offsets[m, 1]
            y, x = row + dy, column + dx
            if y < 0 or x < 0 or y >= h or x >= w or not usable[y, x]:
                continue
            if abs(depth[y, x] - depth[row, column]) > STEEPEST * depth[row, column] * np.sqrt(dy * dy + dx * dx):
                continue
            weight, i = weights[m], image[y, x]
            one += weight
            i1 += weight * i
            ii += weight * i * i
            for c in range(k):
                value = candidates[y, x, c]
                p[c] += weight * value
                pp[c] += weight * value * value
                ip[c] += weight * i * value
        if one <= 0:
            continue
        for c in range(k):
            variance = (ii / one - (i1 / one) ** 2) * (pp[c] / one - (p[c] / one) ** 2)
            if variance > 1e-10:
                out[n, c] = (ip[c] / one - i1 / one * p[c] / one) / np.sqrt(variance)


@compiled
def _sums(
    image: ndarray, coords: ndarray, depth: ndarray, usable: ndarray, layers: ndarray, row: int, column: int,
    sx: float, sy: float, offsets: ndarray, weights: ndarray, s: ndarray,
) -> None:  # fmt: skip
    """Fill `s` with weighted sums: 1, i, ii, p, pp, ip, x, y, xx, xy, yy, px, py, ix, iy of image, pattern, slopes."""
    h, w = image.shape
    s[:] = 0.0
    for m in range(len(offsets)):
        dy, dx = offsets[m, 0], offsets[m, 1]
        y, x = row + dy, column + dx
        if y < 0 or x < 0 or y >= h or x >= w or not usable[y, x]:
            continue
        if abs(depth[y, x] - depth[row, column]) > STEEPEST * depth[row, column] * np.sqrt(dy * dy + dx * dx):
            continue
        u = min(max(coords[y, x, 0] + sx - 0.5, 0.0), layers.shape[1] - 1.001)
        v = min(max(coords[y, x, 1] + sy - 0.5, 0.0), layers.shape[0] - 1.001)
        u0, v0 = int(u), int(v)
        a, b = u - u0, v - v0
        p = (1 - b) * ((1 - a) * layers[v0, u0, 0] + a * layers[v0, u0 + 1, 0])
        p += b * ((1 - a) * layers[v0 + 1, u0, 0] + a * layers[v0 + 1, u0 + 1, 0])
        px = (1 - b) * ((1 - a) * layers[v0, u0, 1] + a * layers[v0, u0 + 1, 1])
        px += b * ((1 - a) * layers[v0 + 1, u0, 1] + a * layers[v0 + 1, u0 + 1, 1])
        py = (1 - b) * ((1 - a) * layers[v0, u0, 2] + a * layers[v0, u0 + 1, 2])
        py += b * ((1 - a) * layers[v0 + 1, u0, 2] + a * layers[v0 + 1, u0 + 1, 2])
        t, i = weights[m], image[y, x]
        s[0] += t
        s[1] += t * i
        s[2] += t * i * i
        s[3] += t * p
        s[4] += t * p * p
        s[5] += t * i * p
        s[6] += t * px
        s[7] += t * py
        s[8] += t * px * px
        s[9] += t * px * py
        s[10] += t * py * py
        s[11] += t * p * px
        s[12] += t * p * py
        s[13] += t * i * px
        s[14] += t * i * py
        s[15] += t * t


@compiled_range
def _fit(
    first: int, last: int, image: ndarray, coords: ndarray, depth: ndarray, usable: ndarray, layers: ndarray,
    places: ndarray, offsets: ndarray, weights: ndarray, rounds: int, out: ndarray,
) -> None:  # fmt: skip
    s = np.zeros(16)
    for n in range(first, last):
        row, column = places[n, 0], places[n, 1]
        sx, sy, step, sigma = float(out[n, 0]), float(out[n, 1]), 0.0, np.inf
        correlation, covered = 0.0, 0.0
        for turn in range(rounds + 1):
            _sums(image, coords, depth, usable, layers, row, column, sx, sy, offsets, weights, s)
            covered = s[0]
            if covered <= 0:
                break
            i, p, x, y = s[1] / s[0], s[3] / s[0], s[6] / s[0], s[7] / s[0]
            ii, pp, ip = s[2] / s[0] - i * i, s[4] / s[0] - p * p, s[5] / s[0] - i * p
            if ii * pp < 1e-10:
                correlation, sigma = 0.0, np.inf
                break
            correlation = ip / np.sqrt(ii * pp)
            # i = offset + gain (p + x sx + y sy): gain and offset are eliminated
            xp, yp = s[11] / s[0] - x * p, s[12] / s[0] - y * p
            xx = s[8] / s[0] - x * x - xp * xp / pp
            xy = s[9] / s[0] - x * y - xp * yp / pp
            yy = s[10] / s[0] - y * y - yp * yp / pp
            ix, iy = s[13] / s[0] - i * x - xp * ip / pp, s[14] / s[0] - i * y - yp * ip / pp
            gain, det = ip / pp, xx * yy - xy * xy
            least = 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4 * xy * xy))
            if gain <= 0 or least <= 1e-12:
                sigma = np.inf
                break
            noise = max(ii - ip * ip / pp, 0.0) * s[15] / (s[0] * s[0])  # variance of a weighted mean
            sigma = np.sqrt(noise / least) / gain
            if turn == rounds or (turn > 0 and step < _ENOUGH):
                break
            mx, my = (yy * ix - xy * iy) / (det * gain), (xx * iy - xy * ix) / (det * gain)
            step = np.sqrt(mx * mx + my * my)
            shorter = min(1.0, 2.0 / max(step, 1e-12))  # the pattern is linear over no more than its lines' width
            sx, sy = sx + shorter * mx, sy + shorter * my
        out[n, 0], out[n, 1], out[n, 2], out[n, 3], out[n, 4], out[n, 5] = sx, sy, correlation, covered, step, sigma


# Where a pattern resembles itself: how large a window must be, and with what a place can be confused.

_ALIKE = 0.25  # autocorrelation of a place that can be confused
_RIVAL_REACH = 2.6  # distances of the nearest such place within which others are compared
_MOST_RIVALS, _MOST_DECOYS = 24, 8  # stripes resemble themselves everywhere along themselves
_LOBE_PITCH = 6.0  # widths of the main lobe that count as the distance if there is no such place


@dataclass(frozen=True)
class Ambiguity:
    """Displacements at which a pattern looks nearly the same; pattern pixels."""

    pitch: float  # distance of the nearest one: the period of a grid
    rivals: Float32[ndarray, "r 2"]  # all within a few pitches
    decoys: Float32[ndarray, "d 2"]  # some farther away: no right coordinate is displaced by them

    @staticmethod
    def of(pattern: Layer) -> "Ambiguity":
        """Find the displacements from the autocorrelation of the whole pattern."""
        h, w = pattern.shape
        alike = _autocorrelation(pattern)
        y, x = np.mgrid[: alike.shape[0], : alike.shape[1]]
        y, x = y - h // 2, x - w // 2
        distance = np.hypot(y, x)
        lobe = max(float(distance[alike < 0.5].min(initial=max(h, w))), 1.0)
        side = 2 * int(np.ceil(lobe)) + 1
        peak = (alike >= maximum_filter(alike, side)) & (alike > _ALIKE) & (distance > 1.5 * lobe)
        pitch = float(distance[peak].min(initial=np.inf))
        if not np.isfinite(pitch):
            pitch = _LOBE_PITCH * lobe
        found = np.stack([x[peak], y[peak]], 1).astype(np.float32)
        far = distance[peak]
        near = np.flatnonzero(far < _RIVAL_REACH * pitch)
        strongest = np.argsort(-alike[peak][near], kind="stable")[:_MOST_RIVALS]
        rivals = found[near[np.sort(strongest)]]
        decoys = found[(far > 1.2 * _RIVAL_REACH * pitch) & (far < 2.2 * _RIVAL_REACH * pitch)]
        decoys = decoys[:: max(1, -(-len(decoys) // _MOST_DECOYS))]
        if not len(decoys):
            angle = np.arange(8) * np.pi / 4
            decoys = (1.7 * _RIVAL_REACH * pitch * np.stack([np.cos(angle), np.sin(angle)], 1)).astype(np.float32)
        return Ambiguity(pitch, rivals, decoys)


def _autocorrelation(pattern: Layer) -> Float64[ndarray, "h w"]:
    """Autocorrelation at displacements up to half the pattern's size; zero displacement is at (h // 2, w // 2)."""
    h, w = pattern.shape
    one = np.fft.rfft2(np.ones_like(pattern), (2 * h, 2 * w))
    centred = np.fft.rfft2(pattern - pattern.mean(), (2 * h, 2 * w))
    total, count = (np.fft.irfft2(np.abs(f) ** 2, (2 * h, 2 * w)) for f in (centred, one))
    rows, columns = np.arange(h) - h // 2, np.arange(w) - w // 2
    part = np.ix_(rows, columns)
    mean = total[part] / np.maximum(count[part], 1)
    return mean / max(float(mean[h // 2, w // 2]), 1e-30)


SEARCHED = 0.45  # pitches to both sides along the line on which a wrong depth moves a coordinate
_STEP = 1 / 16  # pitch
_NARROW, _WIDE = 0.45, 0.9  # standard deviations of the windows for the place, and for what it can be confused with
_CONVERGED = 0.1  # pitch: a search with a longer last step found nothing
_SAMPLES = 7  # pixels per pitch that tell places apart


@dataclass(frozen=True)
class ShownPattern:
    """A pattern as a camera shows it."""

    pattern: Float32[ndarray, "ph pw"]  # blurred as in the image
    ambiguity: Ambiguity
    pitch_px: float  # the ambiguity's pitch in camera pixels


@dataclass(frozen=True)
class Measured:
    """Measurements at some pixels; lengths in pattern pixels."""

    places: Int64[ndarray, "n 2"]  # row, column
    coords: Float32[ndarray, "n 2"]
    across: Float32[ndarray, "n"]  # from the prediction, as no wrong depth would move it
    correlation: Float32[ndarray, "n"]  # of image and pattern
    margin: Float32[ndarray, "n"]  # by which that is larger than at places with which this one can be confused
    roughness: Float32[ndarray, "n"]  # distance from the mean displacement in a window around it
    covered: Float32[ndarray, "n"]  # share of the window on the surface
    step: Float32[ndarray, "n"]  # the last one of the search
    sigma: Float32[ndarray, "n"]  # 1 sigma in the worse direction


def measure(view: PatternView, along: Coords, shown: ShownPattern, places: Int64[ndarray, "n 2"]) -> Measured:
    """Find the pattern around its predicted place, about each of the given pixels, which must be usable."""
    pitch, rows, columns = shown.ambiguity.pitch, *places.T
    narrow = CorrelationWindow.gaussian(_NARROW * shown.pitch_px)
    shifts = np.arange(-SEARCHED, SEARCHED + _STEP / 2, _STEP, dtype=np.float32) * np.float32(pitch)
    candidates = np.dstack([drawn(shown.pattern, view.coords + s * along) for s in shifts])
    some = CorrelationWindow.gaussian(_NARROW * shown.pitch_px, _stride(shown))
    best = correlations(view, candidates, places, some).argmax(1)
    direction = along[rows, columns]
    fit = fit_shifts(view, shown.pattern, places, shifts[best, None] * direction, narrow)
    mean = _spread(view, places, fit, _NARROW * shown.pitch_px, pitch)
    return Measured(
        places=places,
        coords=view.coords[rows, columns] + fit.shift,
        across=fit.shift[:, 0] * direction[:, 1] - fit.shift[:, 1] * direction[:, 0],
        correlation=fit.correlation,
        margin=_margins(view, shown, places, fit.shift, mean),
        roughness=np.linalg.norm(fit.shift - mean[rows, columns], axis=1),
        covered=fit.covered,
        step=fit.step,
        sigma=fit.sigma,
    )


def correlation_at(
    view: PatternView, shown: ShownPattern, places: Int64[ndarray, "n 2"], coords: Float32[ndarray, "n 2"]
) -> Float32[ndarray, "n"]:
    """Correlation of image and pattern if the given coordinates were right."""
    start = coords - view.coords[places[:, 0], places[:, 1]]
    return fit_shifts(
        view, shown.pattern, places, start, CorrelationWindow.gaussian(_NARROW * shown.pitch_px), 0
    ).correlation


def _margins(
    view: PatternView, shown: ShownPattern, places: Int64[ndarray, "n 2"], shift: Float32[ndarray, "n 2"], mean: Coords
) -> Float32[ndarray, "n"]:
    """Correlation in a wide window, less the largest at displacements by which the pattern resembles itself."""
    rivals = shown.ambiguity.rivals
    if not len(rivals):
        return np.ones(len(places), dtype=np.float32)
    moved = view.coords + mean
    moved[places[:, 0], places[:, 1]] = view.coords[places[:, 0], places[:, 1]] + shift
    candidates = np.dstack([drawn(shown.pattern, moved + d) for d in (np.zeros(2, dtype=np.float32), *rivals)])
    wide = CorrelationWindow.gaussian(_WIDE * shown.pitch_px, _stride(shown))
    found = correlations(view, candidates, places, wide)
    return found[:, 0] - found[:, 1:].max(1)


def _stride(shown: ShownPattern) -> int:
    """Every how many pixels are enough to tell places apart; for their exact position all pixels are used."""
    return max(1, round(shown.pitch_px / _SAMPLES))


def _spread(view: PatternView, places: Int64[ndarray, "n 2"], fit: Fit, sigma: float, pitch: float) -> Coords:
    """Displacements at all pixels: Gaussian means of those at which the search converged."""
    good = fit.step < _CONVERGED * pitch
    rows, columns = places[good].T
    sums = np.zeros((*view.depth.shape, 3), dtype=np.float32)
    sums[rows, columns] = np.concatenate([fit.shift[good], np.ones((len(rows), 1), dtype=np.float32)], 1)
    sums = np.dstack([gaussian_filter(sums[..., k], sigma, truncate=3.0) for k in range(3)])
    return sums[..., :2] / np.maximum(sums[..., 2:], 1e-6)


# Which measured coordinates are accepted: limits learnt from the pixels of the frame that were decoded before.
#
# Where the decoder and the image agree, it is known what a right match looks like in this frame. What a wrong one looks
# like is seen by looking for the pattern where it certainly is not.

AGREES = 1 / 6  # pitch: decoded and measured coordinates that differ less are the same
_FEWEST = 200  # decoded pixels that agree, to learn from
_LEAST_SHARE = 0.5  # of the decoded pixels must agree
_RIGHT, _WRONG = 0.05, 0.9  # quantiles of right matches, and of those at a wrong place, below which none is accepted
FALSE = 0.01  # share of the accepted pixels that may be chance, if all predictions were wrong
_ROUGH = 0.95  # quantile of the roughness of right matches
_ACROSS = 0.98  # quantile of their displacement across the line on which a wrong depth would move them
_SIGMA = 0.0075  # pitch: 0.15 pixels of a grid with a period of 20
_CONVERGED_STEP = 0.005  # pitch: a search whose last step is longer has not converged
_COVERED = 0.5  # share of the window that must be on the surface


@dataclass(frozen=True)
class AcceptanceLimits:
    """Limits for accepting a coordinate; lengths in pattern pixels."""

    correlation: float  # least
    margin: float  # least
    roughness: float  # largest: distance from the mean displacement around it
    across: float  # largest
    sigma: float  # largest
    step: float  # largest

    def accept(self, found: Measured) -> Bool[ndarray, "n"]:
        """The coordinates that fulfil all."""
        return (
            (found.correlation >= self.correlation)
            & (found.margin >= self.margin)
            & (found.roughness <= self.roughness)
            & (np.abs(found.across) <= self.across)
            & (found.sigma <= self.sigma)
            & (found.step <= self.step)
            & (found.covered >= _COVERED)
        )


def confirmed(found: Measured, decoded: Float32[ndarray, "n 2"], pitch: float) -> Bool[ndarray, "n"]:
    """Pixels whose decoded coordinate (NaN: none) the image shows, too, and sharply enough to say so."""
    near = np.abs(found.coords - decoded).max(1) < AGREES * pitch  # False for NaN
    return near & (found.sigma <= 2 * _SIGMA * pitch) & (found.covered >= _COVERED)


def learn(
    found: Measured,
    right: Bool[ndarray, "n"],
    unknown: Bool[ndarray, "n"],
    decoded: int,
    elsewhere: Measured,
    pitch: float,
) -> AcceptanceLimits | None:
    """Limits from the `right` ones of the measured pixels, and from those measured at wrong places.

    `unknown` are the measured pixels without a coordinate, `decoded` is the number of those with one that were to be
    confirmed. None if too few of these are right, or if right places look no better than wrong ones: then the image
    does not show this pattern at these places.
    """
    if right.sum() < max(_FEWEST, _LEAST_SHARE * decoded):
        return None
    wrong = np.quantile(elsewhere.correlation, _WRONG)
    if np.median(found.correlation[right]) <= wrong:
        return None
    margin = max(float(np.quantile(found.margin[right], _RIGHT)), float(np.quantile(elsewhere.margin, _WRONG)), 0.0)
    limits = AcceptanceLimits(
        correlation=max(float(np.quantile(found.correlation[right], _RIGHT)), float(wrong)),
        margin=margin,
        roughness=float(np.quantile(found.roughness[right], _ROUGH)),
        across=float(np.quantile(np.abs(found.across[right]), _ACROSS)),
        sigma=_SIGMA * pitch,
        step=_CONVERGED_STEP * pitch,
    )
    return _strict_enough(limits, found.margin[unknown & limits.accept(found)], int(unknown.sum()), elsewhere)


def _strict_enough(
    limits: AcceptanceLimits, accepted: Float32[ndarray, "a"], of: int, elsewhere: Measured
) -> AcceptanceLimits:
    """Raise the margin until at most FALSE of the accepted pixels would be accepted even if all predictions were wrong.

    A target-decoy estimate: of `of` pixels those with the margins `accepted` are accepted, at wrong places a share of
    `elsewhere`.
    """
    wrong = np.sort(elsewhere.margin[limits.accept(elsewhere)])
    for k, margin in enumerate(wrong):
        if (len(wrong) - k) / len(elsewhere.margin) * of <= FALSE * (accepted >= margin).sum():
            return replace(limits, margin=float(margin))
    return replace(limits, margin=max(limits.margin, float(np.nextafter(wrong[-1], np.inf)))) if len(wrong) else limits
