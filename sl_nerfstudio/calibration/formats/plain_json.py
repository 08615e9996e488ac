"""Plain JSON: `camera` and `projector` objects.

The centre of the first pixel is (0.5, 0.5), or (0, 0) where the file says `"pixel_centre": 0`. The camera's keys may be
at the top level, as in transforms.json. Several cameras are objects in `cameras`, by their names. `sigma`, optional in
each device, holds 1 sigma of its `fl_x`, `cx` and `cy` in pixels.
"""

from pathlib import Path

from sl_nerfstudio.calibration.formats.entry import LENS_TERMS, DeviceEntry, Role, camera_matrix
from sl_nerfstudio.geometry.devices import DeviceKind
from sl_nerfstudio.scan.document import document_faults, read_document
from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.problem import Faults


def read_json_entries(path: Path) -> list[DeviceEntry]:
    """All devices in a file. Raises FileError."""
    document = read_document(path)
    faults = Faults()
    document_faults(document, path.name, faults)
    top = Fields(document, faults, path.name)
    offset = 0.5 - (top.read_number("pixel_centre", 0.5) or 0.0)
    found: list[DeviceEntry | None] = []
    if "camera" in document:
        section = top.read_section("camera")
        found.append(None if section is None else _entry(section, "camera", offset))
    elif "cameras" in document:
        cameras = top.read_section("cameras")
        for name in () if cameras is None else tuple(cameras.record):
            section = cameras.read_section(name) if cameras is not None else None
            found.append(None if section is None else _entry(section, "camera", offset, name))
    elif "fl_x" in document:
        found.append(_entry(top, "camera", offset))
    if "projector" in document:
        section = top.read_section("projector")
        found.append(None if section is None else _entry(section, "projector", offset))
    if faults.found:
        fault = faults.found[0]
        raise FileError(path, f"{fault.field}: {fault.problem}", fault.cause, fault.remedy)
    if not found:
        raise FileError(
            path,
            "describes neither a camera nor a projector",
            "another kind of JSON file",
            'give {"camera": {"w", "h", "fl_x", "fl_y", "cx", "cy", "k1", ..}, "projector": {..}}',
        )
    return [entry for entry in found if entry is not None]


def camera_names(path: Path) -> tuple[str, ...]:
    """Names of the cameras of a file with several, in its order; empty for a file with one or none."""
    if path.suffix.lower() != ".json":
        return ()
    cameras = read_document(path).get("cameras")
    return tuple(cameras) if isinstance(cameras, dict) else ()


def _entry(fields: Fields, role: Role, offset: float, name: str | None = None) -> DeviceEntry | None:
    """One device; None if a field is missing or wrong, which is then among the faults of `fields`."""
    model = "OPENCV"
    for key in ("model", "camera_model"):
        if key in fields.record:
            model = fields.read_choice(key, ("OPENCV", "DOE"), "a model that a scan does not have")
    w, h = fields.read_count("w"), fields.read_count("h")
    numbers = [fields.read_number(key) for key in ("fl_x", "fl_y", "cx", "cy")]
    sigma = fields.read_section("sigma") if "sigma" in fields.record else None
    doubts = [0.0 if sigma is None else _at_least_zero(sigma, key) for key in ("fl_x", "cx", "cy")]
    lens = [fields.read_number(key, 0.0) for key in LENS_TERMS]
    if model is None or w is None or h is None or None in numbers or None in lens or None in doubts:
        return None
    fl_x, fl_y, cx, cy = (n or 0.0 for n in numbers)
    kind: DeviceKind = "DOE" if model == "DOE" else "OPENCV"
    matrix = camera_matrix(fl_x, fl_y, cx + offset, cy + offset)
    focal, x, y = (s or 0.0 for s in doubts)
    return DeviceEntry(name or role, role, (w, h), matrix, tuple(k or 0.0 for k in lens), kind, (focal, x, y))


def _at_least_zero(fields: Fields, key: str) -> float | None:
    """A standard deviation; 0 if it is not stated."""
    value = fields.read_number(key, 0.0)
    if value is not None and value < 0:
        fields.fault(key, f"is {value:g}", "a standard deviation is at least 0", "correct it, or leave sigma out")
        return None
    return value
