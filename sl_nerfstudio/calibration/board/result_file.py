"""The file that sl-calibrate writes: plain JSON that sl-process reads, with the uncertainty of every number."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from sl_nerfstudio.calibration.board.calibrate import BoardCalibration
from sl_nerfstudio.calibration.board.uncertainty import DeviceSigma
from sl_nerfstudio.geometry.devices import DEVICE_FIELDS, Device
from sl_nerfstudio.pattern.boards import Board, Chessboard

MARK = b'"sl_calibration": 1'
"""By which an earlier result of this command is known."""


def encode_calibration(found: BoardCalibration, verdict: str, reasons: tuple[str, ...]) -> bytes:
    """The text of the file."""
    document: dict[str, Any] = {"sl_calibration": 1, "units": "mm", "verdict": verdict, "reasons": list(reasons)}
    for name, device, sigma in zip(("camera", "projector"), found.adjusted.rig.devices, found.sigmas, strict=False):
        document[name] = _device(device, sigma)
    if found.projector is not None:
        document["T_projector_camera"] = found.adjusted.rig.T_projector_camera.tolist()
    document["board"] = _board(found.board)
    document["rms_px"] = list(found.rms_px)
    document["left_out_px"] = list(found.left_out.error_px)
    document["poses"] = [
        {"name": view.name, "rms_px": [_rms(of_device[k]) for of_device in found.residuals],
         "T_camera_board": found.adjusted.rig.T_camera_board[k].tolist()}
        for k, view in enumerate(found.views)
    ]  # fmt: skip
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def _rms(residuals: np.ndarray) -> float | None:
    return float(np.sqrt((residuals**2).mean())) if len(residuals) else None


def _device(device: Device, sigma: DeviceSigma) -> dict[str, Any]:
    fields = {key: getattr(device, key) for key in DEVICE_FIELDS}
    return {**fields, "sigma": {key: value for key, value in sigma.values.items() if value}}


def _board(board: Board) -> dict[str, Any]:
    kind = "chessboard" if isinstance(board, Chessboard) else "charuco"
    return {"kind": kind, **asdict(board)}
