"""Damaged intrinsics, patterns, poses and meshes: refused with a message, or what they were; never a crash."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sl_nerfstudio.calibration.formats import read_device_file
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import read_points
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.meshing.files import read_mesh, write_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.processing.inputs import GivenPoses, read_given_poses
from tests.fuzz.damage import IMPOSSIBLE, damaged, places, removed, replaced

SIZE = (640, 480)
K = np.array([[900.0, 0, 322.3], [0, 905.0, 236.8], [0, 0, 1]])
LENS = np.array([[0.08, -0.12, 0.001, -0.0007]])
SPHERE = Mesh(
    np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]]), np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
)
few = settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


def storage(path: Path) -> bytes:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in (
        ("image_width", 640),
        ("image_height", 480),
        ("camera_matrix", K),
        ("distortion_coefficients", LENS),
    ):
        file.write(key, value)
    file.release()
    return path.read_bytes()


CAMERA = {"w": 640, "h": 480, "fl_x": 900.0, "fl_y": 905.0, "cx": 322.8, "cy": 237.3, "k1": 0.08, "k2": -0.12}
INTRINSICS: dict[str, Callable[[Path], bytes]] = {
    "a.json": lambda _: json.dumps({"camera": CAMERA, "projector": CAMERA}).encode(),
    "a.txt": lambda _: b"# cameras\n1 OPENCV 640 480 900 905 322.8 237.3 0.08 -0.12 0.001 -0.0007\n",
    "a.yml": storage,
    "a.xml": storage,
}


@pytest.mark.parametrize("name", list(INTRINSICS))
@few
@given(data=st.data())
def test_damaged_intrinsics(tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject) -> None:
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(data.draw(damaged(INTRINSICS[name](path))))
    check_device(path)


@few
@given(data=st.data())
def test_impossible_intrinsics(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    document = {"camera": CAMERA}
    place = data.draw(st.sampled_from([p for p in places(document) if p[-1] not in ("k1", "k2")]))
    value = data.draw(st.sampled_from([v for v in IMPOSSIBLE if v != -1]))
    path = tmp_path_factory.getbasetemp() / "impossible.json"
    path.write_text(json.dumps(replaced(document, place, value)))
    with pytest.raises(UserError):
        check_device(path)
        raise AssertionError(f"{place} = {value!r:.60} was accepted")


def check_device(path: Path) -> None:
    """A device whose numbers are those of a possible camera, or a UserError."""
    try:
        device = read_device_file(path, "camera", SIZE)
    except UserError as error:
        assert path.name in str(error) and "remedy:" in str(error)
        if path.stem == "impossible":
            raise
        return
    assert isinstance(device, Device) and (device.w, device.h) == SIZE
    assert 64 <= device.fl_x <= 64000 and 64 <= device.fl_y <= 64000 and np.isfinite([device.cx, device.k1]).all()


LAYOUTS = (GridPattern(w=160, h=120, period=16.0, line_width=3.0, gap=5.0, seed=9), GrayCode(64, 48, 2))


@pytest.mark.parametrize("layout", LAYOUTS, ids=["grid", "gray"])
@few
@given(data=st.data())
def test_impossible_patterns(
    tmp_path_factory: pytest.TempPathFactory, layout: PatternLayout, data: st.DataObject
) -> None:
    document = json.loads(layout.encode())
    free = ("image", "symbols", "window")  # for people
    place = data.draw(st.sampled_from([p for p in places(document) if p[0] not in free]))
    value = data.draw(st.sampled_from(["gone", *IMPOSSIBLE]))
    path = tmp_path_factory.getbasetemp() / "impossible_pattern.json"
    changed = removed(document, place) if value == "gone" else replaced(document, place, value)
    path.write_text(json.dumps(changed))
    try:
        read = read_layout(path)
    except UserError as error:
        assert path.name in str(error)
        return
    assert read.encode() == layout.encode(), f"{place} = {value!r:.60} was accepted"


@few
@given(data=st.data())
def test_damaged_patterns(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Any change of a symbol is found; only lengths may be other possible ones."""
    path = tmp_path_factory.getbasetemp() / "damaged_pattern.json"
    path.write_bytes(data.draw(damaged(LAYOUTS[0].encode())))
    try:
        read = read_layout(path)
    except UserError as error:
        assert path.name in str(error)
        return
    assert isinstance(read, GridPattern) and np.array_equal(read.codes, np.asarray(LAYOUTS[0].codes))


@few
@given(data=st.data())
def test_damaged_poses(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    frames = [{"file_path": f"a/{k}.png", "transform_matrix": np.eye(4).tolist()} for k in "abc"]
    document = {"units": "mm", "frames": frames}
    place = data.draw(st.sampled_from(list(places(document))))
    value = data.draw(st.sampled_from(["gone", *IMPOSSIBLE]))
    path = tmp_path_factory.getbasetemp() / "poses.json"
    path.write_text(json.dumps(removed(document, place) if value == "gone" else replaced(document, place, value)))
    try:
        given_poses = read_given_poses(path, ["a", "b", "c"])
    except UserError as error:
        assert "poses.json" in str(error)
        return
    assert isinstance(given_poses, GivenPoses) and given_poses.known.sum() >= 2


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "glb"])
@few
@given(data=st.data())
def test_damaged_meshes(tmp_path_factory: pytest.TempPathFactory, suffix: str, data: st.DataObject) -> None:
    path = tmp_path_factory.getbasetemp() / f"mesh.{suffix}"
    write_mesh(path, SPHERE)
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    try:
        mesh = read_mesh(path)
    except UserError as error:
        assert path.name in str(error)
        return
    assert len(mesh.faces) and mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)
    assert np.isfinite(mesh.vertices).all()


@few
@given(data=st.data())
def test_damaged_points(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    points = np.random.default_rng(0).normal(size=(100, 3))
    path = tmp_path_factory.getbasetemp() / "points.npz"
    np.savez_compressed(path, xyz=points)
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    try:
        assert np.array_equal(read_points(path), points)
    except UserError as error:
        assert path.name in str(error)
