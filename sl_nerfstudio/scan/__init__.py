"""The scan folder, format 1 (docs/scan-format.md): reading, checking and writing it.

In: a folder with transforms.json, or frames one by one. Out: a `Scan` with its frames, poses and devices, or a list of
faults; or a folder on disk.
"""

from sl_nerfstudio.errors import Fault, ScanError
from sl_nerfstudio.scan.check.folder import check_scan, require_valid
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.measured_length import measured_length
from sl_nerfstudio.scan.pose_files import (
    read_devices,
    read_ground_truth,
    read_pose_sigmas,
    read_poses,
    read_unplaced,
    write_transforms,
)
from sl_nerfstudio.scan.reading import read_scan
from sl_nerfstudio.scan.types import UNITS, Frame, GroundTruth, PickedPixel, PoseSigma, Scale, ScaleBar, Scan
from sl_nerfstudio.scan.writing import ScanWriter

__all__ = [
    "UNITS",
    "Fault",
    "FileError",
    "Frame",
    "GroundTruth",
    "PickedPixel",
    "PoseSigma",
    "Scale",
    "ScaleBar",
    "Scan",
    "ScanError",
    "ScanWriter",
    "check_scan",
    "measured_length",
    "read_devices",
    "read_ground_truth",
    "read_pose_sigmas",
    "read_poses",
    "read_scan",
    "read_unplaced",
    "require_valid",
    "write_transforms",
]
