"""procam-calibration's calibration_result.xml, an OpenCV file: the centre of the first pixel is (0, 0).

The projector was measured at the first pixel of each Gray-code cell, not at the middle of the cell.
"""

from pathlib import Path
from typing import Any

from sl_nerfstudio.calibration.formats.entry import DeviceEntry
from sl_nerfstudio.calibration.formats.opencv import FIRST_CENTRE, image_size, opencv_entry


def is_procam(stored: dict[str, Any]) -> bool:
    """Whether the content of an OpenCV file was written by procam-calibration."""
    return "cam_int" in stored and "proj_int" in stored


def procam_entries(path: Path, stored: dict[str, Any], step: int) -> list[DeviceEntry]:
    """Camera and projector; `step` is the graycode_step of the calibration. Raises FileError.

    `img_shape` is (rows, columns) of the camera; the file does not state the projector's size.
    """
    shape = stored.get("img_shape")
    size = None
    if shape is not None:
        rows, columns = image_size(path, shape)
        size = (columns, rows)
    # Measured at `step * index of the cell`, its first pixel; its middle is (step - 1) / 2 further.
    middle = (step - 1) / 2 + FIRST_CENTRE
    return [
        opencv_entry(path, "cam_int", "camera", size, stored["cam_int"], stored.get("cam_dist"), FIRST_CENTRE),
        opencv_entry(path, "proj_int", "projector", None, stored["proj_int"], stored.get("proj_dist"), middle),
    ]
