"""sl-pattern: write a pattern to project or to print, and its description."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import tyro

from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.sequence import SequenceName

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
    """folder to write; it must be new or empty"""
    kind: Literal["grid", "gray-code", "chessboard", "charuco"] = "grid"
    """grid: one static pattern, for devices moved by hand; gray-code: a sequence, for devices that stand still while
    each frame is captured; chessboard, charuco: boards for calibration"""
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


def main() -> None:
    """Entry point of the command."""
    run(_write)


def _write() -> None:
    arguments = tyro.cli(Arguments, prog="sl-pattern")
    _check(arguments)
    from sl_nerfstudio.cli.pattern_folder import write_board, write_gray_code, write_grid  # numpy, OpenCV

    a = arguments
    if a.kind == "grid":
        lengths = a.width, a.height, a.period, a.line_width, a.gap
        said = write_grid(a.output, a.print_width, a.preset, *lengths, a.seed or 0)
    elif a.kind == "gray-code":
        cell = 2 if a.cell is None else a.cell
        order = a.sequence or "sl-pattern"
        said = write_gray_code(a.output, a.print_width, a.preset, a.width, a.height, cell, order)
    else:
        said = write_board(a.output, a.print_width, a.kind, a.corners or a.squares, a.square, a.marker, a.dictionary)
    print(said)


def _check(arguments: Arguments) -> None:
    """Raise UserError for flags that the kind of pattern has not, and for numbers that mean nothing."""
    fitting = ("output", "kind", *_FLAGS[arguments.kind])
    for field in fields(arguments):
        if field.name not in fitting and getattr(arguments, field.name) is not None:
            own = ", ".join(_flag(name) for name in _FLAGS[arguments.kind])
            raise UserError(
                f"{_flag(field.name)}: has no meaning for --kind {arguments.kind}\n"
                f"    cause:  the flag belongs to another kind of pattern\n    remedy: leave it out; flags are {own}"
            )
    if arguments.seed is not None and arguments.seed < 0:
        raise UserError(f"--seed {arguments.seed}: seeds are at least 0")
    if arguments.print_width is not None and not 0 < arguments.print_width < float("inf"):
        raise UserError(f"--print-width {arguments.print_width:g}: give a width in millimetres above 0")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


if __name__ == "__main__":
    main()
