"""The scan folder (format 1): reading, checking and writing it. See docs/scan-format.md."""

from sl_nerfstudio.errors import Fault, ScanError
from sl_nerfstudio.scan.types import UNITS, Frame, GroundTruth, PoseSigma, Scale, Scan
from sl_nerfstudio.scan.writing import ScanWriter

__all__ = ["UNITS", "Fault", "Frame", "GroundTruth", "PoseSigma", "Scale", "Scan", "ScanError", "ScanWriter"]
