"""Calibration boards: a chessboard, and a ChArUco board, whose white squares hold numbered markers.

Positions are millimetres on the board's plane, x right and y down from the outer corner of its upper left square.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from numpy import ndarray

MOST_SQUARES = 100  # a side
DICTIONARIES = tuple(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_"))
"""Names of OpenCV's sets of markers: "5X5_1000" has 1000 markers of 5 x 5 bits."""


@dataclass(frozen=True)
class Chessboard:
    """A chessboard with `columns` x `rows` inner corners, where four squares meet; the upper left square is black.

    Where both numbers are even, or both are odd, it looks the same after half a turn.
    """

    columns: int
    rows: int
    square: float  # side of a square, mm

    def __post_init__(self) -> None:
        """Raises ValueError for a board that no detector finds."""
        _check(self.columns, self.rows, self.square, least=3, what="inner corners")

    @property
    def squares(self) -> tuple[int, int]:
        """Number of squares from left to right and from top to bottom."""
        return self.columns + 1, self.rows + 1

    def corners(self) -> Float64[ndarray, "n 2"]:
        """(x, y) in mm of every inner corner, row by row."""
        return _grid_corners(self.columns, self.rows, self.square)

    def black(self) -> Bool[ndarray, "rows columns"]:
        """Which squares are black."""
        columns, rows = self.squares
        return np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0

    def black_areas(self) -> Float64[ndarray, "n 4"]:
        """Rectangles in mm (left, top, right, bottom) that do not overlap and are together all that is black."""
        return _areas(self.black(), self.square)


@dataclass(frozen=True)
class CharucoBoard:
    """A chessboard of `columns` x `rows` squares with a marker in every white square, numbered row by row."""

    columns: int
    rows: int
    square: float  # side of a square, mm
    marker: float  # side of a marker with its black border, mm
    dictionary: str  # set of the markers, one of DICTIONARIES
    legacy: bool = False  # OpenCV before 4.6: the upper left square is white if the number of rows is even

    def __post_init__(self) -> None:
        """Raises ValueError for a board that cannot be printed or detected."""
        _check(self.columns, self.rows, self.square, least=2, what="squares")
        if self.dictionary not in DICTIONARIES:
            raise ValueError(f"there is no dictionary {self.dictionary}; OpenCV's are {', '.join(DICTIONARIES)}")
        if not 0 < self.marker < self.square:
            raise ValueError(f"markers must be smaller than squares ({self.square:g} mm), got {self.marker:g} mm")
        count, available = int((~self.black()).sum()), len(self._markers.bytesList)
        if count > available:
            raise ValueError(f"the board has {count} white squares, but {self.dictionary} has {available} markers")

    @property
    def squares(self) -> tuple[int, int]:
        """Number of squares from left to right and from top to bottom."""
        return self.columns, self.rows

    def corners(self) -> Float64[ndarray, "n 2"]:
        """(x, y) in mm of every corner where four squares meet, row by row: the numbers that OpenCV gives them."""
        return _grid_corners(self.columns - 1, self.rows - 1, self.square)

    def black(self) -> Bool[ndarray, "rows columns"]:
        """Which squares are black."""
        first_is_white = self.legacy and self.rows % 2 == 0
        return np.add.outer(np.arange(self.rows), np.arange(self.columns)) % 2 == int(first_is_white)

    def black_areas(self) -> Float64[ndarray, "n 4"]:
        """Rectangles in mm (left, top, right, bottom) that do not overlap and are together all that is black."""
        places = np.argwhere(~self.black())
        module = self.marker / (self._markers.markerSize + 2)
        indent = (self.square - self.marker) / 2
        markers = [
            _areas(self._bits(number), module) + np.tile(place[::-1] * self.square + indent, 2)
            for number, place in enumerate(places)
        ]
        return np.concatenate([_areas(self.black(), self.square), *markers])

    @cached_property
    def _markers(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))

    def _bits(self, number: int) -> Bool[ndarray, "bits bits"]:
        """Which cells of a marker are black; one cell of border on each side."""
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


def _check(columns: int, rows: int, square: float, least: int, what: str) -> None:
    if not least <= min(columns, rows) <= max(columns, rows) <= MOST_SQUARES:
        raise ValueError(f"a board has {least} to {MOST_SQUARES} {what} a side, got {columns} x {rows}")
    if not 0 < square < float("inf"):
        raise ValueError(f"squares must be larger than 0 mm, got {square:g} mm")


def _grid_corners(columns: int, rows: int, square: float) -> Float64[ndarray, "n 2"]:
    """Corners of squares without those on the board's outline, row by row."""
    x, y = np.meshgrid(np.arange(1, columns + 1), np.arange(1, rows + 1))
    return np.stack([x.ravel(), y.ravel()], -1) * float(square)


def _areas(black: Bool[ndarray, "rows columns"], side: float) -> Float64[ndarray, "n 4"]:
    """Rectangles around the black cells, which are squares of `side`; neighbours in a row share one rectangle."""
    edges = np.diff(np.pad(black, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, left = np.nonzero(edges == 1)
    right = np.nonzero(edges == -1)[1]
    return np.stack([left, row, right, row + 1], -1) * float(side)
