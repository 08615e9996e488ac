"""The folders that sl-pattern writes, and what it says about each."""

import io
import shlex
from pathlib import Path

import numpy as np
from numpy import ndarray
from PIL import Image

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.new_folder import NewFolder
from sl_nerfstudio.pattern.board_page import description, encode_board, lay_out
from sl_nerfstudio.pattern.board_values import counts, millimetres
from sl_nerfstudio.pattern.boards import Board, CharucoBoard, Chessboard
from sl_nerfstudio.pattern.codes import FULL_MARGINS
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.pattern.presets import PRESETS, longer_period

_SUPERSAMPLING = 4  # of pattern.png
_DEFAULT_COUNTS = {"chessboard": "9x6", "charuco": "11x8"}
_DEFAULT_DICTIONARY = "5X5_1000"
_MARKER = 0.75  # of a square
_DIGITS = 6  # of lengths on boards: what is drawn is exactly what the text and the command say


def write_pattern(output: Path, layout: PatternLayout, print_width: float | None) -> str:
    """Write a pattern that is projected into a new folder; returns what to say."""
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


def require_pattern(folder: Path, layout: PatternLayout) -> None:
    """Raise UserError unless the folder holds this very pattern."""
    found = read_layout(folder / "pattern.json")
    if found.encode() != layout.encode():
        raise UserError(
            f"{folder}: holds {found.description} of {found.w} x {found.h} pixels that is not the one of these flags\n"
            "    cause:  it was written with other flags\n"
            "    remedy: leave out all flags but --output, --show and --every to show what the folder holds, or choose "
            "another output"
        )


def margin_warning(grid: GridPattern) -> str:
    """What to say about codes that are more alike than those of the presets; "" if they are not."""
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


def write_board(
    output: Path,
    print_width: float | None,
    kind: str,
    size: str | None,
    square: str | None,
    marker: str | None,
    dictionary: str | None,
) -> str:
    """A calibration board in true size; returns what to say. Raises UserError for boards that cannot be."""
    board = _board(print_width, kind, size or _DEFAULT_COUNTS[kind], square, marker, dictionary)
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
        f"below by what it is / 100 mm\nglue the print to something flat, capture it from many sides, then run\n"
        f"    {calibrate_command(board)}"
    )


def calibrate_command(board: Board) -> str:
    """The command that calibrates with captures of the board."""
    if isinstance(board, Chessboard):
        flags = ["--board", "chessboard", "--corners", f"{board.columns}x{board.rows}"]
        last = []
    else:
        flags = ["--board", "charuco", "--squares", f"{board.columns}x{board.rows}"]
        last = ["--marker", f'"{board.marker:g} mm"', "--dictionary", shlex.quote(board.dictionary)]
    lengths = ["--square", f'"{board.square:g} mm"', *last]
    end = ["--pattern", "pattern.json", "--output", "intrinsics.json"]
    return " ".join(["sl-calibrate", "--images", "captures", *flags, *lengths, *end])


def _board(
    print_width: float | None, kind: str, size: str, square: str | None, marker: str | None, dictionary: str | None
) -> Board:
    columns, rows = counts(size, "--corners" if kind == "chessboard" else "--squares")
    across = columns + 1 if kind == "chessboard" else columns
    if (print_width is None) == (square is None):
        raise UserError(
            f"--kind {kind}: give either --print-width, the width of all {across} squares together in millimetres, or "
            '--square, the side of one of them with its unit ("18 mm"); --print-width 180 suits A4 paper'
        )
    side = print_width / max(across, 1) if print_width is not None else millimetres(square or "", "--square")
    side = _rounded(side)
    try:
        if kind == "chessboard":
            return Chessboard(columns, rows, side)
        markers = millimetres(marker, "--marker") if marker is not None else _MARKER * side
        return CharucoBoard(columns, rows, side, _rounded(markers), dictionary or _DEFAULT_DICTIONARY)
    except ValueError as error:
        raise UserError(f"--kind {kind}: {error}") from error


def _rounded(length: float) -> float:
    return float(f"{length:.{_DIGITS}g}")


def _image_file(image: ndarray, print_width: float | None) -> bytes:
    """A PNG file that says how wide to print it."""
    buffer = io.BytesIO()
    per_inch = None if print_width is None else image.shape[1] / print_width * 25.4
    Image.fromarray(image).save(buffer, "PNG", **({} if per_inch is None else {"dpi": (per_inch, per_inch)}))
    return buffer.getvalue()
