"""Calibration boards: a chessboard, and a ChArUco board, whose white squares hold numbered markers.

Positions are millimetres on the board's plane, x right and y down from the outer corner of its upper left square.
"""

import io
import json
import math
import re
import zlib
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan.lengths import parse_length

# What a user types about a board: "9x7" and "75 mm".

_COUNTS = re.compile(r"(\d{1,4}) *[xX\u00d7] *(\d{1,4})")
_LEAST_METRES, _MOST_METRES = 1e-9, 100.0  # of a board's squares


def millimetres(text: str, flag: str) -> float:
    """A length with its unit, such as "75 mm", in millimetres. Raises UserError that names the flag."""
    return 1e3 * parse_length(text, f'{flag} "{text}"', _LEAST_METRES, _MOST_METRES).metres


def counts(text: str, flag: str) -> tuple[int, int]:
    """Numbers from left to right and from top to bottom, such as "9x7". Raises UserError that names the flag."""
    found = _COUNTS.fullmatch(text.strip())
    if found is None:
        raise UserError(
            f'{flag} "{text}": is no pair of numbers\n    cause:  a typing error\n'
            f"    remedy: write for example {flag} 9x7, the number from left to right first"
        )
    return int(found[1]), int(found[2])


MOST_SQUARES = 100  # a side
DICTIONARIES = tuple(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_"))
"""Names of OpenCV's sets of markers: "5X5_1000" has 1000 markers of 5 x 5 bits."""


@dataclass(frozen=True)
class _Checkered:
    """What boards of alternating squares have in common."""

    columns: int
    rows: int
    square: float  # side of a square, mm

    @property
    def squares(self) -> tuple[int, int]:
        """Number of squares from left to right and from top to bottom."""
        return self.columns, self.rows

    @property
    def _first_is_black(self) -> bool:
        return True

    def corners(self) -> Float64[ndarray, "n 2"]:
        """(x, y) in mm of every corner where four squares meet, row by row."""
        columns, rows = self.squares
        x, y = np.meshgrid(np.arange(1, columns), np.arange(1, rows))
        return np.stack([x.ravel(), y.ravel()], -1) * float(self.square)

    def black(self) -> Bool[ndarray, "rows columns"]:
        """Mask of the black squares."""
        columns, rows = self.squares
        return np.add.outer(np.arange(rows), np.arange(columns)) % 2 == int(not self._first_is_black)

    def black_areas(self) -> Float64[ndarray, "n 4"]:
        """Rectangles in mm (left, top, right, bottom) that do not overlap and are together all that is black."""
        return _areas(self.black(), self.square)

    def _check(self, least: int, what: str) -> None:
        if not least <= min(self.columns, self.rows) <= max(self.columns, self.rows) <= MOST_SQUARES:
            raise ValueError(f"a board has {least} to {MOST_SQUARES} {what} a side, got {self.columns} x {self.rows}")
        if not 0 < self.square < float("inf"):
            raise ValueError(f"squares must be larger than 0 mm, got {self.square:g} mm")


@dataclass(frozen=True)
class Chessboard(_Checkered):
    """A chessboard with `columns` x `rows` inner corners, where four squares meet; the upper left square is black.

    Where both numbers are even, or both are odd, it looks the same after half a turn.
    """

    def __post_init__(self) -> None:
        """Raises ValueError for a board that no detector finds."""
        self._check(least=3, what="inner corners")

    @property
    def squares(self) -> tuple[int, int]:
        """Number of squares from left to right and from top to bottom."""
        return self.columns + 1, self.rows + 1


@dataclass(frozen=True)
class CharucoBoard(_Checkered):
    """A chessboard of `columns` x `rows` squares with a marker in every white square, numbered row by row.

    OpenCV numbers its corners as `corners` lists them.
    """

    marker: float  # side of a marker with its black border, mm
    dictionary: str  # set of the markers, one of DICTIONARIES
    legacy: bool = False  # OpenCV before 4.6: the upper left square is white if the number of rows is even

    def __post_init__(self) -> None:
        """Raises ValueError for a board that cannot be printed or detected."""
        self._check(least=2, what="squares")
        if self.dictionary not in DICTIONARIES:
            raise ValueError(f"there is no dictionary {self.dictionary}; OpenCV's are {', '.join(DICTIONARIES)}")
        if not 0 < self.marker < self.square:
            raise ValueError(f"markers must be smaller than squares ({self.square:g} mm), got {self.marker:g} mm")
        count, available = int((~self.black()).sum()), len(self._markers.bytesList)
        if count > available:
            raise ValueError(f"the board has {count} white squares, but {self.dictionary} has {available} markers")

    @property
    def _first_is_black(self) -> bool:
        return not (self.legacy and self.rows % 2 == 0)

    def black_areas(self) -> Float64[ndarray, "n 4"]:
        """Rectangles in mm (left, top, right, bottom) that do not overlap and are together all that is black."""
        places = np.argwhere(~self.black())
        module = self.marker / (self._markers.markerSize + 2)
        indent = (self.square - self.marker) / 2
        markers = [
            _areas(self._bits(number), module) + np.tile(place[::-1] * self.square + indent, 2)
            for number, place in enumerate(places)
        ]
        return np.concatenate([super().black_areas(), *markers])

    @cached_property
    def _markers(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))

    def _bits(self, number: int) -> Bool[ndarray, "bits bits"]:
        """Mask of a marker's black cells; one cell of border on each side."""
        return cv2.aruco.generateImageMarker(self._markers, number, self._markers.markerSize + 2, borderBits=1) == 0


Board = Chessboard | CharucoBoard


def draw_board(board: Board, pixels_per_square: int, margin: int = 1) -> UInt8[ndarray, "h w"]:
    """The board as an image, 0 and 255, with a white margin of `margin` squares; squares end where pixels end.

    The position (0, 0) of the board lies `margin * pixels_per_square` pixels right of and below the image's corner.
    """
    columns, rows = (pixels_per_square * (count + 2 * margin) for count in board.squares)
    image = np.full((rows, columns), 255, dtype=np.uint8)
    pixels = np.rint((board.black_areas() / board.square + margin) * pixels_per_square).astype(np.int64)
    for left, top, right, bottom in pixels:
        image[top:bottom, left:right] = 0
    return image


def _areas(black: Bool[ndarray, "rows columns"], side: float) -> Float64[ndarray, "n 4"]:
    """Rectangles around the black cells, which are squares of `side`; neighbours in a row share one rectangle."""
    edges = np.diff(np.pad(black, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, left = np.nonzero(edges == 1)
    right = np.nonzero(edges == -1)[1]
    return np.stack([left, row, right, row + 1], -1) * float(side)


# A page of black rectangles and text in millimetres, as a vector PDF and as a PNG, both in true size.

MOST_MILLIMETRES = 5000.0  # a side; PDF ends at 14400 points
_POINTS = 72 / 25.4  # per millimetre


@dataclass(frozen=True)
class Line:
    """A line of text; lengths in mm from the page's upper left corner."""

    text: str  # ASCII
    left: float
    baseline: float
    size: float


@dataclass(frozen=True, eq=False)
class PrintedPage:
    """A page to print; lengths in mm, x right and y down from the page's upper left corner."""

    width: float
    height: float
    black: Float64[ndarray, "n 4"]  # left, top, right, bottom
    lines: tuple[Line, ...] = ()

    def pdf(self) -> bytes:
        """A PDF file of one page of exactly this size, without bitmaps."""
        objects = [
            b"<< /Type /Catalog /Pages 2 0 R >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            b"<< /Type /Page /Parent 2 0 R /Contents 4 0 R /Resources << /Font << /F 5 0 R >> >> "
            + f"/MediaBox [0 0 {self.width * _POINTS:.4f} {self.height * _POINTS:.4f}] >>".encode(),
            _stream(self._drawing()),
            b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        ]
        text, places = b"%PDF-1.4\n", []
        for number, content in enumerate(objects, 1):
            places.append(len(text))
            text += b"%d 0 obj\n%b\nendobj\n" % (number, content)
        size = len(objects) + 1
        table = b"0000000000 65535 f \n" + b"".join(b"%010d 00000 n \n" % place for place in places)
        end = b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (size, len(text))
        return text + b"xref\n0 %d\n%b" % (size, table) + end

    def _drawing(self) -> bytes:
        """PDF's drawing commands. All rectangles are one path, so that no seams show between neighbours."""
        left, top, right, bottom = self.black.T
        areas = np.stack([left, top, right - left, bottom - top], -1)
        commands = [f"{_POINTS:.9f} 0 0 {-_POINTS:.9f} 0 {self.height * _POINTS:.4f} cm", "0 g"]
        commands += [" ".join(f"{value:.6f}" for value in area) + " re" for area in areas]
        commands += ["f"] if len(areas) else []
        for line in self.lines:
            escaped = line.text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
            commands.append(f"BT /F {line.size:g} Tf 1 0 0 -1 {line.left:.4f} {line.baseline:.4f} Tm ({escaped}) Tj ET")
        return "\n".join(commands).encode("ascii")

    def png(self, pixels_per_mm: float) -> bytes:
        """A PNG file that states its resolution; edges of rectangles are rounded to whole pixels."""
        size = round(self.width * pixels_per_mm), round(self.height * pixels_per_mm)
        image = np.full(size[::-1], 255, dtype=np.uint8)
        for left, top, right, bottom in np.rint(self.black * pixels_per_mm).astype(np.int64):
            image[top:bottom, left:right] = 0
        picture = Image.fromarray(image)
        draw = ImageDraw.Draw(picture)
        for line in self.lines:
            font = ImageFont.load_default(line.size * pixels_per_mm)
            draw.text((line.left * pixels_per_mm, line.baseline * pixels_per_mm), line.text, 0, font, anchor="ls")
        buffer = io.BytesIO()
        picture.save(buffer, "PNG", dpi=(pixels_per_mm * 25.4, pixels_per_mm * 25.4))
        return buffer.getvalue()


def _stream(content: bytes) -> bytes:
    packed = zlib.compress(content)
    return b"<< /Length %d /Filter /FlateDecode >>\nstream\n%b\nendstream" % (len(packed), packed)


# The page on which a board is printed: a white margin, a ruler that shows the printer's scaling, and what it is.

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
    """Describe the board in one line."""
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
