"""Intrinsics of camera and projector from the corners of a board in several poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.board.adjustment import Adjusted, adjust
from sl_nerfstudio.calibration.board.coverage import Coverage, NextPose, coverage_of, next_pose
from sl_nerfstudio.calibration.board.residuals import residuals, sightings
from sl_nerfstudio.calibration.board.rig import BoardView, FreeIntrinsics, board_points
from sl_nerfstudio.calibration.board.selection import LeftOut, ModelScore, Track, choose_models, leave_out
from sl_nerfstudio.calibration.board.start import camera_start, projector_start
from sl_nerfstudio.calibration.board.uncertainty import DeviceSigma, device_sigmas
from sl_nerfstudio.geometry.devices import Device, DeviceKind
from sl_nerfstudio.pattern.boards import Board

FEWEST_VIEWS = 3  # two determine focal length and principal point; a third can contradict them
Size = tuple[int, int]


@dataclass(frozen=True)
class BoardCalibration:
    """Both devices, and all by which they can be judged."""

    board: Board
    views: tuple[BoardView, ...]
    adjusted: Adjusted
    sigmas: tuple[DeviceSigma, ...]  # of the camera, and of the projector if there is one
    rms_px: tuple[float, ...]  # over all corners, outliers included
    residuals: tuple[tuple[Float64[ndarray, "_ 2"], ...], ...]  # of each device, of each view, seen minus predicted
    left_out: LeftOut
    models: tuple[ModelScore, ...]
    coverage: Coverage
    next_pose: NextPose | None

    @property
    def camera(self) -> Device:
        """The camera."""
        return self.adjusted.rig.camera

    @property
    def projector(self) -> Device | None:
        """The projector; None if the pattern was not seen."""
        return self.adjusted.rig.projector

    @property
    def free(self) -> tuple[FreeIntrinsics, ...]:
        """What was fitted of each device."""
        return self.adjusted.free


def calibrate(
    views: Sequence[BoardView],
    board: Board,
    camera_size: Size,
    pattern_size: Size | None,
    model: DeviceKind,
    track: Track,
) -> BoardCalibration:
    """From at least three views. `pattern_size` None: the camera alone. `model` is the projector's."""
    assert len(views) >= FEWEST_VIEWS
    p_board = board_points(board.corners())
    if pattern_size is None:
        views = [BoardView(view.name, view.camera, None) for view in views]
    seen = sightings(views, p_board)
    start = camera_start(views, camera_size, p_board)
    if pattern_size is not None:
        start = projector_start(start, views, pattern_size, p_board, model)
    free, models = choose_models(start, seen, track)
    adjusted = adjust(start.rig, free, seen)
    left_out = leave_out(adjusted.rig, free, seen, adjusted.sigma_px)
    all_residuals = [residuals(adjusted.rig, k, one) for k, one in enumerate(seen)]
    return BoardCalibration(
        board,
        tuple(views),
        adjusted,
        device_sigmas(adjusted, left_out, models),
        tuple(float(np.sqrt((r**2).mean())) for r in all_residuals),
        tuple(tuple(r[one.view == k] for k in range(len(views))) for r, one in zip(all_residuals, seen, strict=True)),
        left_out,
        models,
        coverage_of(adjusted, views),
        next_pose(adjusted, p_board),
    )
