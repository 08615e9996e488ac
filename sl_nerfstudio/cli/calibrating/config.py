"""The flags of sl-calibrate."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.sequence import SequenceName

if TYPE_CHECKING:
    from sl_nerfstudio.pattern.boards import Board

_FLAGS = {"chessboard": ("corners",), "charuco": ("squares", "marker", "dictionary")}


@dataclass(frozen=True)
class CalibrateConfig:
    """Find the intrinsics of a camera and a projector from photographs of a board in at least 3 poses, better 10.

    For the projector, each pose is a folder of photographs: of a Gray-code sequence, or one under the coded grid and
    one without it, with nothing moved in between. Both devices stand still while the board moves.
    """

    images: Path
    """folder with one sub-folder for each pose; for the camera alone, one image for each pose"""
    output: Path
    """file to write, intrinsics.json; the report goes beside it, with the ending .html"""
    board: Literal["chessboard", "charuco"] = "chessboard"
    """kind of the board; a ChArUco board may be partly out of view"""
    corners: str | None = None
    """inner corners of a chessboard, where four squares meet, as 9x7"""
    squares: str | None = None
    """squares of a ChArUco board, as 25x18"""
    square: str | None = None
    """side of a square with its unit, as "75 mm"; measure it on the paper"""
    marker: str | None = None
    """side of a ChArUco board's markers with its unit, as "5.6 mm\""""
    dictionary: str = "5X5_1000"
    """OpenCV's name of the set of markers"""
    pattern: Path | None = None
    """pattern.json of what was projected; for the Gray code of another program its projector's size, as 1024x768"""
    sequence: SequenceName | None = None
    """order of the images of a Gray-code sequence, by the program that showed it; default: what pattern.json states, or
    for a --pattern that is a resolution what the images show. Alone, without --pattern: cells of one pixel on a
    projector of a usual resolution"""
    camera_only: bool = False
    """calibrate the camera alone"""
    projector_model: Literal["OPENCV", "DOE"] = "OPENCV"
    """pinhole, or a diffractive element whose pattern is uniform in direction cosines"""

    def check(self) -> None:
        """Raise UserError, naming the flag, if flags are missing or contradict each other."""
        for kind, names in _FLAGS.items():
            for name in names:
                if kind != self.board and getattr(self, name) not in (None, "5X5_1000"):
                    raise UserError(
                        f"--{name}: says nothing about a {self.board}\n    cause:  it describes a {kind}\n"
                        f"    remedy: give --board {kind}, or leave it out"
                    )
        needed = {"chessboard": ("corners", "square"), "charuco": ("squares", "square", "marker")}[self.board]
        for name in needed:
            if getattr(self, name) is None:
                example = {"corners": "9x7", "squares": "25x18", "square": '"75 mm"', "marker": '"5.6 mm"'}[name]
                raise UserError(
                    f"--{name} is missing\n    cause:  a {self.board} is described by {', '.join(needed)}\n"
                    f"    remedy: give for example --{name} {example}; sl-pattern prints it for its own boards"
                )
        if self.camera_only and (self.pattern is not None or self.sequence is not None):
            raise UserError(
                "--camera-only: no pattern is needed\n    cause:  --pattern and --sequence are for the projector\n"
                "    remedy: leave them out, or calibrate both devices without --camera-only"
            )
        if not self.camera_only and self.pattern is None and self.sequence is None:
            raise UserError(
                "--pattern is missing\n    cause:  without it nothing is known of the projector\n"
                "    remedy: give the pattern.json of what was projected, the order of a Gray code as --sequence "
                "opencv, or --camera-only"
            )
        if self.output.suffix.lower() != ".json":
            raise UserError(f"--output {self.output}: the file must end in .json")

    def the_board(self) -> "Board":
        """The board that the flags describe. Raises UserError if there can be none."""
        from sl_nerfstudio.pattern.board_values import counts, millimetres
        from sl_nerfstudio.pattern.boards import CharucoBoard, Chessboard

        side = millimetres(self.square or "", "--square")
        try:
            if self.board == "chessboard":
                return Chessboard(*counts(self.corners or "", "--corners"), side)
            marker = millimetres(self.marker or "", "--marker")
            return CharucoBoard(*counts(self.squares or "", "--squares"), side, marker, self.dictionary)
        except ValueError as error:
            raise UserError(f"--{' --'.join(_FLAGS[self.board])}: {error}") from error
