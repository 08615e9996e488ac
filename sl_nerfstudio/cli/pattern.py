"""sl-pattern: write a pattern to project or to print, and its description."""

import io
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sl_nerfstudio.cli.arguments import flag_name, parse
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.console import command, next_steps, phase
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.layout import SequenceName

if TYPE_CHECKING:
    from numpy import ndarray

    from sl_nerfstudio.pattern.boards import Board
    from sl_nerfstudio.pattern.grid import GridPattern
    from sl_nerfstudio.pattern.layout import PatternLayout


# The folders that sl-pattern writes, and what it says about each.

_SUPERSAMPLING = 4  # of pattern.png
_DEFAULT_COUNTS = {"chessboard": "9x6", "charuco": "11x8"}
_DEFAULT_DICTIONARY = "5X5_1000"
_MARKER = 0.75  # of a square
_DIGITS = 6  # of lengths on boards: what is drawn is exactly what the text and the command say


def write_pattern(output: Path, layout: "PatternLayout", print_width: float | None) -> str:
    """Write a pattern that is projected into a new folder; returns what to say."""
    import numpy as np

    from sl_nerfstudio.pattern.gray_code import GrayCode
    from sl_nerfstudio.pattern.grid import GridPattern
    from sl_nerfstudio.storage import NewFolder

    with NewFolder(output) as folder:
        for index, image in enumerate(layout.sequence() if isinstance(layout, GrayCode) else ()):
            folder.write(f"sequence/{index:02d}.png", _image_file(image, print_width))
        picture = np.rint(255 * layout.render(_SUPERSAMPLING)).astype(np.uint8)
        folder.write("pattern.png", _image_file(picture, print_width))
        folder.write("pattern.json", layout.encode(), last=True)
    if isinstance(layout, GrayCode):
        return (
            f"wrote a Gray-code sequence of {layout.images} images to {output}: show them in the order of their names"
        )
    if not isinstance(layout, GridPattern):
        raise TypeError(f"{layout.description} is not written by this command")
    upright, rolled = layout.margins
    return (
        f"wrote a grid of {layout.columns} x {layout.rows} nodes to {output}: 3 x 3 windows differ in at least "
        f"{upright} of 9 symbols, in {rolled} where the camera may roll{margin_warning(layout)}"
    )


def require_pattern(folder: Path, layout: "PatternLayout") -> None:
    """Raise UserError unless the folder holds this very pattern."""
    from sl_nerfstudio.pattern.files import read_layout

    found = read_layout(folder / "pattern.json")
    if found.encode() != layout.encode():
        raise UserError(
            f"{folder}: holds {found.description} of {found.w} x {found.h} pixels that is not the one of these flags\n"
            "    cause:  it was written with other flags\n"
            "    remedy: leave out all flags but --output, --show and --every to show what the folder holds, or choose "
            "another output"
        )


def margin_warning(grid: "GridPattern") -> str:
    """What to say about codes that are more alike than those of the presets; "" if they are not."""
    from sl_nerfstudio.pattern.codes import FULL_MARGINS
    from sl_nerfstudio.pattern.files import PRESETS, longer_period

    if grid.margins >= FULL_MARGINS:
        return ""
    period = longer_period(grid.w, grid.h)
    suits = [name for name, (w, h, _) in PRESETS.items() if (w, h) == (grid.w, grid.h)]
    presets = f", as --preset {suits[0]} does" if suits else ""
    return (
        f"\nwarning: misread symbols are mistaken for other places more easily than with the presets, whose windows "
        f"differ in {FULL_MARGINS[0]} symbols, in {FULL_MARGINS[1]} where the camera may roll\n"
        f"    cause:  {grid.columns} x {grid.rows} nodes are too many for five symbols\n"
        f"    remedy: give --period {period} or more{presets}"
    )


def write_board(arguments: "PatternArguments") -> str:
    """A calibration board in true size; returns what to say. Raises UserError for boards that cannot be."""
    from sl_nerfstudio.pattern.boards import description, encode_board, lay_out
    from sl_nerfstudio.storage import NewFolder

    board, output = _board(arguments), arguments.output
    with NewFolder(output) as folder:
        try:
            laid_out = lay_out(board)
        except ValueError as error:
            raise UserError(f"--print-width, --square: {error}") from error
        page = laid_out.page
        folder.write("board.pdf", page.pdf())
        folder.write("board.png", page.png(laid_out.pixels_per_mm))
        folder.write("board.json", encode_board(board), last=True)
    paper = f"{laid_out.paper}, {'upright' if page.height > page.width else 'on its side'}"
    if not laid_out.paper:
        paper = f"a page of {page.width:g} x {page.height:g} mm"
    return (
        f"wrote a {description(board)} to {output}\n"
        f"print board.pdf at 100 % ({paper}), and measure its ruler: if it is not 100 mm long, multiply all lengths "
        f"below by what it is / 100 mm\nglue the print to something flat, and capture it from many sides under a "
        f"pattern (sl-pattern --kind gray-code)\n{next_steps([calibrate_command(board)])}"
    )


def calibrate_command(board: "Board", images: Path | str = "captures", pattern: Path | str = "pattern.json") -> str:
    """The command that calibrates with captures of the board."""
    from sl_nerfstudio.pattern.boards import Chessboard

    size, square = f"{board.columns}x{board.rows}", f"{board.square:g} mm"
    if isinstance(board, Chessboard):
        flags = ["--board", "chessboard", "--corners", size, "--square", square]
    else:
        marker = ["--marker", f"{board.marker:g} mm", "--dictionary", board.dictionary]
        flags = ["--board", "charuco", "--squares", size, "--square", square, *marker]
    end = ["--pattern", pattern, "--output", "intrinsics.json"]
    return command("sl-calibrate", "--images", images, *flags, *end)


def _board(arguments: "PatternArguments") -> "Board":
    from sl_nerfstudio.pattern.boards import CharucoBoard, Chessboard, counts, millimetres

    a, kind = arguments, arguments.shown_kind
    size = a.corners or a.squares or _DEFAULT_COUNTS[kind]
    columns, rows = counts(size, "--corners" if kind == "chessboard" else "--squares")
    across = columns + 1 if kind == "chessboard" else columns
    if (a.print_width is None) == (a.square is None):
        raise UserError(
            f"--kind {kind}: give either --print-width, the width of all {across} squares together in millimetres, or "
            '--square, the side of one of them with its unit ("18 mm"); --print-width 180 suits A4 paper'
        )
    side = a.print_width / max(across, 1) if a.print_width is not None else millimetres(a.square or "", "--square")
    side = _rounded(side)
    try:
        if kind == "chessboard":
            return Chessboard(columns, rows, side)
        markers = millimetres(a.marker, "--marker") if a.marker is not None else _MARKER * side
        return CharucoBoard(columns, rows, side, _rounded(markers), a.dictionary or _DEFAULT_DICTIONARY)
    except ValueError as error:
        raise UserError(f"--kind {kind}: {error}") from error


def _rounded(length: float) -> float:
    return float(f"{length:.{_DIGITS}g}")


def _image_file(image: "ndarray", print_width: float | None) -> bytes:
    """A PNG file that says how wide to print it."""
    from PIL import Image

    buffer = io.BytesIO()
    per_inch = None if print_width is None else image.shape[1] / print_width * 25.4
    Image.fromarray(image).save(buffer, "PNG", **({} if per_inch is None else {"dpi": (per_inch, per_inch)}))
    return buffer.getvalue()


# sl-pattern --show: the pattern of a folder on a display.


def show_folder(folder: Path, display: int, every: float | None) -> None:
    """Show what a folder of sl-pattern holds until it is ended. Raises UserError if it cannot be shown."""
    from sl_nerfstudio.capture.screen import Screen, pattern_picture, show_sequence, show_still
    from sl_nerfstudio.pattern.files import read_layout
    from sl_nerfstudio.pattern.gray_code import GrayCode

    layout = read_layout(folder / "pattern.json")
    if every is not None and not isinstance(layout, GrayCode):
        raise UserError(f"--every {every:g}: {layout.description} is one image; leave it out")
    with Screen(display) as screen:
        print(_words(display, screen.size, (layout.w, layout.h)), flush=True)
        if isinstance(layout, GrayCode):
            names = layout.fields()["sequence"]
            print("Space and the right key show the next image, the left key the one before", flush=True)
            show_sequence(screen, list(layout.sequence()), every, lambda k: print(f"  {k:02d}  {names[k]}", flush=True))
            return
        show_still(screen, pattern_picture(folder / "pattern.json", layout))


def _words(display: int, screen: tuple[int, int], size: tuple[int, int]) -> str:
    from sl_nerfstudio.capture.screen import offset_on

    shown = f"showing {size[0]} x {size[1]} pixels on display {display}; Escape ends"
    if screen == size:
        return shown
    left, top = offset_on(screen, size)
    return (
        f"{shown}\nthe display has {screen[0]} x {screen[1]} pixels: the pattern lies in its middle, unscaled. Pixel "
        f"(0, 0) of the pattern is pixel ({left}, {top}) of the display; subtract this from a principal point that was "
        "calibrated with the whole display"
    )


Kind = Literal["grid", "gray-code", "chessboard", "charuco"]
_SIZE_FLAGS = ("preset", "width", "height")
_FLAGS = {
    "grid": (*_SIZE_FLAGS, "period", "line_width", "gap", "seed", "print_width"),
    "gray-code": (*_SIZE_FLAGS, "cell", "sequence", "print_width"),
    "chessboard": ("print_width", "square", "corners"),
    "charuco": ("print_width", "square", "squares", "marker", "dictionary"),
}


@dataclass(frozen=True)
class PatternArguments:
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


_HELP_GROUPS = {
    "patterns to project": ("kind", *_SIZE_FLAGS, "period", "line_width", "gap", "seed", "cell", "sequence"),
    "boards to print": ("corners", "squares", "square", "marker", "dictionary", "print_width"),
    "on a display": ("show", "every"),
}


def main() -> None:
    """Entry point of the command."""
    run(_write)


def _write() -> None:
    arguments = parse(PatternArguments, "sl-pattern", groups=_HELP_GROUPS)
    _check(arguments)
    if arguments.show is not None:
        _show(arguments, arguments.show)
        return
    with phase("draw"):
        if arguments.is_board:
            said = write_board(arguments)
        else:
            written = write_pattern(arguments.output, _layout(arguments), arguments.print_width)
            said = f"{written}\n{_next(arguments)}"
    print(said)


def _next(arguments: PatternArguments) -> str:
    """Say how to go on with a pattern that is projected."""
    captured = ("sl-capture", "--camera", 0, "--output", "captures", "--pattern", arguments.output / "pattern.json")
    if arguments.shown_kind == "gray-code":
        return next_steps([command(*captured, "--show", 1)])
    shown = [] if arguments.print_width else [command("sl-pattern", "--output", arguments.output, "--show", 1)]
    return next_steps([*shown, command(*captured)])


def _layout(arguments: PatternArguments, display: tuple[int, int] | None = None) -> "PatternLayout":
    """The pattern that the flags describe; without a size, that of the display, which is otherwise the preset's."""
    from sl_nerfstudio.pattern.files import DEFAULT_PRESET, longer_period, make_gray_code, make_grid

    a = arguments
    w, h, period = a.width, a.height, a.period
    if display is not None and a.preset is None and w is None and h is None:
        w, h = display
        period = float(longer_period(w, h)) if period is None else period
    preset = a.preset or DEFAULT_PRESET
    if a.shown_kind == "gray-code":
        return make_gray_code(preset, w, h, 2 if a.cell is None else a.cell, a.sequence or "sl-pattern")
    return make_grid(preset, w, h, period, a.line_width, a.gap, a.seed or 0)


def _show(arguments: PatternArguments, display: int) -> None:
    """Show the pattern of a folder, which is written first if it is new."""
    from sl_nerfstudio.capture.screen import display_size, offset_on

    size = display_size(display)
    described = any(getattr(arguments, name) is not None for name in ("kind", *_FLAGS[arguments.shown_kind]))
    if not (arguments.output / "pattern.json").exists():
        layout = _layout(arguments, size)
        offset_on(size, (layout.w, layout.h))  # refused before it is written
        print(write_pattern(arguments.output, layout, arguments.print_width))
    elif described:
        require_pattern(arguments.output, _layout(arguments, size))
    show_folder(arguments.output, display, arguments.every)


def _check(arguments: PatternArguments) -> None:
    """Raise UserError for flags that the kind of pattern has not, and for numbers that mean nothing."""
    kind = arguments.shown_kind
    fitting = ("output", "kind", *_FLAGS[kind], *(() if arguments.is_board else ("show", "every")))
    for field in fields(arguments):
        if field.name not in fitting and getattr(arguments, field.name) is not None:
            own = ", ".join(flag_name(name) for name in fitting[2:])
            raise UserError(
                f"{flag_name(field.name)}: has no meaning for --kind {kind}\n"
                f"    cause:  the flag belongs to another kind of pattern\n    remedy: leave it out; flags are {own}"
            )
    if arguments.every is not None and (arguments.show is None or not 0 < arguments.every < float("inf")):
        raise UserError(f"--every {arguments.every:g}: give seconds above 0, together with --show")
    if arguments.seed is not None and arguments.seed < 0:
        raise UserError(f"--seed {arguments.seed}: seeds are at least 0")
    if arguments.print_width is not None and not 0 < arguments.print_width < float("inf"):
        raise UserError(f"--print-width {arguments.print_width:g}: give a width in millimetres above 0")


if __name__ == "__main__":
    main()
