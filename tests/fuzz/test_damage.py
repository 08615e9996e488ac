"""Damaged intrinsics, patterns, poses, meshes and scans: refused with a message, or what they were; never a crash."""

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sl_nerfstudio.calibration.formats import read_device_file
from sl_nerfstudio.errors import ScanError, UserError
from sl_nerfstudio.evaluation.evaluate import read_points
from sl_nerfstudio.meshing.files import read_mesh, write_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.processing.inputs import read_given_poses
from sl_nerfstudio.scan import PickedPixel, PoseSigma, Scale, ScaleBar, check_scan, read_scan
from tests.fuzz.damage import IMPOSSIBLE, damaged, places, removed, replaced
from tests.scan.sphere_scan import NAMES, write_sphere

few = settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))

SIZE = (640, 480)
K = np.array([[900.0, 0, 322.3], [0, 905.0, 236.8], [0, 0, 1]])
LENS = np.array([[0.08, -0.12, 0.001, -0.0007]])
SPHERE = Mesh(
    np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]]), np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
)


def storage(path):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    values = {"image_width": 640, "image_height": 480, "camera_matrix": K, "distortion_coefficients": LENS}
    for key, value in values.items():
        file.write(key, value)
    file.release()
    return path.read_bytes()


CAMERA = {"w": 640, "h": 480, "fl_x": 900.0, "fl_y": 905.0, "cx": 322.8, "cy": 237.3, "k1": 0.08, "k2": -0.12}
LAYOUTS = (GridPattern(w=160, h=120, period=16.0, line_width=3.0, gap=5.0, seed=9), GrayCode(64, 48, 2))
POINTS = np.random.default_rng(0).normal(size=(100, 3))
FRAMES = [{"file_path": f"a/{k}.png", "transform_matrix": np.eye(4).tolist()} for k in "abc"]


def mesh(path):
    write_mesh(path, SPHERE)
    return path.read_bytes()


def points(path):
    np.savez_compressed(path, xyz=POINTS)
    return path.read_bytes()


def device(path):
    """The numbers are those of a possible camera."""
    d = read_device_file(path, "camera", SIZE)
    possible = 64 <= d.fl_x <= 64000 and 64 <= d.fl_y <= 64000 and bool(np.isfinite([d.cx, d.k1]).all())
    return (d.w, d.h) == SIZE and possible


def grid(path):
    """Any change of a symbol is found; only lengths may be other possible ones."""
    read = read_layout(path)
    return isinstance(read, GridPattern) and np.array_equal(read.codes, np.asarray(LAYOUTS[0].codes))


def surface(path):
    found = read_mesh(path)
    inside = len(found.faces) and found.faces.min() >= 0 and found.faces.max() < len(found.vertices)
    return bool(inside) and bool(np.isfinite(found.vertices).all())


# What writes each file, and what reads it and tells whether that may be what it holds.
FILES: dict[str, tuple[Callable[[Path], bytes], Callable[[Path], bool]]] = {
    "a.json": (lambda _: json.dumps({"camera": CAMERA, "projector": CAMERA}).encode(), device),
    "a.txt": (lambda _: b"# cameras\n1 OPENCV 640 480 900 905 322.8 237.3 0.08 -0.12 0.001 -0.0007\n", device),
    "a.yml": (storage, device),
    "a.xml": (storage, device),
    "pattern.json": (lambda _: LAYOUTS[0].encode(), grid),
    **{f"mesh.{suffix}": (mesh, surface) for suffix in ("ply", "obj", "stl", "glb")},
    "points.npz": (points, lambda path: np.array_equal(read_points(path), POINTS)),
}


def accepted(path, read):
    """Whether a file is read, and then holds what it may; else it is refused by its name."""
    try:
        assert read(path)
    except UserError as error:
        assert path.name in str(error) and (read is not device or "remedy:" in str(error))
        return False
    return True


@pytest.mark.parametrize("name", FILES)
@few
@given(data=st.data())
def test_damaged_files(tmp_path_factory, name, data):
    path, (write, read) = tmp_path_factory.getbasetemp() / name, FILES[name]
    path.write_bytes(data.draw(damaged(write(path))))
    accepted(path, read)


@few
@given(data=st.data())
def test_impossible_intrinsics(tmp_path_factory, data):
    document = {"camera": CAMERA}
    place = data.draw(st.sampled_from([p for p in places(document) if p[-1] not in ("k1", "k2")]))
    value = data.draw(st.sampled_from([v for v in IMPOSSIBLE if v != -1]))
    path = tmp_path_factory.getbasetemp() / "impossible.json"
    path.write_text(json.dumps(replaced(document, place, value)))
    assert not accepted(path, device), f"{place} = {value!r:.60} was accepted"


def changed(document, data, free=()):
    """The document with an impossible value at some place, or without it; keys in `free` are for people."""
    place = data.draw(st.sampled_from([p for p in places(document) if p[0] not in free]))
    value = data.draw(st.sampled_from(["gone", *IMPOSSIBLE]))
    return json.dumps(removed(document, place) if value == "gone" else replaced(document, place, value))


@pytest.mark.parametrize("layout", LAYOUTS, ids=["grid", "gray"])
@few
@given(data=st.data())
def test_impossible_patterns(tmp_path_factory, layout, data):
    path = tmp_path_factory.getbasetemp() / "impossible_pattern.json"
    path.write_text(changed(json.loads(layout.encode()), data, ("image", "symbols", "window")))
    accepted(path, lambda path: read_layout(path).encode() == layout.encode())


@few
@given(data=st.data())
def test_impossible_poses(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "poses.json"
    path.write_text(changed({"units": "mm", "frames": FRAMES}, data))
    accepted(path, lambda path: bool(read_given_poses(path, ["a", "b", "c"]).known.sum() >= 2))


# Scans: the check names faults or finds the same scan.

SIGMA = PoseSigma(3.0, 1.0, 2.0, 0.25)
BAR = ScaleBar((PickedPixel(NAMES[1], (30.25, 20.0)), PickedPixel(NAMES[3], (40.5, 33.5))), 51.5)
OPTIONAL = {"source", "mask_path", "sl_pattern_path", "sl_pose_sigma", "k1", "k2", "p1", "p2"}


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    root = write_sphere(tmp_path_factory.mktemp("fuzz") / "scan", frames=4, scale=Scale(True, "a ruler", bar=BAR))
    path = root / "transforms.json"
    document = json.loads(path.read_text())
    document["sl_pose_sigma"] = vars(SIGMA)
    path.write_text(json.dumps(document))
    return root


@pytest.fixture(scope="module")
def root(original, tmp_path_factory):
    """A copy to be damaged; every test puts back what it changed."""
    return Path(shutil.copytree(original, tmp_path_factory.mktemp("damaged") / "scan"))


def pixels(scan):
    frames = [
        array for f in scan.frames for array in (f.read_image(), f.read_pattern(), f.read_coords(), f.read_mask())
    ]
    return [scan.read_pattern(), *frames]


@pytest.mark.slow
@few
@given(data=st.data())
def test_impossible_values_are_refused(original, root, data):
    document = json.loads((original / "transforms.json").read_text())
    place = data.draw(st.sampled_from(list(places(document))))
    value = data.draw(st.sampled_from(IMPOSSIBLE))
    (root / "transforms.json").write_text(json.dumps(replaced(document, place, value)))
    faults = check_scan(root)
    assert faults or may_stay(place, value), f"{place} = {value!r:.60} was accepted"
    str(ScanError(faults)) if faults else read_scan(root)


def may_stay(place, value):
    """Texts for people may be anything, what is optional may be absent, and -1 is a number like others."""
    key = place[-1]
    return (
        key == "source"
        or (value is None and key in OPTIONAL)
        or (value == -1 and (isinstance(key, int) or key in ("k1", "k2", "cx", "cy")))
        or (key == "units" and value == "arbitrary")
    )


@few
@given(data=st.data())
def test_missing_values_are_refused(original, root, data):
    document = json.loads((original / "transforms.json").read_text())
    place = data.draw(st.sampled_from(list(places(document))))
    (root / "transforms.json").write_text(json.dumps(removed(document, place)))
    faults = check_scan(root)
    frame = len(place) == 2 and place[0] == "frames" and place[1] not in (1, 3)  # the known length is in 1 and 3
    bar_is_gone = place == ("scale", "source")
    assert faults or frame or bar_is_gone or place[-1] in OPTIONAL, f"without {place} it was accepted"


@pytest.mark.slow
@few
@given(data=st.data())
def test_a_damaged_file_is_refused_or_holds_the_same(original, root, data):
    files = sorted(p.relative_to(original) for p in original.rglob("*.*") if p.suffix in (".png", ".npz"))
    name = data.draw(st.sampled_from(files))
    content = (original / name).read_bytes()
    (root / "transforms.json").write_bytes((original / "transforms.json").read_bytes())
    try:
        (root / name).write_bytes(data.draw(damaged(content)))
        if not check_scan(root):
            same = zip(pixels(read_scan(root)), pixels(read_scan(original)), strict=True)
            assert all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in same), name
    finally:
        (root / name).write_bytes(content)


@few
@given(data=st.data())
def test_a_damaged_document_is_no_crash(original, root, data):
    (root / "transforms.json").write_bytes(data.draw(damaged((original / "transforms.json").read_bytes())))
    if faults := check_scan(root):
        assert str(ScanError(faults))
        with suppress(UserError):
            read_scan(root)
