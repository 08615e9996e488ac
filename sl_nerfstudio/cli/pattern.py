"""sl-pattern: write a pattern to project or to print, and its description."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.sequence import SequenceName

if TYPE_CHECKING:
    from sl_nerfstudio.pattern.layout import PatternLayout

Kind = Literal["grid", "gray-code", "chessboard", "charuco"]
_GRID_FLAGS = ("preset", "width", "height", "period", "line_width", "gap", "seed", "print_width")
_BOARD_FLAGS = ("print_width", "square")
_FLAGS = {
    "grid": _GRID_FLAGS,
    "gray-code": ("preset", "width", "height", "cell", "sequence", "print_width"),
    "chessboard": (*_BOARD_FLAGS, "corners"),
    "charuco": (*_BOARD_FLAGS, "squares", "marker", "dictionary"),
}


@dataclass(frozen=True)
class Arguments:
    """Write a pattern to project, or a board to print.

    grid and gray-code: pattern.png and pattern.json, which sl-process needs to decode captures; for Gray code, all
    images of the sequence, too, in sequence/. Lengths are in pattern pixels. chessboard and charuco: board.pdf and
    board.png in true size, for sl-calibrate, and board.json, which says what the board is.
    """

    output: Path
    """folder to write; it must be new or empty, but with --show it may hold this very pattern"""
    kind: Kind | None = None
    """grid (the default): one static pattern, for devices moved by hand; gray-code: a sequence, for devices that stand
    still while each frame is captured; chessboard, charuco: boards for calibration"""
    preset: Literal["800x800", "1280x720", "1920x1080", "3840x2160", "doe"] | None = None
    """size and period for a square projector, for 16:9 projectors (720p, 1080p, 4K), or for a diffractive element;
    default: 800x800"""
    width: int | None = None
    """width of the pattern; default: the preset's"""
    height: int | None = None
    """height of the pattern; default: the preset's"""
    period: float | None = None
    """distance between neighbouring grid lines; default: the preset's"""
    line_width: float | None = None
    """width of the lines; default: a fifth of the period"""
    gap: float | None = None
    """how far line segments are shifted against each other at a crossing; default: three tenths of the period"""
    seed: int | None = None
    """selects one of the possible code arrays; default: 0"""
    cell: int | None = None
    """side of the squares that Gray code numbers; default: 2"""
    sequence: SequenceName | None = None
    """order of the images of a Gray code, by the program that shows them so; default: sl-pattern"""
    print_width: float | None = None
    """width on paper or slide in millimetres: of a pattern, for printing programs, or of all squares of a board"""
    corners: str | None = None
    """inner corners of a chessboard, where four squares meet, from left to right x from top to bottom; default: 9x6"""
    squares: str | None = None
    """squares of a ChArUco board, from left to right x from top to bottom; default: 11x8"""
    square: str | None = None
    """side of a board's squares with its unit, such as "20 mm", instead of --print-width"""
    marker: str | None = None
    """side of a ChArUco board's markers with its unit; default: three quarters of a square"""
    dictionary: str | None = None
    """OpenCV's name of the set of markers; default: 5X5_1000"""
    show: int | None = None
    """number of a display on which to show the pattern, full screen and pixel for pixel, until Escape is pressed; 0 is
    the first, and 1 usually the projector. Without --preset, --width and --height, the pattern gets its size"""
    every: float | None = None
    """seconds that each image of a Gray-code sequence is shown; default: until a key is pressed"""

    @property
    def shown_kind(self) -> Kind:
        """The kind of pattern, or its default."""
        return self.kind or "grid"

    @property
    def is_board(self) -> bool:
        """Whether it is printed, not projected."""
        return self.shown_kind in ("chessboard", "charuco")


def main() -> None:
    """Entry point of the command."""
    run(_write)


def _write() -> None:
    arguments = tyro.cli(Arguments, prog="sl-pattern")
    _check(arguments)
    if arguments.show is not None:
        _show(arguments, arguments.show)
    elif arguments.is_board:
        from sl_nerfstudio.cli.pattern_folder import write_board  # numpy, OpenCV

        a = arguments
        counts = a.corners or a.squares
        print(write_board(a.output, a.print_width, a.shown_kind, counts, a.square, a.marker, a.dictionary))
    else:
        from sl_nerfstudio.cli.pattern_folder import write_pattern

        print(write_pattern(arguments.output, _layout(arguments), arguments.print_width))


def _layout(arguments: Arguments, display: tuple[int, int] | None = None) -> "PatternLayout":
    """The pattern that the flags describe; without a size, that of the display, which is otherwise the preset's."""
    from sl_nerfstudio.pattern.presets import DEFAULT_PRESET, longer_period, make_gray_code, make_grid

    a = arguments
    w, h, period = a.width, a.height, a.period
    if display is not None and a.preset is None and w is None and h is None:
        w, h = display
        period = float(longer_period(w, h)) if period is None else period
    preset = a.preset or DEFAULT_PRESET
    if a.shown_kind == "gray-code":
        return make_gray_code(preset, w, h, 2 if a.cell is None else a.cell, a.sequence or "sl-pattern")
    return make_grid(preset, w, h, period, a.line_width, a.gap, a.seed or 0)


def _show(arguments: Arguments, display: int) -> None:
    """Show the pattern of a folder, which is written first if it is new."""
    from sl_nerfstudio.capture.windows import display_size, offset_on
    from sl_nerfstudio.cli.pattern_folder import require_pattern, write_pattern
    from sl_nerfstudio.cli.pattern_show import show_folder

    size = display_size(display)
    described = any(getattr(arguments, name) is not None for name in ("kind", *_FLAGS[arguments.shown_kind]))
    if not (arguments.output / "pattern.json").exists():
        layout = _layout(arguments, size)
        offset_on(size, (layout.w, layout.h))  # refused before it is written
        print(write_pattern(arguments.output, layout, arguments.print_width))
    elif described:
        require_pattern(arguments.output, _layout(arguments, size))
    show_folder(arguments.output, display, arguments.every)


def _check(arguments: Arguments) -> None:
    """Raise UserError for flags that the kind of pattern has not, and for numbers that mean nothing."""
    kind = arguments.shown_kind
    fitting = ("output", "kind", *_FLAGS[kind], *(() if arguments.is_board else ("show", "every")))
    for field in fields(arguments):
        if field.name not in fitting and getattr(arguments, field.name) is not None:
            own = ", ".join(_flag(name) for name in fitting[2:])
            raise UserError(
                f"{_flag(field.name)}: has no meaning for --kind {kind}\n"
                f"    cause:  the flag belongs to another kind of pattern\n    remedy: leave it out; flags are {own}"
            )
    if arguments.every is not None and (arguments.show is None or not 0 < arguments.every < float("inf")):
        raise UserError(f"--every {arguments.every:g}: give seconds above 0, together with --show")
    if arguments.seed is not None and arguments.seed < 0:
        raise UserError(f"--seed {arguments.seed}: seeds are at least 0")
    if arguments.print_width is not None and not 0 < arguments.print_width < float("inf"):
        raise UserError(f"--print-width {arguments.print_width:g}: give a width in millimetres above 0")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


if __name__ == "__main__":
    main()
