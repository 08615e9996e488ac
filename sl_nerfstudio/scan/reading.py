"""Reading a scan folder."""

import os
from pathlib import Path

from sl_nerfstudio.errors import ScanError
from sl_nerfstudio.scan.headers import check_headers
from sl_nerfstudio.scan.partial_scan import read_partial_scan
from sl_nerfstudio.scan.problem import Faults
from sl_nerfstudio.scan.types import Scan


def read_scan(root: Path, need_coords: bool = True) -> Scan:
    """The scan in a folder, after quick checks: transforms.json, paths, poses and the headers of all files.

    No pixel is decoded. `need_coords=False` accepts frames that were not decoded yet. Raises ScanError with all
    faults found.
    """
    root = Path(os.path.realpath(root))
    faults = Faults()
    partial = read_partial_scan(root, faults, need_coords)
    check_headers(partial, faults)
    if faults.found:
        raise ScanError(faults.found, str(root))
    return partial.complete()
