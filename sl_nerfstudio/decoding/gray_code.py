"""Decoding of Gray-code sequences, with or without inverse images and shifted sines.

A bit is read by comparing an image with its inverse. Indirect light (interreflection, scattering) can make a bit
uncertain; this is judged as in Xu and Aliaga, "Robust pixel classification for 3D modeling with structured light"
(2007), from the direct and the global light of the finest stripes (Nayar et al. 2006).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int16, Int32, Int64, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import Coords, Decoded, DecodingError, Layer, Mask, drop_small_regions
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, all_finite, solve_plane
from sl_nerfstudio.parallel import compiled
from sl_nerfstudio.pattern.gray_code import GrayCode, gray, ungray
from sl_nerfstudio.pattern.layout import HEAD, ShownImage
from sl_nerfstudio.scan.images import as_grey

# Coordinates finer than the cells of a Gray code.
#
# Between two neighbouring cells exactly one bit changes, and the difference of its image and its inverse is zero
# exactly on the border, whatever albedo and shading are. So borders are found to a fraction of a camera pixel, and a
# plane through the borders around a pixel gives its coordinate.

LEVELS = 3  # a pixel is used if fewer of its finest bits than this are uncertain
# The plane through the borders around a pixel.
_LEAST_BORDERS = 4
_SMALLEST_WINDOW, _LARGEST_WINDOW = 2, 10  # pixels to each side
_INLIER = 0.5  # cells from the plane
_MISREAD = 1.0  # cells: a pixel whose own cell is farther than this from the plane was misread


@dataclass(frozen=True)
class CodeCells:
    """The cells of all pixels along one axis, as large as the finest stripes that are resolved."""

    cell: Int32[ndarray, "h w"]  # number of the cell; its last `level` bits are uncertain
    level: Int8[ndarray, "h w"]  # number of the finest bits that are uncertain; -1: the cell is unknown
    difference: Int16[ndarray, "bits h w"]  # image minus inverse of every bit of the number, coarse to fine
    size: int  # of a cell, in cells of the pattern


def subcell_coordinates(cells: CodeCells) -> Layer:
    """Coordinate of every pixel in cells; NaN where it is unknown.

    The cell of number 0 extends from 0 to 1. Where stripes are out of focus, the borders of coarser bits are used.
    Where there are too few borders, the mean of the cells around a pixel is used instead.
    """
    right, down = _borders(cells.cell, cells.level, cells.difference)
    pixels, borders = int((cells.level >= 0).sum()), int((right >= 0).sum() + (down >= 0).sum())
    pitch = pixels / max(borders, 1)  # pixels from border to border
    half = int(np.clip(np.ceil(1.2 * pitch), _SMALLEST_WINDOW, _LARGEST_WINDOW))
    out = np.full(cells.cell.shape, np.nan, dtype=np.float32)
    _fit(cells.cell, cells.level, right, down, half, 2 * half / max(pitch, 0.5) + 2, out)
    return out


@compiled
def _borders(cell: ndarray, level: ndarray, difference: ndarray) -> tuple[ndarray, ndarray]:
    """Position of a border between a pixel's centre (0) and that of its right or lower neighbour (1); -1: none."""
    bits, h, w = difference.shape
    right = np.full((h, w), np.float32(-1))
    down = np.full((h, w), np.float32(-1))
    for y in range(h):
        for x in range(w):
            if level[y, x] < 0:
                continue
            for step in range(2):
                v, u = y + step, x + 1 - step
                if v >= h or u >= w or level[v, u] < 0:
                    continue
                common = max(level[y, x], level[v, u])
                a, b = cell[y, x] >> common, cell[v, u] >> common
                if abs(a - b) != 1:
                    continue
                flipped = (a ^ (a >> 1)) ^ (b ^ (b >> 1))
                bit = bits - 1 - common
                while flipped > 1:
                    flipped >>= 1
                    bit -= 1
                here, there = float(difference[bit, y, x]), float(difference[bit, v, u])
                if (here > 0) == (there > 0):
                    continue
                place = np.float32(here / (here - there))
                if step == 0:
                    right[y, x] = place
                else:
                    down[y, x] = place
    return right, down


@compiled
def _fit(cell: ndarray, level: ndarray, right: ndarray, down: ndarray, half: int, reach: float, out: ndarray) -> None:
    h, w = cell.shape
    for y in range(h):
        for x in range(w):
            if level[y, x] < 0:
                continue
            block = 1 << level[y, x]
            own = ((cell[y, x] >> level[y, x]) + 0.5) * block
            found, value, sx, sy = _plane(cell, level, right, down, y, x, half, reach, (own, 0.0, 0.0), np.inf)
            if found:  # once more, without borders far from the first plane
                found, value, sx, sy = _plane(cell, level, right, down, y, x, half, reach, (value, sx, sy), _INLIER)
            if not found:
                if block > 1:
                    continue
                value = _mean_cell(cell, level, y, x, half, reach)
            if abs(value - own) <= block / 2 + _MISREAD:
                out[y, x] = value


@compiled
def _plane(cell, level, right, down, y, x, half, reach, near, tolerance):
    """The plane through the borders around a pixel: whether it exists, its value at the pixel, its slopes in x and y.

    Borders farther than `tolerance` from the plane `near` (value and slopes) are ignored.
    """
    h, w = cell.shape
    centre, ox, oy = near
    n = sx = sy = sxx = sxy = syy = s = sxs = sys = 0.0
    for v in range(max(y - half, 0), min(y + half + 1, h)):
        for u in range(max(x - half, 0), min(x + half + 1, w)):
            if level[v, u] < 0 or abs(cell[v, u] + 0.5 - centre) > reach:
                continue
            for step in range(2):
                place = right[v, u] if step == 0 else down[v, u]
                if place < 0:
                    continue
                common = max(level[v, u], level[v + step, u + 1 - step])
                border = max(cell[v, u] >> common, cell[v + step, u + 1 - step] >> common) << common
                value = border - centre
                dx = u - x + (place if step == 0 else 0.0)
                dy = v - y + (place if step == 1 else 0.0)
                if abs(value - ox * dx - oy * dy) > tolerance:
                    continue
                n += 1.0
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
                s += value
                sxs += dx * value
                sys += dy * value
    if n < _LEAST_BORDERS:
        return False, centre, 0.0, 0.0
    solvable, value, fx, fy = solve_plane(n, sx, sy, sxx, sxy, syy, s, sxs, sys, 1e-2 * n * n * n)
    if not solvable:
        return False, centre, 0.0, 0.0
    return True, centre + value, fx, fy


@compiled
def _mean_cell(cell, level, y, x, half, reach):
    """Mean of the cells' centres in a window that is symmetric about the pixel."""
    h, w = cell.shape
    total = count = 0.0
    own = cell[y, x]
    for v in range(max(y - half, 0), min(y + half + 1, h)):
        for u in range(max(x - half, 0), min(x + half + 1, w)):
            mv, mu = 2 * y - v, 2 * x - u
            if not (0 <= mv < h and 0 <= mu < w) or level[v, u] != 0 or level[mv, mu] != 0:
                continue
            if abs(cell[v, u] - own) <= reach and abs(cell[mv, mu] - own) <= reach:
                total += cell[v, u] + 0.5
                count += 1.0
    return total / count


# The photographs of one sequence by what they show, as intensities in [0, 1].

Image = UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]


@dataclass(frozen=True)
class Sine:
    """Phase, amplitude and mean of a shifted sine at every pixel."""

    phase: Layer  # radians, 0 to 2 pi
    amplitude: Layer  # of full scale; half of the direct light
    mean: Layer


@dataclass(frozen=True)
class Photographs:
    """The images of one sequence, in the order of `layout`."""

    images: Sequence[Image]
    layout: GrayCode

    def grey(self, place: int) -> Layer:
        """One image."""
        return as_grey(self.images[place])

    def white_and_black(self) -> Sequence[Layer]:
        """Both images that every sequence of bits has."""
        return [self.grey(self.layout.shown.index(item)) for item in HEAD]

    def pair(self, place: int, inverse: int | None) -> tuple[Layer, Layer]:
        """An image and its inverse; white + black - image is the inverse where none was photographed."""
        direct = self.grey(place)
        if inverse is not None:
            return direct, self.grey(inverse)
        white, black = self.white_and_black()
        return direct, white + black - direct

    def sine(self, axis: int, steps: int, period: float) -> Sine:
        """Phase, amplitude and mean of a sine, by least squares over its shifts."""
        x = y = total = np.zeros(self.images[0].shape[:2], dtype=np.float32)
        for k, place in enumerate(self.layout.sine_images(axis, steps, period)):
            image = self.grey(place)
            angle = 2 * np.pi * k / steps
            x, y = x + np.float32(np.cos(angle)) * image, y + np.float32(np.sin(angle)) * image
            total = total + image
        phase = np.arctan2(y, x) % np.float32(2 * np.pi)
        return Sine(phase, np.hypot(x, y) * np.float32(2 / steps), total / np.float32(steps))

    def noise(self) -> float:
        """Standard deviation of an image, from images that hold the same light, or from the finest differences."""
        pairs = [self.layout.bit_images(axis) for axis in (0, 1)]
        if all(pairs) and pairs[0][0][1] is not None:
            sums = [np.add(*self.pair(*places[0])) for places in pairs]
            return MAD_TO_SIGMA / 2 * float(np.median(np.abs(sums[0] - sums[1])))
        if all(pairs):
            return self._noise_of_one_bit(pairs[0][0][0])
        (steps, period), (other_steps, other) = (self.layout.sines(axis)[0] for axis in (0, 1))
        means = self.sine(0, steps, period).mean - self.sine(1, other_steps, other).mean
        spread = np.sqrt(1 / steps + 1 / other_steps)  # of the difference of two means
        return MAD_TO_SIGMA / spread * float(np.median(np.abs(means)))

    def _noise_of_one_bit(self, place: int) -> float:
        """Noise of a coarse bit against white or black, whichever is nearer, less the mean of its four neighbours.

        That difference is smooth: it holds nothing of the object's texture, and global light varies slowly.
        """
        image = self.grey(place)
        white, black = self.white_and_black()
        rest = np.where(np.abs(image - white) < np.abs(image - black), image - white, image - black)
        around = (rest[:-2, 1:-1] + rest[2:, 1:-1] + rest[1:-1, :-2] + rest[1:-1, 2:]) / 4
        scale = np.sqrt(2 * (1 + 1 / 4))
        return MAD_TO_SIGMA / scale * float(np.median(np.abs(rest[1:-1, 1:-1] - around)))


def check_sizes(images: Sequence[Image]) -> None:
    """Raise DecodingError unless all images of a sequence have one size."""
    sizes = sorted({f"{image.shape[1]} x {image.shape[0]}" for image in images})
    if len(sizes) > 1:
        raise DecodingError(
            f"holds images of several sizes ({', '.join(sizes)})",
            "the folder holds images of another camera or resolution, too",
            "keep one folder for each frame, with nothing but its own images",
        )


# A few of the pixels of a sequence's photographs: a coarse grid, and whole lines that cross the stripes' borders.

_GRID = 320  # samples along the longer side of an image
_LINES = 48  # rows, and as many columns
_LONGEST_GAP = 8  # pixels on a line between two that count as neighbours


@dataclass(frozen=True)
class Samples:
    """Intensities in [0, 1] of n images at the same pixels."""

    grid: Float32[ndarray, "n h w"]
    lines: Float32[ndarray, "n m"]  # rows and columns, one after the other
    line: Int64[ndarray, "m"]  # number of each pixel's line
    rows: int  # number of lines that are rows; the others are columns

    def neighbours(self, certain: Bool[ndarray, "m"]) -> tuple[Int64[ndarray, "p"], Int64[ndarray, "p"]]:
        """Pairs of successive certain pixels on a line, at most a few uncertain ones apart."""
        known = np.flatnonzero(certain)
        near = (np.diff(known) <= _LONGEST_GAP) & (np.diff(self.line[known]) == 0)
        return known[:-1][near], known[1:][near]


def take_samples(images: Sequence[Image]) -> Samples:
    """Samples of images that all have one size."""
    h, w = images[0].shape[:2]
    step = max(1, max(h, w) // _GRID)
    rows, columns = (np.unique(np.linspace(0, size - 1, _LINES + 2).astype(int)[1:-1]) for size in (h, w))
    grid, lines = [], []
    for image in images:
        grid.append(as_grey(np.ascontiguousarray(image[::step, ::step])))
        along = np.concatenate([image[rows].reshape(-1, *image.shape[2:]),
                                image[:, columns].swapaxes(0, 1).reshape(-1, *image.shape[2:])])  # fmt: skip
        lines.append(as_grey(along[:, None])[:, 0])
    number = np.concatenate([np.repeat(np.arange(len(rows)), w), len(rows) + np.repeat(np.arange(len(columns)), h)])
    return Samples(np.stack(grid), np.stack(lines), number.astype(np.int64), len(rows))


# Coordinates from shifted sines: each gives the coordinate modulo its period; bits or longer sines say which one.

_PIXEL_CENTRE = 0.5  # the sine is at its crest where the first pixel's centre is
_LEAST_AMPLITUDE = 4.0  # times its own noise


def cell_places(cells: CodeCells) -> Layer:
    """Roughly where in its cell each pixel lies, in cells; NaN unless all of its bits are certain or at a border.

    In the middle of a cell both bits that change at its borders are certain. Near a border that border's bit is
    not, and a pixel may have been given either of the two cells: both give a place near the border.
    """
    before, after = _border_bit(cells, cells.cell - 1), _border_bit(cells, cells.cell)
    before = np.where(cells.cell == 0, np.maximum(after, 1), before)  # the first cell has no border before it
    place = cells.cell + 0.5 + 0.5 * (before - after) / np.maximum(before + after, 1)
    return np.where(cells.level == 0, place, np.nan).astype(np.float32)


def phase_coordinates(photographs: Photographs, axis: int, coarse: Layer | None, noise: float) -> Layer:
    """Coordinate of every pixel in pattern pixels from all sines of an axis, the longest first; NaN where unknown.

    `coarse` is the coordinate from the Gray code; None if the sequence has none, and then the longest sine has no
    more than one period. `noise` is the standard deviation of an image.
    """
    found = coarse
    for steps, period in photographs.layout.sines(axis):
        sine = photographs.sine(axis, steps, period)
        place = sine.phase * np.float32(period / (2 * np.pi)) + np.float32(_PIXEL_CENTRE)
        number = 0 if found is None else np.rint((found - place) / np.float32(period))
        found = place + np.float32(period) * number
        found = np.where(sine.amplitude > _LEAST_AMPLITUDE * noise * np.sqrt(2 / steps), found, np.float32(np.nan))
    if found is None:
        raise ValueError(f"axis {axis} has neither bits nor sines")
    return found.astype(np.float32)


def _border_bit(cells: CodeCells, first: Int32[ndarray, "h w"]) -> Layer:
    """Certainty of the bit that changes between cell `first` and the next one; the largest value past the last."""
    bits = len(cells.difference)
    flipped = gray(np.maximum(first, 0)) ^ gray(np.maximum(first, 0) + 1)
    bit = np.rint(np.log2(flipped)).astype(np.int64)
    index = np.clip(bits - 1 - bit, 0, bits - 1)[None]
    value = np.abs(np.take_along_axis(cells.difference, index, 0)[0].astype(np.float32))
    return np.where(bit < bits, value, np.float32(np.iinfo(np.int16).max))


# Pixels that count as lit.
_FINEST = 4  # bits of each axis that separate direct from global light; the finest alone may be out of focus
_LEAST_DIRECT = 0.02  # of full scale: with less light, bits are lost in the noise
SATURATED = 0.99  # of full scale
OVEREXPOSED = 0.5  # of the lit pixels: where more are saturated, it is said
_LEAST_SIGNAL = 4.0  # times the noise
# Bits that count as certain.
_UNCERTAIN = 0.08  # of the direct light: the smallest difference of an image and its inverse that decides a bit
_RESOLVED = 0.15  # of the direct light, in the median of the lit pixels: a bit with less contrast is not resolved
# Captures that are refused.
_LEAST_LIT = 0.002  # of the image: with less, the pattern counts as not seen
_LEAST_DECODED = 0.02  # of the lit pixels
# Regions that are kept.
_LARGEST_STEP = 3.0  # cells, or usual steps where these are larger, between neighbouring pixels of one surface
_LEAST_REGION = 60  # pixels


@dataclass(frozen=True)
class SequenceLight:
    """Direct and global light of every pixel, of full scale."""

    direct: Layer
    ambient: Layer  # global light: from the whole scene, not from the pixel's own ray
    signal: Layer  # mean difference of the images from their inverse
    noise: float  # standard deviation of an image
    brightest: Layer  # in any of the finest images

    @property
    def saturated(self) -> float:
        """Share of the lit pixels that are saturated in some image."""
        return float((self.brightest[self.lit] > SATURATED).mean())

    @property
    def lit(self) -> Mask:
        """Pixels that the projector reaches."""
        return self.signal > max(_LEAST_DIRECT, _LEAST_SIGNAL * self.noise)


def decode_gray_code(images: Sequence[Image], layout: GrayCode) -> Decoded:
    """Coordinates of every pixel from the photographs of one sequence, in the order of `layout`.

    Grey or RGB, 8 or 16 bit, all of one size. Coordinates are finer than a cell: they use the places where
    the difference of an image and its inverse changes sign, and sines where there are any. Raises DecodingError if the
    sequence is incomplete, if its images have several sizes, or if nothing can be decoded.
    """
    check_count(len(images), layout)
    check_sizes(images)
    photographs = Photographs(images, layout)
    light = separate(photographs)
    _check_light(images, layout, light)
    coords = np.full((*light.lit.shape, 2), np.nan, dtype=np.float32)
    stripes: list[Layer] = []
    finest: list[int] = []
    for axis in (0, 1):
        cells = _read_cells(photographs, axis, light) if layout.bit_images(axis) else None
        finest.append(layout.cell * (1 if cells is None else cells.size))
        coords[..., axis] = _coordinates(photographs, axis, light, cells)
        stripes.append(_stripe_image(photographs, axis, light))
    known = all_finite(coords) & light.lit
    coords[~known] = np.nan
    coords = drop_small_regions(coords, _LARGEST_STEP * max(layout.cell, _usual_step(coords)), _LEAST_REGION)
    stripe = np.where(light.lit, (stripes[0] + stripes[1]) / 2, 0).astype(np.float32)
    notes = tuple(_notes(layout, light, finest))
    decoded = Decoded(coords, light.lit, stripe, np.where(light.lit, light.direct, np.float32(np.nan)), notes)
    if decoded.rate < _LEAST_DECODED:
        raise DecodingError(
            f"only {decoded.rate:.1%} of the lit pixels could be decoded",
            "the images are not in the order of the sequence, belong to another sequence, or something moved",
            "give the images in the order of the pattern file, named so that sorting puts them in that order; "
            "--sequence names the orders of other programs",
        )
    return decoded


def separate(photographs: Photographs) -> SequenceLight:
    """Light of every pixel: direct and global light from the finest stripes, half of which are dark."""
    layout = photographs.layout
    highest = signal = np.zeros(photographs.images[0].shape[:2], dtype=np.float32)
    lowest = np.full_like(highest, np.inf)
    count = 0
    for axis in (0, 1):
        places = layout.bit_images(axis)
        for k, place in enumerate(places):
            p, q = photographs.pair(*place)
            signal, count = signal + np.abs(p - q), count + 1
            if k >= len(places) - _FINEST:
                highest = np.maximum(highest, np.maximum(p, q))
                lowest = np.minimum(lowest, np.minimum(p, q))
        if not places:
            sine = photographs.sine(axis, *layout.sines(axis)[-1])
            signal, count = signal + 2 * sine.amplitude, count + 1
            highest = np.maximum(highest, sine.mean + sine.amplitude)
            lowest = np.minimum(lowest, sine.mean - sine.amplitude)
    place = layout.place(ShownImage("black"))
    ambient = 2 * np.clip(lowest - (0 if place is None else photographs.grey(place)), 0, None)
    return SequenceLight(highest - lowest, ambient, signal / np.float32(count), photographs.noise(), highest)


def _notes(layout: GrayCode, light: SequenceLight, finest: Sequence[int]) -> Iterator[str]:
    """Describe what limits the coordinates: stripes too fine to be resolved, and saturated pixels."""
    shown = [layout.cell << layout.bits[axis] - max(len(layout.bit_images(axis)), 1) for axis in (0, 1)]
    if any(size > least for size, least in zip(finest, shown, strict=True)):
        x, y = finest
        yield (
            f"decoded to {f'{x} px' if x == y else f'{x} px along x and {y} px along y'}: finer stripes have a "
            f"contrast below {_RESOLVED:.0%} (out of focus, or too fine for the camera) and are not used"
        )
    if light.saturated > OVEREXPOSED:
        yield (
            f"overexposed: more than {OVEREXPOSED:.0%} of the lit pixels are saturated; with a shorter exposure "
            "stripes have more contrast"
        )


def _coordinates(photographs: Photographs, axis: int, light: SequenceLight, cells: CodeCells | None) -> Layer:
    """Coordinates of all pixels along an axis, in pattern pixels."""
    layout = photographs.layout
    first, count = layout.first_code(axis), (layout.columns, layout.rows)[axis]
    if cells is not None and not layout.sines(axis):
        return np.clip(subcell_coordinates(cells) * cells.size - first, 0, count) * layout.cell
    if cells is not None and cells.size > 1:  # then the number of the period is not known
        return np.full_like(light.direct, np.nan)
    coarse = None if cells is None else (cell_places(cells) - first) * np.float32(layout.cell)
    found = phase_coordinates(photographs, axis, coarse, light.noise)
    size = (layout.w, layout.h)[axis]
    return np.where((found >= 0) & (found <= size), found, np.float32(np.nan))


def _usual_step(coords: Coords) -> float:
    """Median difference of neighbouring pixels, in pattern pixels: a camera far coarser than the projector."""
    steps = [np.abs(np.diff(coords, axis=axis)).max(-1) for axis in (0, 1)]
    known = np.concatenate([step[np.isfinite(step)] for step in steps])
    return float(np.median(known)) if len(known) else 0.0


def check_count(count: int, layout: GrayCode) -> None:
    """Raise DecodingError unless there is one image for each pattern of the sequence."""
    if count != layout.images:
        raise DecodingError(
            f"holds {count} images, the sequence of the pattern has {layout.images}",
            "images are missing or too many, or the pattern file describes another sequence "
            f"({layout.w} x {layout.h} pixels in cells of {layout.cell})",
            f"give one image of each of the {layout.images} patterns, or the pattern file that they were made with",
        )


def _check_light(images: Sequence[Image], layout: GrayCode, light: SequenceLight) -> None:
    share = float(light.lit.mean())
    if share >= _LEAST_LIT:
        return
    brightness = float(as_grey(images[layout.place(ShownImage("white")) or 0]).mean())
    what = "black" if brightness < _LEAST_DIRECT else "white" if brightness > 1 - _LEAST_DIRECT else "not changing"
    raise DecodingError(
        f"no stripes are seen: the images are {what} (lit: {share:.2%} of the pixels)",
        {"black": "the exposure was far too short, the lens covered, or the projector off",
         "white": "the exposure was far too long",
         "not changing": "the projector was off, or its light missed what the camera sees"}[what],
        "capture this frame again, with stripes visible on the object in every image except white and black",
    )  # fmt: skip


def _read_cells(photographs: Photographs, axis: int, light: SequenceLight) -> CodeCells:
    """Cells of all pixels along an axis."""
    layout = photographs.layout
    places = layout.bit_images(axis)
    code = np.zeros(light.lit.shape, dtype=np.int32)
    uncertain = np.zeros_like(code)
    unresolved = 0  # of the finest bits
    differences = np.empty((len(places), *code.shape), dtype=np.int16)
    for k, place in enumerate(places):
        p, q = photographs.pair(*place)
        difference = p - q
        contrast = np.abs(difference[light.lit]) / np.maximum(light.direct[light.lit], _LEAST_DIRECT)
        unresolved = unresolved + 1 if np.median(contrast) < _RESOLVED else 0
        code = 2 * code + (difference > 0)
        uncertain = 2 * uncertain + _uncertain(p, q, light)
        differences[k] = np.rint(difference * 32767)
    code, uncertain, bits = code >> unresolved, uncertain >> unresolved, max(len(places) - unresolved, 1)
    size = 1 << layout.bits[axis] - bits
    cell = ungray(code, bits)
    level = np.full(code.shape, -1, dtype=np.int8)
    for coarser in reversed(range(LEVELS)):
        # An uncertain bit is harmless at the border of two cells that differ in just that bit.
        c = cell >> coarser
        harmless = ((code >> coarser) ^ gray(c - 1)) | ((code >> coarser) ^ gray(c + 1))
        level[(uncertain >> coarser) & ~harmless == 0] = coarser
    beyond = cell * size - layout.first_code(axis)
    level[~light.lit | (beyond + size <= 0) | (beyond >= (layout.columns, layout.rows)[axis])] = -1
    return CodeCells(cell, level, differences[:bits], size)


def _uncertain(p: Layer, q: Layer, light: SequenceLight) -> Mask:
    """Find pixels where image `p` and its inverse `q` do not decide a bit.

    Their difference is plus or minus the direct light, plus a share of the global light between -1 and 1. Its sign is
    certain if it is larger than what global light alone could cause with the wrong sign.
    """
    difference = np.abs(p - q)
    noise = 2 * np.sqrt(2) * light.noise
    return (difference <= light.ambient - light.direct) | (difference < np.maximum(_UNCERTAIN * light.direct, noise))


def _stripe_image(photographs: Photographs, axis: int, light: SequenceLight) -> Layer:
    """The finest stripes of an axis in [0, 1], with albedo and shading removed."""
    layout, direct = photographs.layout, np.maximum(light.direct, _LEAST_DIRECT)
    places = layout.bit_images(axis)
    if places:
        p, q = photographs.pair(*places[-1])
        difference = p - q
    else:
        sine = photographs.sine(axis, *layout.sines(axis)[-1])
        difference = 2 * sine.amplitude * np.cos(sine.phase)
    return np.clip(0.5 + difference / (2 * direct), 0, 1).astype(np.float32)
