"""Which sequence a folder of photographs shows, where no pattern file says so."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from numpy import ndarray
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.decoding.decoded import DecodingError
from sl_nerfstudio.decoding.graycode.order_check import OrderCheck, check_order, one_direction, sine_phase
from sl_nerfstudio.decoding.graycode.photographs import Image, check_sizes
from sl_nerfstudio.decoding.graycode.samples import Samples, take_samples
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.sequence import ORDERS, SequenceName

_LARGEST_CELL = 32  # pattern pixels
_MOST_PERIODS = 200  # of a sine across the pattern
_LEAST_LOCKED = 0.3  # length of the mean unit vector: the two sines of an axis belong together
_SMOOTHING = 1.5  # samples
_NAMED = 8  # images in a message
_MIRRORED = 0.1  # of the samples: where fewer turn as the camera's axes, the pattern is seen as in a mirror
_ONE_DIRECTION = DecodingError(
    "shows stripes in one direction only",
    "only the columns of the projector were coded, or only its rows",
    "project both: the projector may be anywhere, and its pose follows only from both coordinates of each point",
)


def layout_of_images(
    images: Sequence[Image],
    size: tuple[int, int],
    name: SequenceName | None = None,
    cell: int | None = None,
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
        return fitting[0]
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
    """How many periods the shorter sine of an axis has in the longer one; None if they do not belong together."""
    contrast = grid.max(0) - grid.min(0)
    lit = contrast > 0.5 * np.percentile(contrast, 95)
    long, short = (sine_phase(grid, layout, axis, which) for which in (0, 1))
    smooth = [gaussian_filter(wave(long), _SMOOTHING) for wave in (np.cos, np.sin)]  # else its noise counts n-fold
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
        return DecodingError(
            f"shows no known sequence; nearest is {_described(layout)}, but counted from 0 {_listed(nearest, names)}",
            "images are in the wrong order or of another frame, or something moved in between",
            "put the images in the order of projection, or give a pattern.json that lists what each image shows",
        )
    return _mirrored(layout)


def order_fault(check: OrderCheck, layout: GrayCode, names: Sequence[str]) -> DecodingError | None:
    """The error of photographs called `names` that do not show the sequence; None where nothing contradicts it."""
    if check.misplaced:
        return DecodingError(
            f"is not in the order of the sequence ({layout.order}): {_listed(check, names)}",
            "images are exchanged, doubled or of another frame, the sequence is that of another program, or something "
            "moved in between",
            "name the images so that sorting puts them in the order of projection; --sequence selects another order",
        )
    return _mirrored(layout) if check.turning is not None and check.turning < _MIRRORED else None


def _listed(check: OrderCheck, names: Sequence[str]) -> str:
    found = [f"{names[m.place]} ({m.expected}) {m.seen}" for m in check.misplaced[:_NAMED]]
    more = len(check.misplaced) - _NAMED
    return "; ".join(found) + (f"; and {more} more" if more > 0 else "")


def _mirrored(layout: GrayCode) -> DecodingError:
    return DecodingError(
        f"shows {_described(layout)} as in a mirror",
        "rows and columns, or an image and its inverse, are exchanged, or the images are mirrored",
        "give the images as the camera took them, and a pattern.json that lists what each image shows",
    )


def _described(layout: GrayCode) -> str:
    return f"{layout.order} (cells of {layout.cell})"
