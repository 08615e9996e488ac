"""A Python script that sets up all cameras and projectors of a scan in Blender."""

import json
from collections.abc import Sequence
from typing import Any

from sl_nerfstudio.runs.cameras.posed_device import PosedDevice, PosedFrames

_SCRIPT = '''"""Cameras and projectors of a scan, for Blender 2.83 or newer.

Run it with `blender --python cameras_blender.py`, or open it in Blender's text editor and press "Run Script".
It makes two collections, `cameras` and `projectors`; a projector is a camera that looks as it shines. Lengths are in
@UNIT@, which Blender shows as metres, with the scan's axes (z up). Import the mesh as .glb: it then lies in the same
place. Import .ply and .obj with "Z up, Y forward", and scale them by @SCALE@.

Select a camera and call `look_through("FRAME camera")` in the Python console to set the size of the rendered image.
Blender has no lens distortion: it is kept in custom properties, and images have to be undistorted before they fit.
"""

import json
import os

import bpy
from mathutils import Matrix

SENSOR_MM = 36.0  # width of the film that Blender assumes; focal lengths in pixels do not depend on it
DEVICES = json.loads(r"""
@DEVICES@
""")


def collection(name):
    """A collection of the scene, empty."""
    found = bpy.data.collections.get(name)
    if found is None:
        found = bpy.data.collections.new(name)
        bpy.context.scene.collection.children.link(found)
    for old in list(found.objects):
        bpy.data.objects.remove(old, do_unlink=True)
    return found


def add(device, where):
    """A camera object with the device's intrinsics, its pose and the image that it saw or shone."""
    w, h, fx, fy = (device[key] for key in ("w", "h", "fl_x", "fl_y"))
    camera = bpy.data.cameras.new(device["name"])
    camera.sensor_fit = "HORIZONTAL"
    camera.sensor_width = SENSOR_MM
    camera.lens = fx / w * SENSOR_MM
    camera.shift_x = 0.5 - device["cx"] / w
    camera.shift_y = (device["cy"] - h / 2) / w * fx / fy
    camera.display_size = device["size"]
    thing = bpy.data.objects.new(device["name"], camera)
    thing.matrix_world = Matrix(device["matrix"])
    for key in ("model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "placed"):
        thing[key] = device[key]
    if os.path.isfile(device["image"]):
        background = camera.background_images.new()
        background.image = bpy.data.images.load(device["image"], check_existing=True)
        camera.show_background_images = True
    where.objects.link(thing)


def look_through(name):
    """Make a camera the scene's, with the size and the shape of its pixels."""
    thing = bpy.data.objects[name]
    scene = bpy.context.scene
    scene.camera = thing
    scene.render.resolution_x, scene.render.resolution_y = thing["w"], thing["h"]
    scene.render.resolution_percentage = 100
    ratio = thing["fl_x"] / thing["fl_y"]
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = max(1.0, 1 / ratio), max(1.0, ratio)


for kind in ("cameras", "projectors"):
    group = collection(kind)
    for entry in DEVICES[kind]:
        add(entry, group)
look_through(DEVICES["cameras"][0]["name"])
'''


def encode_blender(frames: PosedFrames, unit_m: float | None) -> bytes:
    """The script. Lengths are multiplied by `unit_m`; None: they stay in the scan's arbitrary unit.

    A DOE is a pinhole here, with the same focal length: right near its axis only.
    """
    factor = unit_m or 1.0
    size = 0.1 * factor * _distance(frames)
    devices = {
        "cameras": _records(frames.cameras, frames.placed, "camera", factor, size),
        "projectors": _records(frames.projectors, frames.placed, "projector", factor, size),
    }
    text = _SCRIPT.replace("@DEVICES@", json.dumps(devices, indent=1, ensure_ascii=True))
    text = text.replace("@UNIT@", "metres" if unit_m else "the scan's arbitrary unit").replace("@SCALE@", f"{factor:g}")
    return text.encode()


def _distance(frames: PosedFrames) -> float:
    """A length of the scene, for the size of what is drawn: the mean distance of the devices from their middle."""
    places = [device.T_world_device[:3, 3] for device in (*frames.cameras, *frames.projectors)]
    middle = sum(places) / len(places)
    return float(sum(((p - middle) ** 2).sum() ** 0.5 for p in places) / len(places))


def _records(
    devices: Sequence[PosedDevice], placed: Sequence[bool], kind: str, factor: float, size: float
) -> list[dict[str, Any]]:
    records = []
    for posed, good in zip(devices, placed, strict=True):
        matrix = posed.T_world_device.copy()
        matrix[:3, 3] *= factor
        record = {"name": f"{posed.frame} {kind}", "placed": good, "image": str(posed.image), "size": size}
        records.append({**record, **vars(posed.device), "matrix": matrix.tolist()})
    return records
