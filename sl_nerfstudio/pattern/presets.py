"""Coded grids and Gray-code sequences for common projectors."""

import math
from typing import Literal

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.grid import MAX_NODES, MAX_PIXELS, GridPattern
from sl_nerfstudio.pattern.sequence import SequenceName

Preset = Literal["800x800", "1280x720", "1920x1080", "3840x2160", "doe"]
DEFAULT_PRESET: Preset = "800x800"

# Size and period in pattern pixels. Lines and gaps keep their share of the period: the networks were trained on it.
PRESETS: dict[str, tuple[int, int, float]] = {
    "800x800": (800, 800, 20.0),
    "1280x720": (1280, 720, 20.0),  # a 16:9 projector: about 11 periods across a fifth of the image's width
    "1920x1080": (1920, 1080, 30.0),  # as many nodes: with more of them, codes do not stay far enough apart
    "3840x2160": (3840, 2160, 60.0),
    "doe": (
        800,
        800,
        25.0,
    ),  # a diffractive element blurs: wider lines, and fewer nodes
}
LINE_SHARE, GAP_SHARE = 0.2, 0.3  # of the period
MOST_NODES = 64 * 36
"""An array with more nodes hardly reaches `codes.FULL_MARGINS`."""


def make_grid(
    preset: Preset = DEFAULT_PRESET,
    w: int | None = None,
    h: int | None = None,
    period: float | None = None,
    line_width: float | None = None,
    gap: float | None = None,
    seed: int = 0,
) -> GridPattern:
    """The grid of a preset, with other values where given. Raises UserError for a grid that cannot be drawn."""
    preset_w, preset_h, preset_period = PRESETS[preset]
    period = preset_period if period is None else period
    w, h = preset_w if w is None else w, preset_h if h is None else h
    if not 2 <= period <= max(w, h):
        raise UserError(f"--period {period:g}: give 2 pixels or more, and less than the pattern's {max(w, h)}")
    if max(w, h) / period > MAX_NODES or w * h > MAX_PIXELS:
        raise UserError(f"a {w} x {h} pattern of period {period:g} is too large: give at most {MAX_NODES} nodes a side")
    try:
        return GridPattern(
            w=w,
            h=h,
            period=period,
            line_width=LINE_SHARE * period if line_width is None else line_width,
            gap=GAP_SHARE * period if gap is None else gap,
            seed=seed,
        )
    except ValueError as error:
        raise UserError(f"--width, --height, --period, --line-width, --gap: {error}") from error


def make_gray_code(
    preset: Preset = DEFAULT_PRESET,
    w: int | None = None,
    h: int | None = None,
    cell: int = 2,
    order: SequenceName = "sl-pattern",
) -> GrayCode:
    """A Gray-code sequence of a preset's size, or of another. Raises UserError for one that cannot be."""
    preset_w, preset_h, _ = PRESETS[preset]
    try:
        return GrayCode.in_order(order, preset_w if w is None else w, preset_h if h is None else h, cell)
    except ValueError as error:
        raise UserError(f"--width, --height, --cell: {error}") from error


def longer_period(w: int, h: int) -> int:
    """The shortest whole period, in pixels, with which a pattern of this size has no more than MOST_NODES."""
    period = math.ceil(math.sqrt(w * h / MOST_NODES))
    while (w // period) * (h // period) > MOST_NODES:
        period += 1
    return period
