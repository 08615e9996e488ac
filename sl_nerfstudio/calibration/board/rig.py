"""What a calibration solves for: the intrinsics of both devices, their relative pose, and the pose of every board."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.board.detection import Corners
from sl_nerfstudio.geometry.devices import PARAMETERS, Device


@dataclass(frozen=True)
class BoardView:
    """One pose of the board, as both devices see it."""

    name: str
    camera: Corners
    projector: Corners | None  # in pattern pixels; None where no pattern was projected, or too little of it decoded


@dataclass(frozen=True)
class FreeIntrinsics:
    """Which intrinsics of a device are fitted. Focal length and principal point always are."""

    aspect: bool = False  # fl_x and fl_y apart
    terms: int = 0  # of the lens distortion: the first 0, 1, 2 or 4 of k1, k2, p1, p2

    def columns(self) -> Float64[ndarray, "8 n"]:
        """How PARAMETERS change with each fitted number, the first of which is fl_x or the common focal length."""
        unit = np.eye(8)
        focal = [unit[0], unit[1]] if self.aspect else [unit[0] + unit[1]]
        return np.stack([*focal, unit[2], unit[3], *unit[4 : 4 + self.terms]], -1)

    def __str__(self) -> str:
        """In words."""
        lens = ("no lens distortion", "k1", "k1, k2", "", "k1, k2, p1, p2")[self.terms]
        return f"{'two focal lengths' if self.aspect else 'one focal length'}, {lens}"


@dataclass(frozen=True)
class BoardRig:
    """A solution. Boards lie in the plane z = 0 of their frame, x to the right and y up, in the board's unit."""

    camera: Device
    projector: Device | None
    T_camera_board: Float64[ndarray, "n 4 4"]  # of every view
    T_projector_camera: Float64[ndarray, "4 4"]

    @property
    def devices(self) -> tuple[Device, ...]:
        """The camera, and the projector if there is one."""
        return (self.camera,) if self.projector is None else (self.camera, self.projector)

    def with_devices(self, devices: Sequence[Device]) -> "BoardRig":
        """With other intrinsics."""
        camera, *others = devices
        return replace(self, camera=camera, projector=others[0] if others else None)

    def only(self, views: Sequence[int]) -> "BoardRig":
        """With the boards of some views."""
        return replace(self, T_camera_board=self.T_camera_board[list(views)])


def with_numbers(device: Device, values: Float64[ndarray, "8"]) -> Device:
    """A device with other PARAMETERS."""
    return replace(device, **dict(zip(PARAMETERS, map(float, values), strict=True)))


def board_points(corners: Float64[ndarray, "n 2"]) -> Float64[ndarray, "n 3"]:
    """`board.corners()`, which have y down, as points of the board's frame."""
    return np.c_[corners[:, 0], -corners[:, 1], np.zeros(len(corners))]
