"""Correlation of an image with a pattern in a window about each pixel, on one surface, whatever gain and offset.

A window holds the pixels that lie on the same surface as its centre: a depth that differs by more than a steep surface
would is another surface. The pattern is looked up at predicted coordinates, which bend and foreshorten it as the
surface does; what is left is one displacement for the whole window.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled, compiled_range

STEEPEST = 6.0  # pixel widths of depth from one pixel to the next on one surface: seen at 9 degrees from its plane
_ROUNDS = 4
_ENOUGH = 0.01  # pattern pixels: a shorter step ends the search
_REACH = 2.0  # of a Gaussian window, standard deviations


@dataclass(frozen=True)
class View:
    """One image, and what is predicted for its pixels."""

    image: Float32[ndarray, "h w"]
    coords: Float32[ndarray, "h w 2"]  # predicted, pattern pixels; only those that `usable` allows are read
    depth: Float32[ndarray, "h w"]  # in pixel widths (see Prediction)
    usable: Bool[ndarray, "h w"]  # on a predicted surface, and in the part of the image that shows the pattern


@dataclass(frozen=True)
class Window:
    """A Gaussian window: weights of every `stride`-th pixel about its centre."""

    offsets: Int64[ndarray, "k 2"]  # row, column
    weights: Float32[ndarray, "k"]

    @staticmethod
    def gaussian(sigma: float, stride: int = 1) -> "Window":
        """Up to two standard deviations; `sigma` in pixels."""
        reach = max(int(_REACH * sigma) // stride, 1)
        dy, dx = (stride * np.mgrid[-reach : reach + 1, -reach : reach + 1]).reshape(2, -1)
        distance = np.hypot(dy, dx)
        inside = distance <= max(_REACH * sigma, stride)
        weights = np.exp(-0.5 * (distance[inside] / sigma) ** 2)
        offsets = np.stack([dy[inside], dx[inside]], 1)
        return Window(offsets.astype(np.int64), (weights / weights.sum()).astype(np.float32))


@dataclass(frozen=True)
class Fit:
    """The displacement of the pattern that agrees best with the image, at some pixels."""

    shift: Float32[ndarray, "n 2"]  # to add to the predicted coordinate, pattern pixels
    correlation: Float32[ndarray, "n"]  # at this displacement
    covered: Float32[ndarray, "n"]  # share of the window that could be used
    step: Float32[ndarray, "n"]  # length of the last step: large where the search has not converged
    sigma: Float32[ndarray, "n"]  # 1 sigma in the worse direction, from what gain, offset and shift leave unexplained


def drawn(pattern: Float32[ndarray, "ph pw"], coords: Float32[ndarray, "h w 2"]) -> Float32[ndarray, "h w"]:
    """The pattern looked up at coordinates, bilinearly; the value at the border where they are outside or NaN."""
    place = np.nan_to_num(coords - np.float32(0.5))
    return cv2.remap(pattern, place[..., 0].copy(), place[..., 1].copy(), cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)


def correlations(
    view: View, candidates: Float32[ndarray, "h w k"], places: Int64[ndarray, "n 2"], window: Window
) -> Float32[ndarray, "n k"]:
    """Correlation of the image with each of k pictures in the window about each place (row, column); 0 if undefined."""
    out = np.zeros((len(places), candidates.shape[2]), dtype=np.float32)
    _correlate(
        len(places), view.image, candidates, view.depth, view.usable, places, window.offsets, window.weights, out
    )
    return out


def fit_shifts(
    view: View,
    pattern: Float32[ndarray, "ph pw"],
    places: Int64[ndarray, "n 2"],
    start: Float32[ndarray, "n 2"],
    window: Window,
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
