"""Photographs of a board: which belong together, the corners in them, and where the pattern puts those corners."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.calibration.board_adjustment import BoardView, Corners
from sl_nerfstudio.decoding.decoder import Decoder, DecodingError
from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, all_finite, geman_mcclure_weight
from sl_nerfstudio.pattern.boards import Board, CharucoBoard, Chessboard
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.layout import ShownImage
from sl_nerfstudio.scan.document import FileError
from sl_nerfstudio.scan.images import as_grey, read_photograph, shrunk

LEAST_IN_PATTERN = 8  # corners of a view that the pattern must reach
Track = Callable[[Sequence[Any], str], Iterable[Any]]
LEAST_CORNERS = 8  # of a ChArUco board of which only a part is in view
_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
_SEARCHED = 1600  # longest side of the image in which a chessboard is searched; it is measured in the full one
_SMALLEST_WINDOW, _LARGEST_WINDOW = 2, 11  # half the side, pixels
_OTHER_COUNTS = ((0, -1), (-1, 0), (0, 1), (1, 0), (-1, -1), (1, 1))
_BRIGHT = 99.5  # percentile that counts as white
_WHITE = 0.9  # of the full scale
_DARKEST = 0.02  # of white: a darker board shows more noise than pattern
_LIT = 0.1  # of white
_REACH = 0.7  # half the side of a corner's surroundings, in distances to the next corner
_LEAST_REACH = 4  # camera pixels
_LEAST_PIXELS = 24
_LEAST_SPREAD = 0.25  # of the surroundings: the smaller axis of the pixels used, as a standard deviation
_ROUNDS = 3  # of reweighting
_KERNEL = 3.0  # robust standard deviations


@dataclass(frozen=True)
class BoardPhotographs:
    """The photographs of one pose of the board."""

    name: str
    images: tuple[Path, ...]  # one, or a sequence in the order of projection, or one under the pattern and one without


@dataclass(frozen=True)
class BoardPicture:
    """A photograph on which the board is seen, for the report."""

    name: str
    grey: Float32[ndarray, "h w"]
    corners: Corners | None
    problem: str | None  # why this pose is not used


@dataclass(frozen=True)
class BoardCaptures:
    """Everything that was found in the photographs."""

    views: tuple[BoardView, ...]
    pictures: tuple[BoardPicture, ...]  # of every pose, used or not
    faults: tuple[FileError, ...]  # of the poses that are not used
    noted: tuple[tuple[str, tuple[str, ...]], ...] = ()  # name of every pose that is used, and the decoder's notes


def read_board_captures(
    poses: Sequence[BoardPhotographs], board: Board, decoder: Decoder[Any] | None, track: Track
) -> BoardCaptures:
    """The corners of every pose in the camera and, with a decoder, in the pattern.

    A pose whose board is not found, or whose pattern cannot be decoded, is a fault, and is not used.
    """
    views, pictures, faults, noted = [], [], [], []
    for pose in track(poses, "Finding the board"):
        try:
            grey, corners, view, notes = _read_pose(pose, board, decoder)
            noted.append((pose.name, notes))
            pictures.append(BoardPicture(pose.name, grey, corners, None))
            views.append(view)
        except _Unused as unused:
            faults.append(unused.fault)
            pictures.append(BoardPicture(pose.name, unused.grey, unused.corners, unused.fault.problem))
    return BoardCaptures(tuple(views), tuple(pictures), tuple(faults), tuple(noted))


class _Unused(Exception):
    """A pose that cannot be used."""

    def __init__(self, fault: FileError, grey: Float32[ndarray, "h w"], corners: Corners | None = None) -> None:
        self.fault, self.grey, self.corners = fault, grey, corners


def _read_pose(
    pose: BoardPhotographs, board: Board, decoder: Decoder[Any] | None
) -> tuple[Float32[ndarray, "h w"], Corners, BoardView, tuple[str, ...]]:
    pattern = None
    if isinstance(decoder, NetworkDecoder):
        pattern, grey = _pattern_and_plain(pose)
    else:
        grey = _even_light(pose, decoder)
    corners = find_corners(grey, board)
    if corners is None:
        raise _Unused(_not_found(pose, grey, board), grey)
    if decoder is None:
        return grey, corners, BoardView(pose.name, corners, None), ()
    folder, factor = pose.images[0].parent, 1
    if pattern is None:
        images = [read_photograph(path) for path in pose.images]
    else:
        white = without_reflectance(pattern, grey)
        factor = decoder.shrink_factor(white) or 1
        images = [shrunk(white, factor)]
    try:
        decoded = decoder.decode(images, [path.name for path in pose.images])
    except DecodingError as error:
        raise _Unused(FileError(folder, error.problem, error.cause, error.remedy), grey, corners) from error
    carried = corners_in_pattern(Corners(corners.ids, corners.uv / factor), decoded.coords)
    if len(carried.ids) < LEAST_IN_PATTERN:
        fault = FileError(
            folder,
            f"has {len(carried.ids)} of {len(corners.ids)} corners in the pattern, fewer than {LEAST_IN_PATTERN}",
            "the projector lights too little of the board, or its white squares are too dark or saturated",
            "capture this pose again with the whole board lit, or leave its folder out",
        )
        raise _Unused(fault, grey, corners)
    return grey, corners, BoardView(pose.name, corners, carried), decoded.notes


def _even_light(pose: BoardPhotographs, decoder: Decoder[Any] | None) -> Float32[ndarray, "h w"]:
    """The board under even light.

    Without a decoder that is the brightest image; of a sequence with inverses, the mean of all images that have one.
    """
    layout = None if decoder is None else decoder.layout
    if not isinstance(layout, GrayCode):
        return max((as_grey(read_photograph(path)) for path in pose.images), key=lambda image: image.mean())
    pairs = [(k, inverse) for axis in (0, 1) for k, inverse in layout.bit_images(axis) if inverse is not None]
    white = layout.place(ShownImage("white"))
    used = [k for pair in pairs for k in pair] or (range(layout.images) if white is None else [white])
    return _mean([pose.images[place] for place in used if place < len(pose.images)])


def _pattern_and_plain(pose: BoardPhotographs) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """One photograph under a coded grid, and one without it, whichever comes first."""
    if len(pose.images) != 2:
        fault = FileError(
            pose.images[0].parent,
            f"holds {len(pose.images)} images, and a coded grid needs 2 of each pose",
            "one is missing, or there are images of several poses",
            "give one photograph under the pattern and one under plain light, with nothing moved in between",
        )
        raise _Unused(fault, as_grey(read_photograph(pose.images[0])))
    first, second = (as_grey(read_photograph(path)) for path in pose.images)
    return (first, second) if _edges(first) > _edges(second) else (second, first)


def _mean(paths: Sequence[Path]) -> Float32[ndarray, "h w"]:
    """The mean of photographs, of which one at a time is in memory."""
    total = as_grey(read_photograph(paths[0]))
    for path in paths[1:]:
        total = total + as_grey(read_photograph(path))
    return total / np.float32(len(paths))


def _edges(grey: Float32[ndarray, "h w"]) -> float:
    """Mean change from pixel to pixel, relative to the image's contrast; lines of a grid add to it."""
    change = np.abs(np.diff(grey, axis=0)).mean() + np.abs(np.diff(grey, axis=1)).mean()
    return float(change / max(float(grey.std()), 1e-6))


def _not_found(pose: BoardPhotographs, grey: Float32[ndarray, "h w"], board: Board) -> FileError:
    where = pose.images[0] if len(pose.images) == 1 else pose.images[0].parent
    if isinstance(board, CharucoBoard):
        return FileError(
            where,
            f"shows no ChArUco board of {board.columns} x {board.rows} squares with markers {board.dictionary}",
            "the board is out of view, blurred, too small or under a reflection, or the flags describe another board",
            "compare --squares and --dictionary with the board (both numbers count squares), or leave the image out",
        )
    other = other_board_seen(grey, board)
    if other is not None:
        return FileError(
            where,
            f"shows a chessboard of {other.columns} x {other.rows} inner corners, not {board.columns} x {board.rows}",
            "--corners counts the points where four squares meet, not squares; or a part of the board is hidden",
            f"give --corners {other.columns}x{other.rows} if that is the board, otherwise leave the image out",
        )
    return FileError(
        where,
        f"shows no chessboard of {board.columns} x {board.rows} inner corners",
        "a part of it is out of view, it is blurred or under a reflection, or --corners counts something else",
        "count the points where four squares meet, or leave the image out; a ChArUco board may be partly hidden",
    )


# Corners in the camera, to a fraction of a pixel; the detectors are OpenCV's.


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
    """Corners with the layout of either version of OpenCV: only one of them has the markers where they are."""
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


# Corners in the pattern.


def without_reflectance(pattern: Float32[ndarray, "h w"], plain: Float32[ndarray, "h w"]) -> UInt16[ndarray, "h w"]:
    """The board under the pattern as if it were white all over. Images are from 0 to 1.

    Black squares then show the pattern as white ones do, and no edge of the board moves what is decoded beside it:
    corners in the pattern become three to ten times as accurate. Room light may be in either photograph, or in both;
    the exposures may differ.
    """
    white = max(float(np.percentile(plain, _BRIGHT)), 1e-6)
    ratio = pattern / np.maximum(plain, _DARKEST * white)
    lit = ratio[plain > _LIT * white]
    scale = _WHITE / max(float(np.percentile(lit, _BRIGHT)) if lit.size else 0.0, 1e-6)
    return np.rint(65535 * np.clip(scale * ratio, 0, 1)).astype(np.uint16)


def corners_in_pattern(corners: Corners, coords: Float32[ndarray, "h w 2"]) -> Corners:
    """The corners whose surroundings are decoded, in pattern pixels. `coords` is NaN where nothing is decoded.

    Moreno and Taubin, "Simple, accurate, and robust projector-camera calibration" (3DIMPVT 2012): a board is flat, so
    close to a corner camera and projector pixels are related by a homography, which lens distortion hardly bends there.
    No pixel needs to be decoded at the corner itself, where black and white meet.
    """
    distance = KDTree(corners.uv).query(corners.uv, k=2)[0][:, 1]
    found = [_carried(uv, reach, coords) for uv, reach in zip(corners.uv, _REACH * distance, strict=True)]
    known = np.array([uv is not None for uv in found], dtype=bool)
    uv = np.array([uv for uv in found if uv is not None], dtype=np.float64).reshape(-1, 2)
    return Corners(corners.ids[known], uv)


def _carried(
    corner: Float64[ndarray, "2"], reach: float, coords: Float32[ndarray, "h w 2"]
) -> Float64[ndarray, "2"] | None:
    reach = max(reach, _LEAST_REACH)
    h, w = coords.shape[:2]
    left, top = (max(0, int(c - reach)) for c in corner)
    right, bottom = min(w, int(corner[0] + reach) + 1), min(h, int(corner[1] + reach) + 1)
    part = coords[top:bottom, left:right]
    rows, columns = np.nonzero(all_finite(part))
    if len(rows) < _LEAST_PIXELS:
        return None
    xy = (np.stack([columns + left, rows + top], -1) + 0.5 - corner) / reach
    if np.sqrt(np.linalg.eigvalsh(np.cov(xy.T))[0]) < _LEAST_SPREAD:
        return None  # to one side of the corner only, from where it would be extrapolated
    return _at_origin(xy, part[rows, columns].astype(np.float64))


def _at_origin(xy: Float64[ndarray, "n 2"], uv: Float64[ndarray, "n 2"]) -> Float64[ndarray, "2"] | None:
    """Map (0, 0) by a robustly fitted homography from `xy` to `uv`; None if none fits."""
    middle = np.median(uv, axis=0)
    size = max(float(np.abs(uv - middle).max()), 1e-6)
    target = (uv - middle) / size
    weight = np.ones(len(xy))
    for _ in range(_ROUNDS):
        h = _homography(xy, target, weight)
        if h is None:
            return None
        mapped = np.c_[xy, np.ones(len(xy))] @ h.T
        if (mapped[:, 2] <= 0).any():
            return None
        miss = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - target, axis=1)
        scale = max(MAD_TO_SIGMA * float(np.median(miss)), 1e-9)
        weight = geman_mcclure_weight((miss / (_KERNEL * scale)) ** 2)
    return h[:2, 2] * size + middle


def _homography(
    xy: Float64[ndarray, "n 2"], uv: Float64[ndarray, "n 2"], weight: Float64[ndarray, "n"]
) -> Float64[ndarray, "3 3"] | None:
    """Fit a homography, with 1 in the last place: the origin, where it is looked up, is never at infinity."""
    x, y = xy.T
    o, one = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, o, o, o, -uv[:, 0] * x, -uv[:, 0] * y], -1),
            np.stack([o, o, o, x, y, one, -uv[:, 1] * x, -uv[:, 1] * y], -1),
        ]
    )
    w = np.tile(weight, 2)
    normal = (rows * w[:, None]).T @ rows
    if np.linalg.cond(normal) > 1e12:
        return None
    return np.append(np.linalg.solve(normal, (rows * w[:, None]).T @ uv.T.ravel()), 1.0).reshape(3, 3)
