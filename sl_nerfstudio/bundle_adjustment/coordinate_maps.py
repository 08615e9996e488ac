"""Decoded coordinate images of all frames, looked up between pixels.

A look-up fits a paraboloid to the decoded pixels of a small window: this averages the decoding noise,
provides the derivative with respect to the pixel, and shows where the map is discontinuous (edges, wrong
cells). (A plane would average better, but on a curved surface it is off by the same amount everywhere, and
the adjustment would turn that offset into wrong poses.)
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, Int64, UInt64
from numpy import ndarray
from scipy.ndimage import distance_transform_cdt
from torch import Tensor

from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.parallel import compiled, compiled_range, results
from sl_nerfstudio.storage import GrowingArray, largest_in_memory

HALF_WINDOW = 3  # camera pixels to each side of the window in which a paraboloid is fitted
WIDE_HALF_WINDOW = 12  # for derivatives that say how much residuals know: about a period of the pattern, within which
# errors of coordinates are shared; derivatives of smaller windows are noisy, which looks like information
_NORMAL_HALF_WINDOW = 6  # for normals of the surface
_LEAST_PIXELS = 24  # decoded pixels that a window of HALF_WINDOW must hold
_LEAST_PIVOT = 1e-3  # share of a pivot that elimination must leave; below it the window's pixels lie on a conic
_ROUGHNESS_PX = 2.0  # RMS distance of a window from its paraboloid, pattern pixels: beyond, the map is discontinuous
_ROUGHNESS_MEDIANS = 3.0  # the same limit in roughnesses of the median window; the larger limit applies
FARTHEST = 255  # steps from the border of what was decoded: larger distances are not told apart
_SAMPLED_WINDOWS = 200  # windows of each frame from which that median is taken

# Groups of the entries of an array, such as the rows of each frame or each anchor.


@dataclass(frozen=True)
class Groups:
    """The entries of each group, in order: `entries[first[k] : first[k + 1]]` are those of group k."""

    first: Int64[ndarray, "groups_and_one"]
    entries: Int64[ndarray, "n"]

    @staticmethod
    def of(key: Int64[ndarray, "n"], groups: int) -> "Groups":
        """Group entries by a key."""
        first, entries = np.zeros(groups + 1, dtype=np.int64), np.empty(len(key), dtype=np.int64)
        _group(np.ascontiguousarray(key), first, entries)
        return Groups(first, entries)


@compiled
def _group(key, first, entries):
    """Counting sort, stable."""
    for k in key:
        first[k + 1] += 1
    for g in range(len(first) - 1):
        first[g + 1] += first[g]
    place = first.copy()
    for n in range(len(key)):
        entries[place[key[n]]] = n
        place[key[n]] += 1


# Random bits that depend on a number alone: the same in any order and on any number of threads.


@compiled
def mixed(seed, number):
    """64 random bits: SplitMix64 (Steele et al., OOPSLA 2014)."""
    z = np.uint64(seed) + np.uint64(number) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@compiled
def uniform(bits):
    """A number in [0, 1) from 64 random bits."""
    return np.float64(bits >> np.uint64(11)) / 9007199254740992.0


# Only decoded pixels are stored: most of an image shows something else. A bit for each pixel says whether it has a
# coordinate; with the number of those before each word of 64 bits, its place follows from a count of bits (rank:
# Jacobson, "Space-efficient static trees and graphs", 1989).

WORD = 64  # bits
_ONE = np.uint64(1)
_TWO, _FOUR, _56 = np.uint64(2), np.uint64(4), np.uint64(56)
_FIVES, _THREES = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
_FIFTEENS, _ONES = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)


@dataclass(frozen=True)
class PixelIndex:
    """Bits of all frames one after the other, rows first, the lowest of a word first; each row begins a word."""

    words: UInt64[ndarray, "words 2"]  # bits, number of pixels with a coordinate before: together, as they are read
    first: Int64[ndarray, "frames"]  # word of each frame
    widths: Int64[ndarray, "frames"]
    heights: Int64[ndarray, "frames"]

    @staticmethod
    def of(known: Sequence[UInt64[ndarray, "_h _words"]], widths: Sequence[int]) -> "PixelIndex":
        """Index the words of each frame's rows (`packed`)."""
        counts = np.array([part.size for part in known], dtype=np.int64)
        words = np.empty((int(counts.sum()), 2), dtype=np.uint64)
        np.concatenate([part.ravel() for part in known], out=words[:, 0])
        _count_before(words)
        heights = np.array([len(part) for part in known], dtype=np.int64)
        return PixelIndex(words, np.cumsum(counts) - counts, np.array(widths, dtype=np.int64), heights)

    @property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """The parts for compiled loops."""
        return self.words, self.first, self.widths, self.heights

    def known(self, frame: int) -> Bool[ndarray, "h w"]:
        """Which pixels of a frame have a coordinate."""
        w, h, first = self.widths[frame], self.heights[frame], self.first[frame]
        rows = self.words[first : first + h * words_of(w), 0].reshape(h, -1)
        return np.unpackbits(rows.astype("<u8").view(np.uint8), axis=1, count=w, bitorder="little").view(np.bool_)


def packed(known: Bool[ndarray, "h w"]) -> UInt64[ndarray, "h words"]:
    """The words of each row of an image."""
    h, w = known.shape
    padded = np.zeros((h, words_of(w) * WORD), dtype=np.bool_)
    padded[:, :w] = known
    return np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64)


@compiled
def words_of(width):
    """Words of a row."""
    return (width + WORD - 1) // WORD


# `row_word` is the first word of a pixel's row: first[frame] + row * words_of(width).


@compiled
def is_known(words, row_word, column):
    """Whether a pixel has a coordinate."""
    return (words[row_word + column // WORD, 0] >> np.uint64(column % WORD)) & _ONE == _ONE


@compiled
def place_of(words, row_word, column):
    """Number of a pixel's coordinate among all; -1 if it has none."""
    return next_place(words, row_word, column) if is_known(words, row_word, column) else -1


@compiled
def next_place(words, row_word, column):
    """Number of the first coordinate that is at a pixel or after it."""
    number, bit = row_word + column // WORD, np.uint64(column % WORD)
    return np.int64(words[number, 1]) + _bits_of(words[number, 0] & ((_ONE << bit) - _ONE))


@compiled
def known_pixels(words, first_word, width, height):
    """How many pixels of a frame, from its first word on, have a coordinate."""
    last_row, last = first_word + (height - 1) * words_of(width), width - 1
    return next_place(words, last_row, last) + is_known(words, last_row, last) - np.int64(words[first_word, 1])


@compiled
def _bits_of(x):
    """Number of bits that are set (Warren, Hacker's Delight, section 5-1)."""
    x = x - ((x >> _ONE) & _FIVES)
    x = (x & _THREES) + ((x >> _TWO) & _THREES)
    x = (x + (x >> _FOUR)) & _FIFTEENS
    return np.int64((x * _ONES) >> _56)


@compiled
def _count_before(words):
    total = 0
    for k in range(len(words)):
        words[k, 1] = total
        total += _bits_of(words[k, 0])


@compiled
def pixels_of_squares(words, first_word, w, h, step, seed, frame):
    """One decoded pixel of each occupied square of a lattice, and random bits by which to choose among the squares.

    Both are random by the pixels' numbers.
    """
    across = w // step + 1
    chosen = np.full(across * (h // step + 1), -1)
    smallest = np.zeros(len(chosen), dtype=np.uint64)
    for row in range(h):
        row_word = first_word + row * words_of(w)
        for column in range(w):
            if is_known(words, row_word, column):
                n, square = row * w + column, row // step * across + column // step
                bits = mixed(mixed(seed, frame), n)
                if chosen[square] < 0 or bits < smallest[square]:
                    chosen[square], smallest[square] = n, bits
    count = 0
    for square in range(len(chosen)):
        if chosen[square] >= 0:
            chosen[count] = chosen[square]
            smallest[count] = mixed(mixed(seed + 1, frame), chosen[square])
            count += 1
    return chosen[:count], smallest[:count]


# A paraboloid belongs to the pixel at its window's centre and serves every position within that pixel. Positions that
# stay in their pixel need no new fit: a `WindowMemory` keeps the last one of each position. Windows are fitted frame by
# frame: if the images are in a file, each of them is read once.


@dataclass(frozen=True)
class WindowMemory:
    """The last fit of each of some positions; a look-up changes it, and its result does not depend on it."""

    order: Int64[ndarray, "n"]  # in which windows are fitted
    pixel: Int64[ndarray, "n"]  # number of the pixel in its frame; -1 outside, -2 before the first fit
    fit: Float64[ndarray, "n 6 2"]  # c0 + cx dx + cy dy + cxx dx^2 + cxy dx dy + cyy dy^2 around the pixel's centre
    roughness: Float64[ndarray, "n"]  # RMS distance of the window from it; infinite without a fit

    @staticmethod
    def empty(frame: Int64[ndarray, "n"]) -> "WindowMemory":
        """A memory without any fit, for positions in these frames."""
        count, frames = len(frame), int(frame.max(initial=-1)) + 1
        order = Groups.of(frame, frames).entries
        return WindowMemory(order, np.full(count, -2), np.zeros((count, 6, 2)), np.full(count, np.inf))


@compiled_range
def mark_moved(first, last, index, frame, uv, pixels, moved):
    """Pixel in which each position is now, -1 outside the image; whether it is another one than before."""
    _, _, widths, heights = index
    for k in range(first, last):
        f, x, y = frame[k], uv[k, 0], uv[k, 1]
        inside = x >= 0 and y >= 0 and x < widths[f] and y < heights[f]
        pixel = int(y) * widths[f] + int(x) if inside else -1
        moved[k] = pixel != pixels[k]
        pixels[k] = pixel


@compiled_range
def fit_windows(first, last, chosen, values, index, frame, pixels, limits, fits, roughness):
    """The paraboloids of some positions, in the order of their numbers in `chosen`.

    `limits` are half the window, its fewest pixels and the least pivot. Where there is no fit, `roughness` is infinite.
    """
    words, first_words, widths, heights = index
    A, right, places = np.zeros((6, 8)), np.zeros((6, 2)), np.zeros(2 * limits[0] + 1, dtype=np.int64)
    for k in chosen[first:last]:
        f, pixel = frame[k], pixels[k]
        roughness[k] = np.inf
        if pixel >= 0:
            w = widths[f]
            roughness[k] = _fit(
                values, words, first_words[f], w, heights[f], pixel % w, pixel // w, limits, places, A, right
            )
            for i in range(6):
                fits[k, i, 0], fits[k, i, 1] = A[i, 6], A[i, 7]


@compiled_range
def evaluate_windows(first, last, widths, frame, uv, pixels, fits, roughness, found):
    """Value and derivatives by x and y (`found`, 3 x 2) of the paraboloid at each position."""
    for k in range(first, last):
        if roughness[k] < np.inf:
            w = widths[frame[k]]
            dx, dy = uv[k, 0] - pixels[k] % w - 0.5, uv[k, 1] - pixels[k] // w - 0.5
            for c in range(2):
                c0, cx, cy = fits[k, 0, c], fits[k, 1, c], fits[k, 2, c]
                cxx, cxy, cyy = fits[k, 3, c], fits[k, 4, c], fits[k, 5, c]
                found[k, 0, c] = c0 + (cx + cxx * dx + cxy * dy) * dx + (cy + cyy * dy) * dy
                found[k, 1, c] = cx + 2 * cxx * dx + cxy * dy
                found[k, 2, c] = cy + cxy * dx + 2 * cyy * dy


@compiled
def _fit(values, words, first_word, w, h, column, row, limits, places, A, right):
    """Least squares over one window: the coefficients in A[:, 6:], and the RMS distance (infinite without a fit).

    All products of the basis are monomials up to the fourth degree: their sums over a row come first.
    """
    half_window, least_pixels, least_pivot = limits
    left, end = max(column - half_window, 0), min(column + half_window + 1, w)
    top, bottom = max(row - half_window, 0), min(row + half_window + 1, h)
    A[:] = 0.0
    n = squares = origin_a = origin_b = 0.0
    for y in range(top, bottom):  # all rows first: each waits for memory, and together they wait once
        places[y - top] = next_place(words, first_word + y * words_of(w), left)
    for y in range(top, bottom):
        s0 = s1 = s2 = s3 = s4 = a0 = a1 = a2 = b0 = b1 = b2 = 0.0
        row_word, place = first_word + y * words_of(w), places[y - top]
        for x in range(left, end):
            if not is_known(words, row_word, x):
                continue
            a, b = float(values[place, 0]), float(values[place, 1])
            place += 1
            if n == 0.0:
                origin_a, origin_b = a, b  # keeps the sums small
            n += 1.0
            a, b, d = a - origin_a, b - origin_b, float(x - column)
            d2 = d * d
            s0 += 1.0
            s1 += d
            s2 += d2
            s3 += d2 * d
            s4 += d2 * d2
            a0 += a
            a1 += a * d
            a2 += a * d2
            b0 += b
            b1 += b * d
            b2 += b * d2
            squares += a * a + b * b
        e = float(y - row)
        e2 = e * e
        A[0, 0] += s0
        A[1, 0] += s1
        A[2, 0] += e * s0
        A[3, 0] += s2
        A[4, 0] += e * s1
        A[5, 0] += e2 * s0
        A[3, 1] += s3
        A[4, 1] += e * s2
        A[5, 1] += e2 * s1
        A[5, 2] += e2 * e * s0
        A[3, 3] += s4
        A[4, 3] += e * s3
        A[4, 4] += e2 * s2
        A[5, 4] += e2 * e * s1
        A[5, 5] += e2 * e2 * s0
        for c, v0, v1, v2 in ((6, a0, a1, a2), (7, b0, b1, b2)):
            A[0, c] += v0
            A[1, c] += v1
            A[2, c] += e * v0
            A[3, c] += v2
            A[4, c] += e * v1
            A[5, c] += e2 * v0
    if n < least_pixels:
        return np.inf
    A[1, 1], A[2, 1], A[2, 2], A[3, 2], A[4, 2], A[5, 3] = A[3, 0], A[4, 0], A[5, 0], A[4, 1], A[5, 1], A[4, 4]
    for i in range(6):
        right[i, 0], right[i, 1] = A[i, 6], A[i, 7]
    if not _solve(A, least_pivot):
        return np.inf
    for i in range(6):
        squares -= A[i, 6] * right[i, 0] + A[i, 7] * right[i, 1]
    A[0, 6] += origin_a
    A[0, 7] += origin_b
    return np.sqrt(max(squares, 0.0) / n)


@compiled
def _solve(A, least_pivot):
    """Cholesky of the lower triangle of A[:, :6], then A[:, 6:] <- solution. False where the window is degenerate."""
    for j in range(6):
        d = A[j, j]
        scale = d
        for i in range(j):
            d -= A[j, i] * A[j, i]
        if not d > least_pivot * scale:
            return False
        A[j, j] = np.sqrt(d)
        for i in range(j + 1, 6):
            v = A[i, j]
            for m in range(j):
                v -= A[i, m] * A[j, m]
            A[i, j] = v / A[j, j]
    for c in range(6, 8):
        for i in range(6):
            v = A[i, c]
            for m in range(i):
                v -= A[i, m] * A[m, c]
            A[i, c] = v / A[i, i]
        for i in range(5, -1, -1):
            v = A[i, c]
            for m in range(i + 1, 6):
                v -= A[m, i] * A[m, c]
            A[i, c] = v / A[i, i]
    return True


@dataclass(frozen=True)
class MapSample:
    """Coordinates looked up at some positions."""

    uv_projector: Float[Tensor, "n 2"]
    jacobian: Float[Tensor, "n 2 2"]  # d uv_projector / d uv_camera
    valid: Bool[Tensor, "n"]  # enough decoded pixels, and a paraboloid fits them
    roughness: Float[Tensor, "n"]  # RMS distance of the window from it, projector pixels; infinite without a fit

    def chosen(self, index: Tensor) -> "MapSample":
        """Choose positions by mask or by index."""
        return MapSample(self.uv_projector[index], self.jacobian[index], self.valid[index], self.roughness[index])


@dataclass(frozen=True)
class CoordinateMaps:
    """Coordinate images of all frames; sizes may differ."""

    values: Float[Tensor, "decoded 2"]  # those that are known: all frames one after the other, rows first
    index: PixelIndex
    half_window: int  # camera pixels
    least_pixels: int  # decoded pixels that a window must hold
    max_roughness: float  # projector pixels; rougher windows are discontinuous

    @staticmethod
    def of(images: Iterable[Float[Tensor, "_h _w 2"]]) -> "CoordinateMaps":
        """Maps of one image per frame; sizes may differ. What is too large for memory is kept in a file."""
        values, known, widths = GrowingArray(largest_in_memory()), [], []
        for image in images:
            coords = image.float().numpy()
            finite = all_finite(coords)
            values.append(coords[finite])
            known.append(packed(finite))
            widths.append(image.shape[1])
        index = PixelIndex.of(known, widths)
        maps = CoordinateMaps(torch.from_numpy(values.whole()), index, HALF_WINDOW, _LEAST_PIXELS, _ROUGHNESS_PX)
        return maps.with_windows(HALF_WINDOW)

    def with_windows(self, half_window: int) -> "CoordinateMaps":
        """Look the same images up in windows of another size, as full of decoded pixels as before.

        Windows that are much rougher than the median one count as discontinuous.
        """
        growth = (2 * half_window + 1) / (2 * self.half_window + 1)
        maps = replace(self, half_window=half_window, least_pixels=round(self.least_pixels * growth**2))
        drawn = maps.draw(torch.arange(self.frames), _SAMPLED_WINDOWS, torch.Generator().manual_seed(0))
        _, roughness = maps._fit(*drawn, WindowMemory.empty(drawn[0].numpy()))
        found = roughness[torch.isfinite(roughness)]
        usual = float(found.median()) if len(found) else 0.0
        return replace(maps, max_roughness=max(_ROUGHNESS_PX, _ROUGHNESS_MEDIANS * usual))

    @cached_property
    def for_normals(self) -> "CoordinateMaps":
        """The same images with wider windows: slopes of small ones are noisy."""
        return self.with_windows(_NORMAL_HALF_WINDOW)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.index.first)

    def draw(
        self, frames: Int[Tensor, "m"], count: int, generator: torch.Generator
    ) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 2"]]:
        """Up to `count` random decoded pixels of each frame, at most one in each square of a lattice.

        Returns their frames and their centres.
        """
        seed, words = seed_from(generator), self.index.words

        def pixels(frame: int) -> Int64[ndarray, "_"]:
            w, h, first = (int(part[frame]) for part in (self.index.widths, self.index.heights, self.index.first))
            step = max(1, int((known_pixels(words, first, w, h) / max(count, 1)) ** 0.5))
            chosen, bits = pixels_of_squares(words, first, w, h, step, seed, frame)
            return chosen[np.argsort(bits)[:count]]

        found = results([partial(pixels, frame) for frame in frames.tolist()])
        frame = torch.repeat_interleave(frames, torch.tensor([len(part) for part in found], dtype=torch.int64))
        pixel = torch.from_numpy(np.concatenate([np.zeros(0, dtype=np.int64), *found]))
        w = self._sizes[0][frame]
        return frame, torch.stack([pixel % w + 0.5, pixel // w + 0.5], -1).double()

    def image(self, frame: int) -> Float[Tensor, "h w 2"]:
        """The coordinate image of a frame, NaN where not decoded."""
        known, start = self.index.known(frame), int(self.index.words[self.index.first[frame], 1])
        out = torch.full((*known.shape, 2), torch.nan)
        out[torch.from_numpy(known)] = self.values[start : start + int(known.sum())]
        return out

    @property
    def arrays(self) -> tuple[ndarray, tuple[ndarray, ...]]:
        """Values and index for compiled loops."""
        return self.values.numpy(), self.index.arrays

    @property
    def _sizes(self) -> tuple[Int[Tensor, "frames"], Int[Tensor, "frames"]]:
        return torch.from_numpy(self.index.widths), torch.from_numpy(self.index.heights)

    def border_distance(self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        """Steps, also diagonal ones, to the nearest pixel without a coordinate (up to `FARTHEST`); 0 outside."""
        w, h = (size[frame] for size in self._sizes)
        x, y = (uv_camera[:, k].nan_to_num(-1.0).clamp(-1, 2**30).floor().long() for k in range(2))
        inside = (x >= 0) & (y >= 0) & (x < w) & (y < h)
        pixel = torch.where(inside, y * w + x, torch.full_like(x, -1)).numpy()
        groups, found = Groups.of(frame.numpy(), self.frames), np.zeros(len(frame))
        for f, (first, last) in enumerate(pairwise(groups.first.tolist())):
            mine = groups.entries[first:last]
            if len(mine):
                steps = np.asarray(distance_transform_cdt(np.pad(self.index.known(f), 1), "chessboard"))[1:-1, 1:-1]
                found[mine] = np.where(pixel[mine] >= 0, np.minimum(steps.ravel()[pixel[mine]], FARTHEST), 0)
        return torch.from_numpy(found)

    def decoded(self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"]) -> Bool[Tensor, "n"]:
        """Whether the pixels at positions in the camera images of `frame` have a coordinate."""
        words, first, widths, heights = self.arrays[1]
        j, (x, y) = frame.numpy(), uv_camera.numpy().T
        inside = (x >= 0) & (y >= 0) & (x < widths[j]) & (y < heights[j])
        column, row = (np.where(inside, part, 0).astype(np.int64) for part in (x, y))
        word = words[first[j] + row * words_of(widths[j]) + column // WORD, 0]
        return torch.from_numpy(inside & (word >> (column % WORD).astype(np.uint64) & _ONE == _ONE))

    def look_up(
        self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"], memory: WindowMemory | None = None
    ) -> MapSample:
        """Fit around positions in the camera images of `frame`; invalid outside the image.

        `memory` is that of an earlier look-up for the same frames: where a position is still in the same pixel, it
        saves the work.
        """
        fit, roughness = self._fit(frame, uv_camera, memory or WindowMemory.empty(frame.numpy()))
        return MapSample(fit[:, 0], fit[:, 1:].transpose(1, 2), roughness < self.max_roughness, roughness)

    def _fit(
        self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"], memory: WindowMemory
    ) -> tuple[Float[Tensor, "n 3 2"], Float[Tensor, "n"]]:
        """Value, derivatives by x and y, and the window's RMS distance from the paraboloid (infinite without a fit)."""
        at, uv = frame.numpy(), uv_camera.detach().double().numpy()
        values, index = self.arrays
        n, moved, found = len(at), np.empty(len(at), dtype=np.bool_), np.zeros((len(at), 3, 2))
        mark_moved(n, index, at, uv, memory.pixel, moved)
        chosen = memory.order[moved[memory.order]]
        limits = self.half_window, self.least_pixels, _LEAST_PIVOT
        fit_windows(len(chosen), chosen, values, index, at, memory.pixel, limits, memory.fit, memory.roughness)
        evaluate_windows(n, self.index.widths, at, uv, memory.pixel, memory.fit, memory.roughness, found)
        return torch.from_numpy(found), torch.from_numpy(memory.roughness.copy())


def seed_from(generator: torch.Generator) -> int:
    """A new seed for choices in compiled loops."""
    return int(torch.randint(2**62, (), generator=generator))
