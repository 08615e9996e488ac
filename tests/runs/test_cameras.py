"""Cameras and trajectories for other programs: a known corner lands on the right pixel, by their own formulas."""

import json
import math
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.runs.cameras import (
    PosedDevice,
    PosedFrames,
    SurfaceTracks,
    encode_blender,
    encode_colmap,
    encode_kitti,
    encode_tum,
    require_possible,
)

CAMERA = Device(w=640, h=480, fl_x=700.0, fl_y=720.0, cx=300.0, cy=260.0, k1=-0.1, k2=0.02, p1=1e-3, p2=-2e-3)
PINHOLE = Device(w=640, h=480, fl_x=700.0, fl_y=720.0, cx=300.0, cy=260.0)
DOE = Device(w=800, h=600, fl_x=900.0, fl_y=905.0, cx=410.0, cy=290.0, model="DOE")
CORNER = np.array([12.0, -7.0, 31.0])  # mm, of no symmetry


def pose(degrees: list[float], place: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    T[:3, 3] = place
    return T


POSES = [pose([10, -20, 5], [40, -30, 330]), pose([-15, 8, 100], [0, 60, 290]), pose([3, 4, -70], [-20, 5, 350])]
SHIFT = pose([0, 9, 0], [70.0, 4.0, -3.0])


def frames(camera: Device = CAMERA, projector: Device = DOE, placed=(True, True, True)) -> PosedFrames:
    named = [(f"frame_{k:05d}", T) for k, T in enumerate(POSES)]
    cameras = tuple(PosedDevice(n, camera, T, Path(f"/scan/images/{n}.png")) for n, T in named)
    projectors = tuple(PosedDevice(n, projector, T @ SHIFT, Path("/scan/pattern.png")) for n, T in named)
    return PosedFrames(cameras, projectors, placed)


def pixel(device: Device, T: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The formulas of docs/scan-format.md and OpenCV, written down again."""
    x, y, z = T[:3, :3].T @ (p - T[:3, 3])
    depth = -z if device.model == "OPENCV" else math.sqrt(x * x + y * y + z * z)
    a, b = x / depth, -y / depth
    r2 = a * a + b * b
    radial = 1 + device.k1 * r2 + device.k2 * r2 * r2
    u = a * radial + 2 * device.p1 * a * b + device.p2 * (r2 + 2 * a * a)
    v = b * radial + device.p1 * (r2 + 2 * b * b) + 2 * device.p2 * a * b
    return np.array([device.fl_x * u + device.cx, device.fl_y * v + device.cy])


def tracks(all_frames: PosedFrames) -> SurfaceTracks:
    points = np.stack([CORNER, -CORNER])
    frame, point = np.repeat(np.arange(3), 2), np.tile(np.arange(2), 3)
    seen = [
        np.stack([pixel(d[k].device, d[k].T_world_device, points[i]) for k, i in zip(frame, point, strict=True)])
        for d in (all_frames.cameras, all_frames.projectors)
    ]
    rgb = np.array([[10, 20, 30], [40, 50, 60]], dtype=np.uint8)
    return SurfaceTracks(points, rgb, point, frame, seen[0], seen[1], np.full(6, 0.5))


def read_colmap(folder: Path, of: PosedFrames) -> pycolmap.Reconstruction:
    for name, content in encode_colmap(of, Path("/scan"), tracks(of)).items():
        (folder / name).write_bytes(content)
    model = pycolmap.Reconstruction()
    model.read_text(str(folder))
    return model


@pytest.mark.parametrize("camera", [CAMERA, PINHOLE], ids=["distorted", "pinhole"])
def test_colmap_projects_the_corner_to_the_right_pixels_of_cameras_and_projectors(camera, tmp_path):
    of = frames(camera)
    model = read_colmap(tmp_path, of)
    images = {image.name: image for image in model.images.values()}
    assert len(images) == 6 and len(model.cameras) == 2 and len(model.points3D) == 2
    for k in range(3):
        for folder, posed in (("images", of.cameras[k]), ("projector", of.projectors[k])):
            image, expected = images[f"{folder}/frame_{k:05d}.png"], pixel(posed.device, posed.T_world_device, CORNER)
            np.testing.assert_allclose(image.project_point(CORNER), expected, atol=2e-5)
            np.testing.assert_allclose(image.points2D[0].xy, expected, atol=1e-4)
            assert image.points2D[0].point3D_id == 1
    assert np.array_equal(model.points3D[2].color, [40, 50, 60]) and model.points3D[1].track.length() == 6
    assert model.points3D[1].error == pytest.approx(0.25)  # half a pixel in projectors, none in cameras


def test_devices_that_are_fixed_to_each_other_are_one_rig_of_colmap(tmp_path):
    fixed = read_colmap(tmp_path, frames(PINHOLE))  # all of these have one relative pose
    assert len(fixed.rigs) == 1 and len(fixed.frames) == 3
    first, second, third = frames(PINHOLE).projectors
    other = replace(second, T_world_device=POSES[1] @ pose([0, 9.001, 0], [70.0, 4.0, -3.0]))
    free = replace(frames(PINHOLE), projectors=(first, other, third))
    (tmp_path / "free").mkdir()
    model = read_colmap(tmp_path / "free", free)
    assert len(model.rigs) == 2 and len(model.frames) == 6
    image = next(image for image in model.images.values() if image.name == "projector/frame_00001.png")
    np.testing.assert_allclose(image.project_point(CORNER), pixel(DOE, other.T_world_device, CORNER), atol=2e-5)


def test_frames_that_are_not_placed_are_no_images_of_colmap(tmp_path):
    model = read_colmap(tmp_path, frames(placed=(True, False, True)))
    assert sorted(image.name for image in model.images.values()) == [
        *(f"images/frame_{k:05d}.png" for k in (0, 2)), *(f"projector/frame_{k:05d}.png" for k in (0, 2)),
    ]  # fmt: skip
    assert model.points3D[1].track.length() == 4


def test_what_colmap_cannot_hold_is_refused():
    first, *others = frames().cameras
    spaced = replace(frames(), cameras=(replace(first, image=Path("/scan/images/a b.png")), *others))
    require_possible(frames(), Path("/scan"))
    for wrong, message in (
        (frames(projector=replace(DOE, k1=0.1)), "diffractive element and lens distortion"),
        (spaced, "'images/a b.png' has a space"),
        (frames(placed=(False, False, False)), "no frame agrees with the others"),
    ):
        with pytest.raises(UserError, match=rf"{message}(.|\n)*remedy"):
            require_possible(wrong, Path("/scan"))


class _Collection(list):
    """As much of Blender's collections as the script uses."""

    def get(self, name):
        return next((thing for thing in self if thing.name == name), None)

    def new(self, *arguments):
        self.append(_Thing(*arguments))
        return self[-1]

    def link(self, thing):
        self.append(thing)

    def __getitem__(self, key):
        return self.get(key) if isinstance(key, str) else super().__getitem__(key)


class _Thing(dict):
    """A camera, an object or a collection of Blender."""

    def __init__(self, name, data=None):
        super().__init__()
        self.name, self.data, self.objects, self.children = name, data, _Collection(), _Collection()
        self.background_images = _Collection()


def _run_in_blender(script: bytes, monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    bpy, mathutils = types.ModuleType("bpy"), types.ModuleType("mathutils")
    scene = types.SimpleNamespace(collection=_Thing("Scene"), render=types.SimpleNamespace(), camera=None)
    bpy.context = types.SimpleNamespace(scene=scene)
    bpy.data = types.SimpleNamespace(cameras=_Collection(), objects=_Collection(), collections=_Collection())
    mathutils.Matrix = np.array
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    monkeypatch.setitem(sys.modules, "mathutils", mathutils)
    exec(compile(script, "cameras_blender.py", "exec"), {"__name__": "__main__"})
    return bpy


def _blender_pixel(thing: _Thing, p_metres: np.ndarray) -> np.ndarray:
    """Blender's camera: looks along -z; film 36 mm wide; shifts in film widths; pixels of the given aspect."""
    x, y, z = (np.linalg.inv(thing.matrix_world) @ [*p_metres, 1.0])[:3]
    camera, w, h = thing.data, thing["w"], thing["h"]
    aspect = thing["fl_x"] / thing["fl_y"]  # height of a pixel over its width, as look_through sets it
    across = camera.lens / camera.sensor_width * x / -z - camera.shift_x
    up = camera.lens / camera.sensor_width * y / -z - camera.shift_y
    return np.array([w / 2 + w * across, h / 2 - w * up / aspect])


def test_blender_sees_the_corner_at_the_right_pixel_and_keeps_what_it_has_no_place_for(monkeypatch):
    of = frames(PINHOLE, PINHOLE)
    bpy = _run_in_blender(encode_blender(of, 1e-3), monkeypatch)
    for name, devices in (("camera", of.cameras), ("projector", of.projectors)):
        for k, posed in enumerate(devices):
            thing = bpy.data.objects[f"frame_{k:05d} {name}"]
            expected = pixel(posed.device, posed.T_world_device, CORNER)
            np.testing.assert_allclose(_blender_pixel(thing, CORNER / 1000), expected, atol=1e-9)
    render = bpy.context.scene.render
    assert (render.resolution_x, render.resolution_y) == (640, 480)
    assert render.pixel_aspect_y / render.pixel_aspect_x == pytest.approx(700 / 720)
    assert bpy.context.scene.camera is bpy.data.objects["frame_00000 camera"]
    assert {c.name: len(c.objects) for c in bpy.data.collections} == {"cameras": 3, "projectors": 3}
    text = encode_blender(frames(placed=(True, False, True)), None).decode()
    devices = json.loads(text.split('r"""')[1].split('"""')[0])
    assert [d["placed"] for d in devices["cameras"]] == [True, False, True]
    assert devices["cameras"][0]["k1"] == -0.1 and devices["projectors"][0]["model"] == "DOE"
    assert "the scan's arbitrary unit" in text


@pytest.mark.parametrize("kind", ["tum", "kitti"])
def test_trajectories_see_the_corner_at_the_right_pixel(kind):
    devices = frames(PINHOLE).cameras
    if kind == "tum":
        rows = np.loadtxt(encode_tum(devices, (True, True, True), 1e-3).decode().splitlines())
        assert rows[:, 0].tolist() == [0, 1, 2]
        found = np.concatenate([Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4, None]], 2)
    else:
        found = np.loadtxt(encode_kitti(devices, 1e-3).decode().splitlines()).reshape(3, 3, 4)
    for T, posed in zip(found, devices, strict=True):
        x, y, z = T[:, :3].T @ (CORNER / 1000 - T[:, 3])  # +y down, looking along +z
        uv = [700 * x / z + 300, 720 * y / z + 260]
        np.testing.assert_allclose(uv, pixel(PINHOLE, posed.T_world_device, CORNER), atol=1e-6)
