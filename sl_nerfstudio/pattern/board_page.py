"""The page on which a board is printed: a white margin, a ruler that shows the printer's scaling, and what it is."""

import json
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.pattern.boards import Board, Chessboard
from sl_nerfstudio.pattern.printed_page import MOST_MILLIMETRES, Line, PrintedPage

FORMAT = 1  # of board.json
_PAPERS = {"A4": (297, 210), "A3": (420, 297), "A2": (594, 420), "A1": (841, 594), "A0": (1189, 841)}  # mm
_FOOT = 18.0  # mm at the lower edge of the page, for ruler and text
_INDENT = 12.0  # mm from the left edge of the page to both
_RULER, _THICK, _TICK, _LETTERS = 100.0, 0.25, 3.0, 3.2  # mm
_MOST_PIXELS = 40e6  # of the PNG
_FINEST = 600 / 25.4  # pixels per mm


@dataclass(frozen=True, eq=False)
class BoardPage:
    """A page with a board; `origin` is the board's outer upper left corner on it."""

    page: PrintedPage
    paper: str  # "A4"; "" for a board that fits no paper
    origin: tuple[float, float]  # mm
    pixels_per_mm: float  # of the PNG: a square is a whole number of pixels, and so is the way to the origin


def lay_out(board: Board) -> BoardPage:
    """The board on the smallest paper on which it has a margin of one square.

    Raises ValueError for a board that is too large for any page.
    """
    w, h = (count * board.square for count in board.squares)
    paper, width, height = _paper(w + 2 * board.square, h + 2 * board.square + _FOOT)
    if max(width, height) > MOST_MILLIMETRES:
        raise ValueError(f"a board of {w:g} x {h:g} mm is too large for a page: {MOST_MILLIMETRES:g} mm a side at most")
    pixels_per_square = math.floor(board.square * min(_FINEST, math.sqrt(_MOST_PIXELS / (width * height))))
    if pixels_per_square < 1:
        raise ValueError(f"squares of {board.square:g} mm are too small to print")
    pixel = board.square / pixels_per_square
    x, y = (round(free / 2 / pixel) * pixel for free in (width - w, height - _FOOT - h))
    black = np.concatenate([board.black_areas() + [x, y, x, y], _ruler(height)])
    letters = {"left": _INDENT, "size": _LETTERS}
    lines = (
        Line(description(board), baseline=height - _FOOT + 4, **letters),
        Line(f"{_RULER:g} mm", _INDENT + _RULER + 3, height - 6.5, _LETTERS),
        Line("print at 100 %; measure this", _INDENT + _RULER + 20, height - 6.5, _LETTERS),
    )
    return BoardPage(PrintedPage(width, height, black, lines), paper, (x, y), 1 / pixel)


def description(board: Board) -> str:
    """What the board is, in one line."""
    if isinstance(board, Chessboard):
        return f"chessboard, {board.columns} x {board.rows} inner corners, squares {board.square:g} mm"
    return (
        f"ChArUco board, {board.columns} x {board.rows} squares of {board.square:g} mm, "
        f"markers {board.marker:g} mm, dictionary {board.dictionary}{', legacy layout' if board.legacy else ''}"
    )


def encode_board(board: Board) -> bytes:
    """The text of board.json; lengths in mm."""
    head = {"sl_board": FORMAT, "kind": "chessboard" if isinstance(board, Chessboard) else "charuco"}
    size = f"{board.columns}x{board.rows}"
    if isinstance(board, Chessboard):
        fields = {"corners": size, "square_mm": board.square}
    else:
        fields = {
            "squares": size, "square_mm": board.square, "marker_mm": board.marker, "dictionary": board.dictionary,
            "legacy": board.legacy,
        }  # fmt: skip
    return f"{json.dumps({**head, **fields}, indent=1)}\n".encode()


def _paper(width: float, height: float) -> tuple[str, float, float]:
    """Name and size of the smallest paper, on its side or upright; without a name if all are too small."""
    for name, (long, short) in _PAPERS.items():
        for w, h in ((long, short), (short, long)):
            if width <= w and height <= h:
                return name, float(w), float(h)
    return "", max(width, _INDENT + 2 * _RULER), height


def _ruler(height: float) -> Float64[ndarray, "n 4"]:
    """A line with a mark every 10 mm; from the outer edge of the first mark to that of the last it is 100 mm long."""
    bottom = height - 6
    marks = np.linspace(_INDENT, _INDENT + _RULER - _THICK, 11)
    line = [[_INDENT, bottom - _THICK, _INDENT + _RULER, bottom]]
    return np.array(line + [[x, bottom - _TICK, x + _THICK, bottom - _THICK] for x in marks])
