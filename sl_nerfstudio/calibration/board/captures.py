"""Photographs of a board: which belong together, the corners in them, and where the pattern puts those corners."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.calibration.board.detection import Corners, find_corners, other_board_seen
from sl_nerfstudio.calibration.board.reflectance import without_reflectance
from sl_nerfstudio.calibration.board.rig import BoardView
from sl_nerfstudio.calibration.board.transfer import corners_in_pattern
from sl_nerfstudio.decoding.decoded import Decoded, DecodingError
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.decoding.grid.decoder import NetworkDecoder
from sl_nerfstudio.pattern.boards import Board, CharucoBoard
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.sequence import Shown
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.images import as_grey
from sl_nerfstudio.scan.photographs import read_photograph

LEAST_IN_PATTERN = 8  # corners of a view that the pattern must reach
Track = Callable[[Sequence[Any], str], Iterable[Any]]


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


def read_board_captures(
    poses: Sequence[BoardPhotographs], board: Board, decoder: Decoder[Any] | None, track: Track
) -> BoardCaptures:
    """The corners of every pose in the camera and, with a decoder, in the pattern.

    A pose whose board is not found, or whose pattern cannot be decoded, is a fault, and is not used.
    """
    views, pictures, faults = [], [], []
    for pose in track(poses, "Finding the board"):
        try:
            grey, corners, view = _read_pose(pose, board, decoder)
            pictures.append(BoardPicture(pose.name, grey, corners, None))
            views.append(view)
        except _Unused as unused:
            faults.append(unused.fault)
            pictures.append(BoardPicture(pose.name, unused.grey, unused.corners, unused.fault.problem))
    return BoardCaptures(tuple(views), tuple(pictures), tuple(faults))


class _Unused(Exception):
    """A pose that cannot be used."""

    def __init__(self, fault: FileError, grey: Float32[ndarray, "h w"], corners: Corners | None = None) -> None:
        self.fault, self.grey, self.corners = fault, grey, corners


def _read_pose(
    pose: BoardPhotographs, board: Board, decoder: Decoder[Any] | None
) -> tuple[Float32[ndarray, "h w"], Corners, BoardView]:
    decode: Callable[[], Decoded] | None
    if isinstance(decoder, NetworkDecoder):
        pattern, grey = _pattern_and_plain(pose)
        decode = partial(decoder.decode_image, without_reflectance(pattern, grey))
    else:
        grey = _even_light(pose, decoder)
        decode = None if decoder is None else partial(decoder.decode, pose.images)
    corners = find_corners(grey, board)
    if corners is None:
        raise _Unused(_not_found(pose, grey, board), grey)
    if decode is None:
        return grey, corners, BoardView(pose.name, corners, None)
    folder = pose.images[0].parent
    try:
        coords = decode().coords
    except DecodingError as error:
        raise _Unused(FileError(folder, error.problem, error.cause, error.remedy), grey, corners) from error
    carried = corners_in_pattern(corners, coords)
    if len(carried.ids) < LEAST_IN_PATTERN:
        fault = FileError(
            folder,
            f"has {len(carried.ids)} of {len(corners.ids)} corners in the pattern, fewer than {LEAST_IN_PATTERN}",
            "the projector lights too little of the board, or its white squares are too dark or saturated",
            "capture this pose again with the whole board lit, or leave its folder out",
        )
        raise _Unused(fault, grey, corners)
    return grey, corners, BoardView(pose.name, corners, carried)


def _even_light(pose: BoardPhotographs, decoder: Decoder[Any] | None) -> Float32[ndarray, "h w"]:
    """The board under even light.

    Without a decoder that is the brightest image; of a sequence with inverses, the mean of all images that have one.
    """
    layout = None if decoder is None else decoder.layout
    if not isinstance(layout, GrayCode):
        return max((as_grey(read_photograph(path)) for path in pose.images), key=lambda image: image.mean())
    pairs = [(k, inverse) for axis in (0, 1) for k, inverse in layout.bit_images(axis) if inverse is not None]
    white = layout.place(Shown("white"))
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
    """Of photographs, of which one at a time is in memory."""
    total = as_grey(read_photograph(paths[0]))
    for path in paths[1:]:
        total = total + as_grey(read_photograph(path))
    return total / np.float32(len(paths))


def _edges(grey: Float32[ndarray, "h w"]) -> float:
    """How much an image changes from pixel to pixel, relative to its contrast: lines of a grid add to it."""
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
