"""The scan folder (format 1): reading, checking and writing it. See docs/scan-format.md."""

from sl_nerfstudio.errors import Fault, ScanError
from sl_nerfstudio.scan.check.examination import check_scan, require_valid
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.pose_files import read_devices, read_ground_truth, read_poses, write_transforms
from sl_nerfstudio.scan.reading import read_scan
from sl_nerfstudio.scan.types import UNITS, Frame, GroundTruth, PoseSigma, Scale, Scan
from sl_nerfstudio.scan.writing import ScanWriter

__all__ = [
    "UNITS",
    "Fault",
    "FileError",
    "Frame",
    "GroundTruth",
    "PoseSigma",
    "Scale",
    "Scan",
    "ScanError",
    "ScanWriter",
    "check_scan",
    "read_devices",
    "read_ground_truth",
    "read_poses",
    "read_scan",
    "require_valid",
    "write_transforms",
]
