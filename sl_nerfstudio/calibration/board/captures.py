"""Photographs of a board: which belong together, the corners in them, and where the pattern puts those corners."""

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.calibration.board.detection import Corners, find_corners, other_board_seen
from sl_nerfstudio.calibration.board.rig import BoardView
from sl_nerfstudio.calibration.board.transfer import corners_in_pattern
from sl_nerfstudio.decoding.decoded import DecodingError
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.boards import Board, CharucoBoard
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.scan.file_error import FileError, unreadable
from sl_nerfstudio.scan.images import as_grey
from sl_nerfstudio.scan.photographs import ENDINGS, photograph_header, read_photograph

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

    size: tuple[int, int]  # (w, h)
    views: tuple[BoardView, ...]
    pictures: tuple[BoardPicture, ...]  # of every pose, used or not
    faults: tuple[UserError, ...]  # of the poses that are not used


def find_photographs(root: Path, several: bool) -> list[BoardPhotographs]:
    """The poses in a folder: with `several` images each in a folder of its own, otherwise one image each.

    Raises FileError if there are none, or if all their sizes are not one.
    """
    if not os.path.isdir(root):
        raise FileError(root, "is no folder", "a typing error in --images", "give the folder with the photographs")
    try:
        images, folders = _images(root), sorted((p for p in root.iterdir() if p.is_dir()), key=_natural)
        inside = [BoardPhotographs(p.name, tuple(found)) for p in folders if (found := _images(p))]
    except OSError as error:
        raise unreadable(root, error) from error
    single = [BoardPhotographs(path.stem, (path,)) for path in images]
    found = inside if several else (single or [BoardPhotographs(p.name, p.images[:1]) for p in inside])
    if not found:
        wanted = "sub-folders with images, one for each pose of the board" if several else "images"
        cause = "a typing error in --images, or images of another format"
        remedy = f"give a folder of {', '.join(ENDINGS)} files"
        if several and single:
            cause = "one image shows the camera's corners only; the projector needs its pattern on every pose"
            remedy = "give one sub-folder for each pose, or calibrate the camera alone with --camera-only"
        raise FileError(root, f"holds no {wanted}", cause, remedy)
    return found


def common_size(poses: Sequence[BoardPhotographs]) -> tuple[int, int]:
    """(w, h) of all images. Raises UserError that lists every image of another size, and every damaged one."""
    sizes: dict[Path, tuple[int, int]] = {}
    faults: list[FileError] = []
    for path in (path for pose in poses for path in pose.images):
        try:
            header = photograph_header(path)
            sizes[path] = (header.w, header.h)
        except FileError as error:
            faults.append(error)
    usual = Counter(sizes.values()).most_common(1)[0][0] if sizes else (0, 0)
    faults += [
        FileError(
            path,
            f"is {size[0]} x {size[1]} pixels, most images are {usual[0]} x {usual[1]}",
            "it was turned, resized or cropped, or is of another camera",
            "give all images as the camera took them; intrinsics are valid for one size only",
        )
        for path, size in sizes.items()
        if size != usual
    ]
    if faults:
        raise UserError("\n".join(map(str, faults)))
    return usual


def read_board_captures(
    poses: Sequence[BoardPhotographs], size: tuple[int, int], board: Board, decoder: Decoder[Any] | None, track: Track
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
    return BoardCaptures(size, tuple(views), tuple(pictures), tuple(faults))


class _Unused(Exception):
    """A pose that cannot be used."""

    def __init__(self, fault: FileError, grey: Float32[ndarray, "h w"], corners: Corners | None = None) -> None:
        self.fault, self.grey, self.corners = fault, grey, corners


def _read_pose(
    pose: BoardPhotographs, board: Board, decoder: Decoder[Any] | None
) -> tuple[Float32[ndarray, "h w"], Corners, BoardView]:
    pattern, plain = pose.images, pose.images[:1]
    if decoder is not None and not decoder.sequence:
        pattern, plain = _pattern_and_plain(pose, board)
    grey = (
        _under_even_light(pose, decoder) if decoder is None or decoder.sequence else as_grey(read_photograph(plain[0]))
    )
    corners = find_corners(grey, board)
    if corners is None:
        raise _Unused(_not_found(pose, plain[0], grey, board), grey)
    if decoder is None:
        return grey, corners, BoardView(pose.name, corners, None)
    try:
        coords = decoder.decode(pattern).coords
    except DecodingError as error:
        raise _Unused(FileError(pattern[0].parent, error.problem, error.cause, error.remedy), grey, corners) from error
    carried = corners_in_pattern(corners, coords)
    if len(carried.ids) < LEAST_IN_PATTERN:
        raise _Unused(
            FileError(
                pattern[0].parent,
                f"has {len(carried.ids)} of {len(corners.ids)} corners in the pattern, fewer than {LEAST_IN_PATTERN}",
                "the projector lights too little of the board, or its white squares are too dark or saturated",
                "capture this pose again with the whole board lit, or leave its folder out",
            ),
            grey,
            corners,
        )
    return grey, corners, BoardView(pose.name, corners, carried)


def _under_even_light(pose: BoardPhotographs, decoder: Decoder[Any] | None) -> Float32[ndarray, "h w"]:
    """The board without stripes: the mean of images that come with their inverse, or the one under white light."""
    layout = None if decoder is None else decoder.layout
    if not isinstance(layout, GrayCode) or len(pose.images) != layout.images:
        return as_grey(read_photograph(pose.images[0]))
    even = [as_grey(read_photograph(pose.images[place])) for place in layout.even_images()]
    return np.mean(even, axis=0, dtype=np.float32)


def _pattern_and_plain(pose: BoardPhotographs, board: Board) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """The photograph under the coded grid, and the one without it: only there the board is clean."""
    if len(pose.images) != 2:
        raise UserError(
            f"{pose.images[0].parent}: holds {len(pose.images)} images, and a coded grid needs 2 of each pose\n"
            "    cause:  one is missing, or there are images of several poses\n"
            "    remedy: give one photograph under the pattern and one under plain light, with nothing moved in between"
        )
    edges = [_edges(as_grey(read_photograph(path))) for path in pose.images]
    first, second = ((path,) for path in pose.images)
    return (first, second) if edges[0] > edges[1] else (second, first)


def _edges(grey: Float32[ndarray, "h w"]) -> float:
    """How much an image changes from pixel to pixel, relative to its contrast: lines of a grid add to it."""
    change = np.abs(np.diff(grey, axis=0)).mean() + np.abs(np.diff(grey, axis=1)).mean()
    return float(change / max(float(grey.std()), 1e-6))


def _not_found(pose: BoardPhotographs, path: Path, grey: Float32[ndarray, "h w"], board: Board) -> FileError:
    where = path if len(pose.images) == 1 else path.parent
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


def _images(folder: Path) -> list[Path]:
    found = (p for p in folder.iterdir() if p.suffix.lower() in ENDINGS and not p.name.startswith("."))
    return sorted(found, key=_natural)


def _natural(path: Path) -> list[tuple[int, int | str]]:
    """Sorting key with which image 10 comes after image 9."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in parts if part]
