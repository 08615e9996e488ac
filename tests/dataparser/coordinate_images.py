"""The coordinates of a scan folder as other programs store them: pairs of 16-bit images, or one TIFF of both."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy import ndarray

Store = Callable[[Path, str, ndarray, ndarray], dict[str, str]]
"""Writes the images of a frame (root, name, coordinates, size of the pattern); returns its keys."""


def replace_coords(root: Path, store: Store, units: str | None, in_frames: bool = False) -> Path:
    """Store all coordinates of a scan in another way, and remove the arrays."""
    path = root / "transforms.json"
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    size = np.array([document["projector"]["w"], document["projector"]["h"]], dtype=np.float64)
    for frame in document["frames"]:
        array = root / frame.pop("sl_coords_path")
        with np.load(array) as stored:
            coords = stored["coords"]
        array.unlink()
        frame.update(store(root, Path(frame["file_path"]).stem, coords, size))
        if in_frames:
            frame["sl_coords_units"] = units
    if units is not None and not in_frames:
        document["sl_coords_units"] = units
    path.write_text(json.dumps(document), encoding="utf-8")
    return root


def parts(coords: ndarray, size: ndarray) -> ndarray:
    """As whole parts of 65535 of the pattern, 0 where not decoded."""
    return np.nan_to_num(np.round(coords.astype(np.float64) / size * 65535), nan=0.0).astype(np.uint16)


def pair_of_parts(root: Path, name: str, coords: ndarray, size: ndarray) -> dict[str, str]:
    return _pair(root, name, parts(coords, size))


def pair_of_indices(root: Path, name: str, coords: ndarray, size: ndarray) -> dict[str, str]:
    """Numbers of pattern pixels, counted from 0; what lies on row or column 0 is lost."""
    return _pair(root, name, np.nan_to_num(np.floor(coords), nan=0.0).astype(np.uint16))


def _pair(root: Path, name: str, values: ndarray) -> dict[str, str]:
    keys = {f"coords_{axis}": f"coords/{name}_{axis}.png" for axis in "xy"}
    for k, path in enumerate(keys.values()):
        assert cv2.imwrite(str(root / path), values[..., k])
    return keys


def one_tiff(root: Path, name: str, coords: ndarray, size: ndarray) -> dict[str, str]:
    """Floating-point x and y."""
    path = f"coords/{name}.tif"
    tifffile.imwrite(root / path, coords, photometric="minisblack", planarconfig="contig")
    return {"sl_coords_path": path}
