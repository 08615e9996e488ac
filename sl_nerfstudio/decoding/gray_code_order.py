"""Recognition of the sequence that a folder of photographs shows, where no pattern file states it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.decoding.decoder import DecodingError, Mask
from sl_nerfstudio.decoding.gray_code import OVEREXPOSED, SATURATED, Image, Samples, check_sizes, take_samples
from sl_nerfstudio.pattern.gray_code import GrayCode, ungray
from sl_nerfstudio.pattern.layout import HEAD, ORDERS, SequenceName, order_names

# Whether photographs of a sequence show what they should: each image against its place in the sequence.
#
# This follows for any object: white is the brightest image of every pixel and black the darkest; an image and its
# inverse add up to white and black; and where a bit of a Gray code changes, the next finer bit is 1 and all others that
# are finer are 0. That is measured where those bits are resolved: on the borders of coarse stripes lie the middles of
# finer ones. The axes of the pattern turn as those of the camera do, because projector and camera see the same side of
# a surface. All of it is measured at a few of the pixels.

_LEAST_CONTRAST = 0.04  # of full scale, brightest less darkest image: a pixel that the projector lights
_SHARE_OF_CONTRAST = 0.3  # of the usual contrast: darker pixels are left out
_LEAST_LIT = 50  # samples
_NEAR = 0.2  # of the contrast: as bright as the brightest image, as dark as the darkest
_AGREE = 0.6  # of the lit samples: fewer contradict
_CERTAIN = 0.3  # of the contrast: an image and its inverse that differ by less decide nothing
_LEAST_CHANGES = 20  # neighbours that differ: with fewer, their order is not judged
_CONTINUES = 0.75  # of the borders of coarser bits: with fewer, a bit does not continue them
_SINE = 0.2  # of the contrast: a sine's images differ from it by more
_ONE_WAY, _SPREAD = 0.2, 0.4  # shares of changes along rows: far from one half, and much the same in all images
_ORDER_SMOOTHING = 3.0  # samples
_LEFT_OUT = 3  # of the finest resolved bits: pixels on their borders have a direction, too
_INSIDE = 0.99  # of the certain samples: codes of cells of the pattern
_TURNING = 0.9  # of the samples: axes that turn as the camera's

Grid = Float32[ndarray, "n h w"]
Values = Int64[ndarray, "h w"] | Float64[ndarray, "h w"]


@dataclass(frozen=True)
class Misplaced:
    """An image that does not show what its place in the sequence says."""

    place: int
    expected: str
    seen: str  # continues "image ..": "is not the brightest"


@dataclass(frozen=True)
class OrderCheck:
    """Agreement of photographs with the order of a sequence."""

    misplaced: tuple[Misplaced, ...]
    turning: float | None  # share of samples where the pattern's axes turn as the camera's; None: cannot be judged
    judged: bool  # enough samples are lit
    saturated: float = 0.0  # share of the lit samples that are saturated in their brightest image

    @property
    def overexposed(self) -> bool:
        """Whether so much is saturated that images do not show their stripes."""
        return self.saturated > OVEREXPOSED

    @property
    def fits(self) -> bool:
        """Whether nothing contradicts the order."""
        return self.judged and not self.misplaced and (self.turning is None or self.turning > _TURNING)


def check_order(samples: Samples, layout: GrayCode) -> OrderCheck:
    """Compare samples of photographs with a sequence of as many images."""
    grid = samples.grid
    lit = _lit(grid)
    if lit.sum() < _LEAST_LIT:
        return OrderCheck((), None, False)
    misplaced = _heads(grid, layout, lit) + _not_inverse(grid, layout, lit) + _no_sines(grid, layout, lit)
    codes: list[tuple[Values, Mask]] = []
    for axis in (0, 1):
        if layout.bit_images(axis):
            misplaced += _not_continued(samples, layout, axis)
            signs, certain = _resolved_bits(grid, layout, axis)
            codes.append((_index(signs), np.logical_and.reduce(certain[: max(1, len(certain) - _LEFT_OUT)])))
        else:
            codes.append((sine_phase(grid, layout, axis, 0), lit))
    unique = {item.place: item for item in reversed(misplaced)}
    turning = None if unique else _turning(*codes)
    saturated = float((grid.max(0)[lit] > SATURATED).mean())
    return OrderCheck(tuple(unique[place] for place in sorted(unique)), turning, True, saturated)


def one_direction(samples: Samples) -> bool:
    """Whether all images change along one direction of the camera only: stripes of one kind.

    Stripes at 45 degrees to the camera's rows cannot be told apart in this way; the answer is then False.
    """
    highest, lowest = samples.lines.max(0), samples.lines.min(0)
    lit, along_row = _lit(samples.lines), []
    for image in samples.lines:
        difference = 2 * image - highest - lowest
        here, there = samples.neighbours(lit & (np.abs(difference) > _CERTAIN * (highest - lowest)))
        changed = (difference[here] > 0) != (difference[there] > 0)
        in_row = samples.line[here] < samples.rows
        both = int(changed[in_row].sum()), int(changed[~in_row].sum())
        if sum(both) >= _LEAST_CHANGES:
            along_row.append(both[0] / sum(both))
    middle = float(np.median(along_row)) if along_row else 0.5
    return (
        len(along_row) >= 3
        and abs(middle - 0.5) > _ONE_WAY
        and float(np.ptp(np.percentile(along_row, (20, 80)))) < _SPREAD
    )


def _lit(images: Float32[ndarray, "n *at"]) -> Bool[ndarray, "*at"]:
    contrast = images.max(0) - images.min(0)
    return contrast > max(_LEAST_CONTRAST, _SHARE_OF_CONTRAST * float(np.percentile(contrast, 95)))


def _bits(
    images: Float32[ndarray, "n *at"], layout: GrayCode, axis: int
) -> tuple[list[Bool[ndarray, "*at"]], list[Bool[ndarray, "*at"]]]:
    """Every bit of an axis, coarse to fine, and where it is certain."""
    highest, lowest = images.max(0), images.min(0)
    lit, signs, certain = _lit(images), [], []
    for direct, inverse in layout.bit_images(axis):
        other = highest + lowest - images[direct] if inverse is None else images[inverse]
        signs.append(images[direct] > other)
        certain.append(lit & (np.abs(images[direct] - other) > _CERTAIN * (highest - lowest)))
    return signs, certain


def _resolved_bits(
    images: Float32[ndarray, "n *at"], layout: GrayCode, axis: int
) -> tuple[list[Bool[ndarray, "*at"]], list[Bool[ndarray, "*at"]]]:
    """Drop the finest bits that are uncertain for half of the lit pixels or more; keep at least one bit."""
    signs, certain = _bits(images, layout, axis)
    lit = _lit(images).sum()
    count = next((k for k, sure in enumerate(certain) if sure.sum() < lit / 2), len(certain))
    return signs[: max(1, count)], certain[: max(1, count)]


def with_numbering(layout: GrayCode, images: Sequence[Image]) -> GrayCode:
    """The sequence with cells numbered from 0, or so that the middle has the middle of all codes.

    Numbers from the middle are recognised by codes that no cell would have otherwise.
    """
    centred, grid = replace(layout, centred=True), take_samples(images).grid
    if layout.centred or not centred.centred or _in_pattern(grid, layout) > _INSIDE:
        return layout
    return centred if _in_pattern(grid, centred) > _INSIDE else layout


def _in_pattern(grid: Grid, layout: GrayCode) -> float:
    """Share of the samples with certain bits whose codes are those of cells of the pattern, along the worse axis."""
    shares = []
    for axis, count in enumerate((layout.columns, layout.rows)):
        if layout.bit_images(axis):
            signs, certain = _resolved_bits(grid, layout, axis)
            block = 1 << (layout.bits[axis] - len(signs))
            place = (_index(signs) * block - layout.first_code(axis))[np.logical_and.reduce(certain)]
            shares.append(float(((place + block > 0) & (place < count)).mean()) if place.size else 1.0)
    return min(shares, default=1.0)


def _heads(grid: Grid, layout: GrayCode, lit: Mask) -> list[Misplaced]:
    highest, lowest = grid.max(0), grid.min(0)
    slack = _NEAR * (highest - lowest)
    found = []
    for shown, near, seen in (
        (HEAD[0], lambda image: image >= highest - slack, "is not the brightest"),
        (HEAD[1], lambda image: image <= lowest + slack, "is not the darkest"),
    ):
        place = layout.place(shown)
        if place is not None and near(grid[place])[lit].mean() < _AGREE:
            found.append(Misplaced(place, str(shown), seen))
    return found


def _not_inverse(grid: Grid, layout: GrayCode, lit: Mask) -> list[Misplaced]:
    """Images and their inverses that do not add up to the brightest and the darkest."""
    highest, lowest = grid.max(0), grid.min(0)
    found = []
    for direct, inverse in layout.bit_images(0) + layout.bit_images(1):
        if inverse is None:
            continue
        apart = np.abs(grid[direct] + grid[inverse] - highest - lowest) > 2 * _NEAR * (highest - lowest)
        judged = lit & (np.maximum(grid[direct], grid[inverse]) < SATURATED)
        if judged.sum() >= _LEAST_LIT and apart[judged].mean() > 1 - _AGREE:
            seen = "and its neighbour are not each other's inverse"
            found += [Misplaced(place, str(layout.shown[place]), seen) for place in (direct, inverse)]
    return found


def _no_sines(grid: Grid, layout: GrayCode, lit: Mask) -> list[Misplaced]:
    """Sines whose mean is not that of white and black or of the other sines, or whose shifts do not make a sine."""
    sines = [(axis, *sine) for axis in (0, 1) for sine in layout.sines(axis)]
    places = [layout.sine_images(*sine) for sine in sines]
    heads = [grid[place] for place in map(layout.place, HEAD) if place is not None]
    middle = np.mean(heads, axis=0) if heads else np.median([grid[where].mean(0) for where in places], axis=0)
    contrast = grid.max(0) - grid.min(0)
    found = []
    for where in places:
        angles = 2 * np.pi * np.arange(len(where)) / len(where)
        x, y = (np.tensordot(wave(angles), grid[where], 1) * 2 / len(where) for wave in (np.cos, np.sin))
        waves = np.multiply.outer(np.cos(angles), x) + np.multiply.outer(np.sin(angles), y)
        rest = np.abs(grid[where] - middle - waves).max(0)
        if (rest > _SINE * contrast)[lit].mean() > 1 - _AGREE:
            seen = "is not one of equally shifted sines"
            found += [Misplaced(place, str(layout.shown[place]), seen) for place in where]
    return found


def sine_phase(grid: Grid, layout: GrayCode, axis: int, which: int) -> Float64[ndarray, "h w"]:
    """Phase of the `which`-th sine of an axis, the longest first; 0 to 2 pi."""
    steps, period = layout.sines(axis)[which]
    places = layout.sine_images(axis, steps, period)
    turns = np.exp(2j * np.pi * np.arange(steps) / steps)
    return np.angle(np.tensordot(turns, grid[places], 1)) % (2 * np.pi)


def _not_continued(samples: Samples, layout: GrayCode, axis: int) -> list[Misplaced]:
    """The first bit of an axis that is not what the borders of the coarser bits say of it."""
    signs, certain = map(np.array, _bits(samples.lines, layout, axis))
    here = np.flatnonzero(_lit(samples.lines)[:-1] & (np.diff(samples.line) == 0))
    here = here[_lit(samples.lines)[here + 1]]
    changed = signs[:, here] != signs[:, here + 1]
    sure = certain[:, here] & certain[:, here + 1] & ~changed
    for bit in range(1, len(signs)):
        border = (changed[:bit].sum(0) == 1) & (sure[:bit] | changed[:bit]).all(0) & sure[bit]
        expected = changed[bit - 1, border]
        if len(expected) >= _LEAST_CHANGES and (signs[bit, here[border]] == expected).mean() < _CONTINUES:
            place = layout.bit_images(axis)[bit][0]
            return [Misplaced(place, str(layout.shown[place]), "does not continue the coarser bits")]
    return []


def _index(signs: Sequence[Bool[ndarray, "*at"]]) -> Int64[ndarray, "*at"]:
    """Cells from their bits, coarse to fine."""
    code = np.zeros(signs[0].shape, dtype=np.int64)
    for sign in signs:
        code = 2 * code + sign
    return ungray(code, len(signs))


def _turning(x: tuple[Values, Mask], y: tuple[Values, Mask]) -> float | None:
    """Share of samples at which the gradients of both cells turn from x to y as the camera's axes do."""
    known = x[1] & y[1]
    weight = gaussian_filter(known.astype(np.float64), _ORDER_SMOOTHING)
    gradients = []
    for index, _ in (x, y):
        smooth = gaussian_filter(np.where(known, index, 0).astype(np.float64), _ORDER_SMOOTHING) / np.maximum(
            weight, 1e-6
        )
        gradients.append(np.gradient(smooth))
    inside = known & (weight > 0.95)
    if inside.sum() < _LEAST_LIT:
        return None
    (xv, xu), (yv, yu) = gradients
    turn = (xu * yv - xv * yu)[inside]
    turn = turn[turn != 0]
    return float((turn > 0).mean()) if len(turn) >= _LEAST_LIT else None


_LARGEST_CELL = 32  # pattern pixels
_MOST_PERIODS = 200  # of a sine across the pattern
_LEAST_LOCKED = 0.3  # length of the mean unit vector: the two sines of an axis belong together
_RECOGNITION_SMOOTHING = 1.5  # samples
_NAMED = 8  # images in a message
_MIRRORED = 0.1  # of the samples: where fewer turn as the camera's axes, the pattern is seen as in a mirror
_ONE_DIRECTION = DecodingError(
    "shows stripes in one direction only",
    "only the columns of the projector were coded, or only its rows",
    "project both: the projector may be anywhere, and its pose follows only from both coordinates of each point",
)


def layout_of_images(
    images: Sequence[Image], size: tuple[int, int], name: SequenceName | None = None, cell: int | None = None
) -> GrayCode:
    """The sequence that these photographs of one frame show, for a projector of `size` (w, h).

    With `name`, only that program's order is considered, with `cell` only that side of a cell. What remains is decided
    by the number of images, and by what they show. Raises DecodingError if nothing fits, or more than one sequence.
    """
    check_sizes(images)
    samples = take_samples(images)
    try:
        possible = possible_layouts(len(images), size, name, cell)
    except DecodingError:
        if one_direction(samples):
            raise _ONE_DIRECTION from None
        raise
    checks = [(layout, check_order(samples, layout)) for layout in _with_periods(possible, samples)]
    fitting = [layout for layout, check in checks if check.fits]
    if len(fitting) == 1:
        return with_numbering(fitting[0], images)
    if not fitting:
        raise _ONE_DIRECTION if one_direction(samples) else _nothing_fits(checks)
    kinds = " or ".join([*map(_described, fitting[:3]), *(["others"] if len(fitting) > 3 else [])])
    raise DecodingError(
        f"may show {kinds}",
        "they fit more than one sequence: too little of it is seen, or cells of several sizes give as many images",
        "give --cell, --sequence, or the pattern.json of what was projected",
    )


def possible_layouts(
    count: int, size: tuple[int, int], name: SequenceName | None = None, cell: int | None = None
) -> list[GrayCode]:
    """All known sequences of `count` images for a pattern of `size` (w, h). Raises DecodingError if there is none."""
    names: Sequence[SequenceName] = (name,) if name else tuple(ORDERS)  # pyright: ignore[reportAssignmentType]
    found: dict[tuple, GrayCode] = {}
    counts: dict[str, set[int]] = {}
    for other in names:
        for side in range(1, _LARGEST_CELL + 1) if cell is None else (cell,):
            if min(size) < 2 * side:
                continue
            layout = GrayCode.in_order(other, *size, side)
            if layout.images == count and (other != "slstudio" or side == 1):
                found.setdefault((side, layout.shown), layout)
            counts.setdefault(layout.order if name is None else other, set()).add(layout.images)
    if found:
        return list(found.values())
    listed = "; ".join(f"{other}: {', '.join(map(str, sorted(n, reverse=True)[:3]))}" for other, n in counts.items())
    raise DecodingError(
        f"holds {count} images; for a projector of {size[0]} x {size[1]} pixels sequences have other numbers: {listed}",
        "images are missing or too many, or --pattern gives another resolution than the projector's",
        "give all images of the sequence and nothing else, or a pattern.json that lists what each image shows",
    )


def _with_periods(layouts: Sequence[GrayCode], samples: Samples) -> list[GrayCode]:
    """Sequences of sines alone, with the number of periods that the images show; left out if they show none."""
    out = []
    for layout in layouts:
        if layout.bit_images(0):
            out.append(layout)
            continue
        periods = [_periods(layout, samples.grid, axis) for axis in (0, 1)]
        if periods[0] is not None and periods[1] is not None:
            shortest = (layout.w / periods[0], layout.h / periods[1])
            out.append(GrayCode.in_order("slstudio", layout.w, layout.h, layout.cell, shortest))
    return out


def _periods(layout: GrayCode, grid: Float32[ndarray, "n h w"], axis: int) -> int | None:
    """Number of periods of an axis's shorter sine in the longer one; None if they do not belong together."""
    contrast = grid.max(0) - grid.min(0)
    lit = contrast > 0.5 * np.percentile(contrast, 95)
    long, short = (sine_phase(grid, layout, axis, which) for which in (0, 1))
    smooth = [
        gaussian_filter(wave(long), _RECOGNITION_SMOOTHING) for wave in (np.cos, np.sin)
    ]  # else its noise counts n-fold
    long, short = np.arctan2(smooth[1], smooth[0])[lit], short[lit]
    numbers = np.arange(2, _MOST_PERIODS + 1)
    locked = np.array([abs(np.exp(1j * (short - n * long)).mean()) for n in numbers])
    return int(numbers[locked.argmax()]) if locked.max() > _LEAST_LOCKED else None


def _nothing_fits(checks: Sequence[tuple[GrayCode, OrderCheck]]) -> DecodingError:
    if not checks or not any(check.judged for _, check in checks):
        return DecodingError(
            "shows no stripes from which the sequence could be recognised",
            "the projector was off, its light missed what the camera sees, or the exposure was far too short or long",
            "capture this frame again",
        )
    layout, nearest = min(checks, key=lambda item: len(item[1].misplaced))
    if nearest.misplaced:
        names = [f"image {place}" for place in range(layout.images)]
        error = DecodingError(
            f"shows no known sequence; nearest is {_described(layout)}, but counted from 0 {_listed(nearest, names)}",
            "images are in the wrong order or of another frame, or something moved in between",
            "put the images in the order of projection, or give a pattern.json that lists what each image shows",
        )
        return _with_exposure(error, nearest)
    return _mirrored(layout)


def other_order(samples: Samples, layout: GrayCode) -> GrayCode | None:
    """The sequence of another program, for the same projector and cells, that photographs show; None if they do not."""
    names: Sequence[SequenceName] = tuple(ORDERS)  # pyright: ignore[reportAssignmentType]
    orders = {GrayCode.in_order(name, layout.w, layout.h, layout.cell) for name in names}
    others = (other for other in orders if other.images == layout.images and other.shown != layout.shown)
    return next((other for other in others if check_order(samples, other).fits), None)


def order_fault(
    check: OrderCheck, layout: GrayCode, names: Sequence[str], other: GrayCode | None
) -> DecodingError | None:
    """The error of photographs called `names` that do not show the sequence; None where nothing contradicts it.

    `other` is the sequence that they show instead, if there is one.
    """
    if other is not None:
        return DecodingError(
            f"shows the images in the order of {other.order}, not of {layout.order}",
            "the sequence is that of another program than the one stated",
            f"give --sequence {order_names(other.shown, other.scope)[0]}",
        )
    if check.misplaced:
        error = DecodingError(
            f"is not in the order of the sequence ({layout.order}): {_listed(check, names)}",
            "images are exchanged, doubled or of another frame, the sequence is that of another program, or something "
            "moved in between",
            "name the images so that sorting puts them in the order of projection; --sequence selects another order",
        )
        return _with_exposure(error, check)
    return _mirrored(layout) if check.turning is not None and check.turning < _MIRRORED else None


def _listed(check: OrderCheck, names: Sequence[str]) -> str:
    found = [f"{names[m.place]} ({m.expected}) {m.seen}" for m in check.misplaced[:_NAMED]]
    more = len(check.misplaced) - _NAMED
    return "; ".join(found) + (f"; and {more} more" if more > 0 else "")


def _with_exposure(error: DecodingError, check: OrderCheck) -> DecodingError:
    """The error of images in a wrong order, or of images that are too bright to show their stripes."""
    if not check.overexposed:
        return error
    return DecodingError(
        f"is overexposed ({check.saturated:.0%} of the lit pixels are saturated), and {error.problem}",
        f"the exposure was too long for images to show their stripes; otherwise, {error.cause}",
        f"capture again with a shorter exposure, white below full scale; otherwise, {error.remedy}",
    )


def _mirrored(layout: GrayCode) -> DecodingError:
    return DecodingError(
        f"shows {_described(layout)} as in a mirror",
        "the projector is set to rear projection, the camera's program mirrors its photographs, or rows and columns "
        "are exchanged",
        "switch the projector from rear to front projection, and the camera's mirroring off; or give a pattern.json "
        "that lists what each image shows",
    )


def _described(layout: GrayCode) -> str:
    return f"{layout.order} (cells of {layout.cell})"
