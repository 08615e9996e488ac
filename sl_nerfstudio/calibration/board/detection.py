"""The corners of a board in a photograph, to a fraction of a pixel; the detectors are OpenCV's."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.pattern.boards import Board, CharucoBoard, Chessboard

LEAST_CORNERS = 8  # of a ChArUco board of which only a part is in view
_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
_SEARCHED = 1600  # longest side of the image in which a chessboard is searched; it is measured in the full one
_SMALLEST_WINDOW, _LARGEST_WINDOW = 2, 11  # half the side, pixels
_OTHER_COUNTS = ((0, -1), (-1, 0), (0, 1), (1, 0), (-1, -1), (1, 1))


@dataclass(frozen=True)
class Corners:
    """Corners of a board in the image of a device."""

    ids: Int64[ndarray, "n"]  # places in `board.corners()`, ascending
    uv: Float64[ndarray, "n 2"]  # pixels; the centre of the first pixel is (0.5, 0.5)


def find_corners(image: Float32[ndarray, "h w"], board: Board) -> Corners | None:
    """The corners of a board in an image with values in [0, 1]; None where it is not seen.

    A chessboard must be seen whole, a ChArUco board with eight corners or more.
    """
    grey = _stretched(image)
    return _find_charuco(grey, board) if isinstance(board, CharucoBoard) else _find_chessboard(grey, board)


def other_board_seen(image: Float32[ndarray, "h w"], board: Chessboard) -> Chessboard | None:
    """A chessboard with other numbers of corners that is seen instead: the user may have counted squares."""
    grey = _stretched(image)
    sizes = [(board.rows, board.columns), *((board.columns + x, board.rows + y) for x, y in _OTHER_COUNTS)]
    for columns, rows in sizes:
        if min(columns, rows) < 3 or (columns, rows) == (board.columns, board.rows):
            continue
        other = replace(board, columns=columns, rows=rows)
        if _find_chessboard(grey, other) is not None:
            return other
    return None


def _stretched(image: Float32[ndarray, "h w"]) -> UInt8[ndarray, "h w"]:
    """8 bits, with the brightest hundredth saturated: boards under a projector are often dark."""
    brightest = max(float(np.quantile(image[::4, ::4], 0.99)), 1e-3)
    return np.rint(np.clip(image / brightest, 0, 1) * 255).astype(np.uint8)


def _find_chessboard(grey: UInt8[ndarray, "h w"], board: Chessboard) -> Corners | None:
    size = (board.columns, board.rows)
    factor = min(1.0, _SEARCHED / max(grey.shape))
    small = grey if factor == 1 else cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    found, uv = cv2.findChessboardCornersSB(small, size, flags=_FLAGS)
    if not found:
        found, uv = cv2.findChessboardCorners(small, size)
        if not found:
            return None
    # either detector is off by a tenth of a pixel or more: on synthetic boards 0.10 px (RMS), 0.04 px when refined
    uv = np.asarray(uv, np.float64).reshape(-1, 2)
    return Corners(np.arange(len(uv)), _refined(grey, (uv + 0.5) / factor - 0.5) + 0.5)


def _refined(grey: UInt8[ndarray, "h w"], uv: Float64[ndarray, "n 2"], share: float = 0.25) -> Float64[ndarray, "n 2"]:
    """Corners moved to the saddle points of the brightness, in OpenCV's convention (first pixel centre at 0).

    `share` is half the window, in distances to the next corner.
    """
    pitch = float(np.quantile(KDTree(uv).query(uv, k=2)[0][:, 1], 0.1))
    half = int(np.clip(round(share * pitch), _SMALLEST_WINDOW, _LARGEST_WINDOW))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    found = cv2.cornerSubPix(grey, uv.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), stop)
    return found.reshape(-1, 2).astype(np.float64)


def _find_charuco(grey: UInt8[ndarray, "h w"], board: CharucoBoard) -> Corners | None:
    """With the layout of either version of OpenCV: only one of them has the markers where they are."""
    found = [_charuco_corners(grey, board, legacy) for legacy in (False, True)]
    return max((corners for corners in found if corners is not None), key=lambda c: len(c.ids), default=None)


def _charuco_corners(grey: UInt8[ndarray, "h w"], board: CharucoBoard, legacy: bool) -> Corners | None:
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    drawn = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, markers)
    drawn.setLegacyPattern(legacy)
    uv, ids, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(grey)
    if ids is None or uv is None or len(ids) < LEAST_CORNERS:
        return None
    order = np.argsort(ids.ravel())
    # OpenCV counts these pixels from one or the other corner of a pixel, as its version goes: a saddle has one place.
    share = min(0.25, 0.8 * (board.square - board.marker) / 2 / board.square)  # markers stay outside the window
    refined = _refined(grey, uv.reshape(-1, 2)[order].astype(np.float64), share)
    return Corners(ids.ravel()[order].astype(np.int64), refined + 0.5)
