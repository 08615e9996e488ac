"""Real photographs of a board: how much the result moves without any one pose."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sl_nerfstudio.calibration.board import BoardCalibration, calibrate
from sl_nerfstudio.calibration.board_adjustment import BoardView
from sl_nerfstudio.cli.calibrate import CalibrateConfig, CalibrationInputs, read_inputs


@dataclass(frozen=True)
class RealRow:
    """The whole procedure, model selection included, with all poses or without one."""

    left_out: str  # name of the pose; empty: all were used
    focal_px: tuple[float, ...]  # of the camera, and of the projector
    focal_moved_percent: tuple[float, ...]  # against all poses
    rms_px: tuple[float, ...]
    left_out_px: tuple[float, ...]  # RMS of the predictions of left-out poses
    models: tuple[str, ...]


def leave_each_out(config: CalibrateConfig) -> list[RealRow]:
    """With all poses first, then without each."""
    config.check()
    board = config.the_board()
    inputs = read_inputs(config, board)
    views = inputs.captures.views
    whole = _calibrate(config, inputs, views)
    rows = [_row("", whole, whole)]
    for k, view in enumerate(views):
        rows.append(_row(view.name, _calibrate(config, inputs, [*views[:k], *views[k + 1 :]]), whole))
    return rows


def _calibrate(config: CalibrateConfig, inputs: CalibrationInputs, views: Sequence[BoardView]) -> BoardCalibration:
    return calibrate(
        views, config.the_board(), inputs.camera_size, inputs.pattern_size, config.projector_model, _quietly
    )


def _quietly(items: Sequence[int], _: str) -> Iterable[int]:
    return items


def _row(left_out: str, found: BoardCalibration, whole: BoardCalibration) -> RealRow:
    focal = tuple(device.fl_x for device in found.adjusted.rig.devices)
    of_whole = (device.fl_x for device in whole.adjusted.rig.devices)
    return RealRow(
        left_out, focal, tuple(100 * (f / g - 1) for f, g in zip(focal, of_whole, strict=True)),
        found.rms_px, found.left_out.error_px, tuple(map(str, found.free)),
    )  # fmt: skip
