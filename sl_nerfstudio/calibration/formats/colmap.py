"""COLMAP's cameras.txt: the centre of the first pixel is (0.5, 0.5), as in a scan."""

from pathlib import Path

from sl_nerfstudio.calibration.formats.entry import LENS_TERMS, DeviceEntry, camera_matrix
from sl_nerfstudio.scan.file_error import FileError, read_bytes

# COLMAP's models by their parameters; f stands for both focal lengths.
_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}


def read_colmap_entries(path: Path) -> list[DeviceEntry]:
    """All cameras in a file. Raises FileError."""
    entries = []
    for number, line in enumerate(read_bytes(path).decode("utf-8", "replace").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            label, model, w, h = words[0], words[1], int(words[2]), int(words[3])
            values = [float(word) for word in words[4:]]
        except (IndexError, ValueError) as error:
            raise FileError(
                path,
                f"line {number} describes no camera",
                "this is not COLMAP's cameras.txt, or it was edited",
                "each line must be: CAMERA_ID MODEL WIDTH HEIGHT PARAMS..",
            ) from error
        entries.append(_entry(path, f"camera {label}", model, (w, h), values))
    if not entries:
        raise FileError(path, "contains no camera", "an empty reconstruction", "export the model from COLMAP again")
    return entries


def _entry(path: Path, label: str, model: str, size: tuple[int, int], values: list[float]) -> DeviceEntry:
    names = _MODELS.get(model, "").split()
    if not names or len(names) != len(values):
        raise FileError(
            path,
            f"{label} has model {model} with {len(values)} parameters",
            "a lens model that a scan does not have" if not names else f"{model} has {len(names)} parameters",
            f"calibrate with one of {', '.join(_MODELS)}",
        )
    v = dict(zip(names, values, strict=True))
    matrix = camera_matrix(v.get("fx", v.get("f", 0.0)), v.get("fy", v.get("f", 0.0)), v["cx"], v["cy"])
    return DeviceEntry(label, None, size, matrix, tuple(v.get(key, 0.0) for key in LENS_TERMS))
