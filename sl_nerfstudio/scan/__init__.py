"""The scan folder, format 1 (docs/scan-format.md): reading, checking and writing it.

In: a folder with transforms.json, or frames one by one. Out: a `Scan` with its frames, poses and devices, or a list of
faults; or a folder on disk.
"""

from sl_nerfstudio.errors import ScanError
from sl_nerfstudio.scan.check import check_scan, require_valid
from sl_nerfstudio.scan.document import FileError
from sl_nerfstudio.scan.read import read_scan
from sl_nerfstudio.scan.types import (
    Frame,
    PickedPixel,
    PoseSigma,
    Scale,
    ScaleBar,
    Scan,
    measured_length,
)
from sl_nerfstudio.scan.write import (
    ScanWriter,
    read_devices,
    read_ground_truth,
    read_pose_sigmas,
    read_poses,
    read_unplaced,
    write_transforms,
)

__all__ = [
    "FileError",
    "Frame",
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
