"""Cameras and projectors with their poses, in the unit and the axes of other programs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan.types import Scan

Y_Z_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
"""From device axes of computer vision (+y down, looking along +z) to those of a scan (+y up, looking along -z)."""


@dataclass(frozen=True)
class PosedDevice:
    """The camera or the projector of one frame; lengths in the scan's unit."""

    frame: str
    device: Device
    T_world_device: Float64[ndarray, "4 4"]  # +y up, looking along -z
    image: Path  # what it shows: the capture, or the pattern

    @property
    def T_world_cv(self) -> Float64[ndarray, "4 4"]:
        """The same pose for axes with +y down, looking along +z."""
        return self.T_world_device @ Y_Z_DOWN


@dataclass(frozen=True)
class PosedFrames:
    """All devices of a run, in the order of the scan's frames."""

    cameras: tuple[PosedDevice, ...]
    projectors: tuple[PosedDevice, ...]
    placed: tuple[bool, ...]  # of each frame: False if it does not agree with the others, so that its poses say nothing


def posed_frames(scan: Scan, poses: DevicePoses, unplaced: Sequence[bool]) -> PosedFrames:
    """The devices of a scan at refined poses."""
    cameras = tuple(
        PosedDevice(frame.name, frame.camera, T, frame.image_path)
        for frame, T in zip(scan.frames, poses.T_world_camera, strict=True)
    )
    projectors = tuple(
        PosedDevice(frame.name, scan.projector, T, scan.pattern_path)
        for frame, T in zip(scan.frames, poses.T_world_projector, strict=True)
    )
    return PosedFrames(cameras, projectors, tuple(not lost for lost in unplaced))
