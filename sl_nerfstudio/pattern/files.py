"""pattern.json: the description of a pattern, kept beside its picture so that a decoder knows the codes."""

import math
from pathlib import Path
from typing import Any, Literal

from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import MAX_NODES, MAX_PIXELS, GridPattern
from sl_nerfstudio.pattern.layout import FORMAT, PatternLayout, SequenceName
from sl_nerfstudio.scan.document import Faults, FileError, document_faults, read_document
from sl_nerfstudio.scan.images import ENDINGS, as_grey, read_image

# Coded grids and Gray-code sequences for common projectors.

Preset = Literal["800x800", "1280x720", "1920x1080", "3840x2160", "doe"]
DEFAULT_PRESET: Preset = "800x800"

# Size and period in pattern pixels. Lines and gaps keep their share of the period: the networks were trained on it.
PRESETS: dict[str, tuple[int, int, float]] = {
    "800x800": (800, 800, 20.0),
    "1280x720": (1280, 720, 20.0),  # a 16:9 projector: about 11 periods across a fifth of the image's width
    "1920x1080": (1920, 1080, 30.0),  # as many nodes: with more of them, codes do not stay far enough apart
    "3840x2160": (3840, 2160, 60.0),
    "doe": (800, 800, 25.0),  # a diffractive element blurs: wider lines, and fewer nodes
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


LAYOUTS: dict[str, type[PatternLayout]] = {GridPattern.kind: GridPattern, GrayCode.kind: GrayCode}
"""Every kind of pattern that pattern.json can describe."""


def read_layout(path: Path | str) -> PatternLayout:
    """The pattern that a pattern.json describes, which must be what sl-pattern makes of its own parameters.

    Raises UserError that names file and field.
    """
    path = Path(path)
    document = _read_document(path)
    try:
        return LAYOUTS[document["kind"]].from_document(document)
    except KeyError as error:
        raise UserError(f"{path}: {error.args[0]} is missing; write the file again with sl-pattern") from error
    except (TypeError, ValueError, IndexError) as error:
        raise UserError(f"{path}: the description contradicts itself: {error}") from error


def read_pattern(path: Path) -> tuple[Float32[ndarray, "h w"], PatternLayout | None]:
    """A pattern in [0, 1] from pattern.json or from any image; a plain image has no layout.

    Raises UserError if the file cannot be read.
    """
    if path.suffix.lower() == ".json":
        layout = read_layout(path)
        return layout.render(), layout
    return as_grey(read_image(path)), None


def _read_document(path: Path) -> dict[str, Any]:
    if path.suffix.lower() in ENDINGS:
        raise FileError(
            path,
            "is a picture; the codes of a pattern are in its pattern.json",
            "the picture of the pattern was given instead of its description",
            "give the pattern.json that sl-pattern or sl-synth wrote beside it",
        )
    document = read_document(path)
    faults = Faults()
    document_faults(document, path.name, faults)
    if faults.found:
        fault = faults.found[0]
        raise FileError(path, f"{fault.field}: {fault.problem}", fault.cause, "write the file again with sl-pattern")
    if document.get("kind") not in tuple(LAYOUTS):
        known = ", ".join(f'"{kind}"' for kind in LAYOUTS)
        raise UserError(
            f'{path}: this describes no pattern: "kind" must be one of {known}; '
            "give the pattern.json that sl-pattern or sl-synth wrote"
        )
    if document.get("sl_pattern") != FORMAT:
        found = f"is {document['sl_pattern']!r}" if "sl_pattern" in document else "is missing"
        raise UserError(
            f"{path}: sl_pattern, the version of the file's format, {found}; this version reads {FORMAT}\n"
            f'    remedy: write the file again with sl-pattern; in one written by hand, add "sl_pattern": {FORMAT}'
        )
    return document
