"""A COLMAP model as text, with the projector as a second camera: cameras, rigs, frames, images and points3D.

COLMAP's pixels are this package's: the centre of the first is (0.5, 0.5). Lengths and world axes are the scan's. Each
frame has two images: the capture and, under the name `projector/FRAME.png`, the pattern as its projector "sees" it.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64, UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Y_Z_DOWN, Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.geometry.numerics import evenly_spaced
from sl_nerfstudio.geometry.triangulation import world_pixels
from sl_nerfstudio.meshing.mesh import GREY, Mesh
from sl_nerfstudio.meshing.uncertainty import views_by_frame
from sl_nerfstudio.scan.types import Scan

# Cameras and projectors with their poses, in the unit and the axes of other programs.


@dataclass(frozen=True)
class PosedDevice:
    """The camera or the projector of one frame; lengths in the scan's unit."""

    frame: str
    device: Device
    T_world_device: Float64[ndarray, "4 4"]  # +y up, looking along -z
    image: Path  # what it shows: the capture, or the pattern

    @property
    def T_world_cv(self) -> Float64[ndarray, "4 4"]:
        """The same pose for axes with +y down, looking along +z."""
        return self.T_world_device @ Y_Z_DOWN


@dataclass(frozen=True)
class PosedFrames:
    """All devices of a run, in the order of the scan's frames."""

    cameras: tuple[PosedDevice, ...]
    projectors: tuple[PosedDevice, ...]
    placed: tuple[bool, ...]  # of each frame: False if it does not agree with the others, so that its poses say nothing


def posed_frames(scan: Scan, poses: DevicePoses, unplaced: Sequence[bool]) -> PosedFrames:
    """The devices of a scan at refined poses."""
    every = list(zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True))
    cameras = tuple(PosedDevice(f.name, f.camera, T, f.image_path) for f, T, _ in every)
    projectors = tuple(PosedDevice(f.name, scan.projector, T, scan.pattern_path) for f, _, T in every)
    return PosedFrames(cameras, projectors, tuple(not lost for lost in unplaced))


# Trajectories in the text formats of the TUM RGB-D and KITTI odometry benchmarks, which evo and others read.


def encode_tum(devices: Sequence[PosedDevice], placed: Sequence[bool], unit_m: float) -> bytes:
    """A line `timestamp tx ty tz qx qy qz qw` for each frame that is placed; the timestamp is its number, from 0.

    Poses are device to world, the device looking along its +z with +y down. Lengths are multiplied by `unit_m`.
    """
    lines = ["# timestamp tx ty tz qx qy qz qw (device to world; the timestamp is the number of the frame)"]
    for number, (device, good) in enumerate(zip(devices, placed, strict=True)):
        if good:
            T = device.T_world_cv
            values = [*(T[:3, 3] * unit_m), *Rotation.from_matrix(T[:3, :3]).as_quat()]
            lines.append(" ".join([f"{number:.6f}", *map(_number, values)]))
    return ("\n".join(lines) + "\n").encode()


def encode_kitti(devices: Sequence[PosedDevice], unit_m: float) -> bytes:
    """A line for every frame: the first three rows of its pose, device to world, axes and unit as for TUM.

    Lines are numbered as frames are, so frames that are not placed are among them.
    """
    poses = [np.concatenate([d.T_world_cv[:3, :3], d.T_world_cv[:3, 3:] * unit_m], 1) for d in devices]
    return ("\n".join(" ".join(map(_number, T.ravel())) for T in poses) + "\n").encode()


def _number(value: float) -> str:
    return f"{value:.12g}"


# A Python script that sets up all cameras and projectors of a scan in Blender.

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
        f"{kind}s": _records(posed, frames.placed, kind, factor, size)
        for kind, posed in (("camera", frames.cameras), ("projector", frames.projectors))
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


# Points of the surface with the pixels of all cameras and projectors that measured them.

_POINTS = 20_000  # at most


@dataclass(frozen=True)
class SurfaceTracks:
    """Points, and the frames that confirm each of them."""

    p_world: Float64[ndarray, "n 3"]
    rgb: UInt8[ndarray, "n 3"]
    point: Int64[ndarray, "m"]  # of each observation, by its place in `p_world`
    frame: Int64[ndarray, "m"]
    uv_camera: Float64[ndarray, "m 2"]  # where the camera sees the point
    uv_projector: Float64[ndarray, "m 2"]  # what was decoded there
    residual_px: Float64[ndarray, "m"]  # distance from where the projector would see the point


def surface_tracks(mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None, scan: Scan, poses: DevicePoses) -> SurfaceTracks:
    """Vertices of a mesh, evenly chosen."""
    chosen = evenly_spaced(len(mesh.vertices), min(_POINTS, len(mesh.vertices)))
    parts: list[tuple[ndarray, ...]] = []
    for k, view in enumerate(views_by_frame(mesh, scan, poses, chosen, "points for COLMAP")):
        p_world = mesh.vertices[view.vertex]
        uv_camera = world_pixels(scan.frames[k].camera, poses.T_world_camera[k], p_world)[0]
        decoded = world_pixels(scan.projector, poses.T_world_projector[k], p_world)[0] - view.residual
        frame, residual = np.full(len(p_world), k), np.linalg.norm(view.residual, axis=1)
        parts.append((np.searchsorted(chosen, view.vertex), frame, uv_camera, decoded, residual))
    rgb = np.full((len(mesh.vertices), 3), GREY, dtype=np.uint8) if colour is None else colour
    return SurfaceTracks(mesh.vertices[chosen], rgb[chosen], *map(np.concatenate, zip(*parts, strict=True)))


_SINE = (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880)
"""sin t = t (1 + .. t^2 + .. t^4 + .. t^6 + .. t^8): with these, OPENCV_FISHEYE has the direction cosines of a DOE, to
1e-7 of the focal length up to 65 degrees."""

_RIGID = 1e-6  # largest change of a rotation's entries, and of the translation in baselines, within one rig


def require_possible(frames: PosedFrames, root: Path) -> None:
    """Raise UserError for devices that COLMAP has no model of, and for names that its text format cannot hold."""
    if not any(frames.placed):
        raise UserError(
            "--cameras colmap: no frame agrees with the others, so there is no pose to write\n"
            "    remedy: find the poses anew with sl-process, or leave --cameras out"
        )
    projector = frames.projectors[0].device
    if projector.model == "DOE" and any((projector.k1, projector.k2, projector.p1, projector.p2)):
        raise UserError(
            "--cameras colmap: the projector has a diffractive element and lens distortion\n"
            "    cause:  COLMAP has no such model\n"
            "    remedy: leave --cameras out, or make a scan whose projector has no distortion"
        )
    for camera in frames.cameras:
        name = camera.image.relative_to(root).as_posix()
        if any(c.isspace() for c in name):
            raise UserError(
                f"--cameras colmap: {name!r} has a space in it\n"
                "    cause:  COLMAP's text files end a name there\n"
                "    remedy: rename the image and its entry in transforms.json, and train again; or leave --cameras out"
            )


def encode_colmap(frames: PosedFrames, root: Path, tracks: SurfaceTracks) -> dict[str, bytes]:
    """The files by name; images are named by their paths below `root`, frames that are not placed are left out.

    The frames are `require_possible`.
    """
    placed = [k for k, good in enumerate(frames.placed) if good]
    kinds = list(dict.fromkeys(frames.cameras[k].device for k in placed))
    devices = [*kinds, frames.projectors[0].device]
    cameras = [f"{k + 1} {_camera(device)}" for k, device in enumerate(devices)]
    images: list[str] = []
    for k in placed:
        camera, projector = frames.cameras[k], frames.projectors[k]
        capture = camera.image.relative_to(root).as_posix()
        mine = np.flatnonzero(tracks.frame == k)
        for number, device, kind, name, uv in (
            (2 * k + 1, camera, kinds.index(camera.device) + 1, capture, tracks.uv_camera[mine]),
            (2 * k + 2, projector, len(devices), f"projector/{projector.frame}.png", tracks.uv_projector[mine]),
        ):
            seen = zip(uv.tolist(), tracks.point[mine].tolist(), strict=True)
            images.append(f"{number} {_pose(np.linalg.inv(device.T_world_cv))} {kind} {name}")
            images.append(" ".join(f"{x:.4f} {y:.4f} {point + 1}" for (x, y), point in seen))
    rigs, shots = _rigs(frames, placed, kinds)
    files = {
        "rigs": ("RIG_ID NUM_SENSORS REF_TYPE REF_ID, then (TYPE ID HAS_POSE QW QX QY QZ TX TY TZ)[]", rigs),
        "frames": ("FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA, then (TYPE SENSOR_ID IMAGE_ID)[]", shots),
        "cameras": ("CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]; the last one is the projector", cameras),
        "images": (
            "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then (X Y POINT3D_ID)[]; world to device, +y down", images,
        ),
        "points3D": ("POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID POINT2D_IDX)", _tracks(tracks, placed)),
    }  # fmt: skip
    return {f"{name}.txt": "\n".join([f"# {head}", *lines, ""]).encode() for name, (head, lines) in files.items()}


def _rigs(frames: PosedFrames, placed: Sequence[int], kinds: Sequence[Device]) -> tuple[list[str], list[str]]:
    """Lines of rigs.txt and frames.txt: one rig if all frames have the same relative pose, else each device alone."""
    relative = [np.linalg.inv(frames.projectors[k].T_world_cv) @ frames.cameras[k].T_world_cv for k in placed]
    baseline = float(np.linalg.norm(relative[0][:3, 3]))
    scaled = np.array(relative) / np.array([1.0, 1.0, 1.0, baseline])
    projector = len(kinds) + 1
    if len(kinds) > 1 or np.ptp(scaled, axis=0).max() > _RIGID:
        rigs = [f"{k + 1} 1 CAMERA {k + 1}" for k in range(projector)]
        shots = []
        for k in placed:
            for number, device in (
                (kinds.index(frames.cameras[k].device) + 1, frames.cameras[k]),
                (projector, frames.projectors[k]),
            ):
                image = 2 * k + (2 if number == projector else 1)
                pose = _pose(np.linalg.inv(device.T_world_cv))
                shots.append(f"{image} {number} {pose} 1 CAMERA {number} {image}")
        return rigs, shots
    shots = [
        f"{k + 1} 1 {_pose(np.linalg.inv(frames.cameras[k].T_world_cv))} 2 CAMERA 1 {2 * k + 1} CAMERA 2 {2 * k + 2}"
        for k in placed
    ]
    return [f"1 2 CAMERA 1 CAMERA 2 1 {_pose(relative[0])}"], shots


def _pose(T: Float64[ndarray, "4 4"]) -> str:
    """A rigid motion as COLMAP writes it: QW QX QY QZ TX TY TZ."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return " ".join(f"{v:.15g}" for v in (w, x, y, z, *T[:3, 3].tolist()))


def _camera(device: Device) -> str:
    size, focal = f"{device.w} {device.h}", f"{device.fl_x!r} {device.fl_y!r} {device.cx!r} {device.cy!r}"
    distortion = (device.k1, device.k2, device.p1, device.p2)
    if device.model == "OPENCV":
        return f"OPENCV {size} {focal} {' '.join(map(repr, distortion))}"
    return f"OPENCV_FISHEYE {size} {focal} {' '.join(map(repr, _SINE))}"


def _tracks(tracks: SurfaceTracks, placed: Sequence[int]) -> list[str]:
    """One line for each point that an image sees; the error is the mean over its images, and a camera's is 0."""
    seen_by: list[list[str]] = [[] for _ in tracks.p_world]
    error, place = np.zeros(len(tracks.p_world)), np.zeros(len(tracks.frame), dtype=np.int64)
    for k in placed:
        mine = tracks.frame == k
        place[mine] = np.arange(mine.sum())
    good = np.isin(tracks.frame, placed)
    np.add.at(error, tracks.point[good], tracks.residual_px[good])
    for point, frame, at in zip(
        tracks.point[good].tolist(), tracks.frame[good].tolist(), place[good].tolist(), strict=True
    ):
        seen_by[point] += [f"{2 * frame + 1} {at} {2 * frame + 2} {at}"]
    rows = zip(tracks.p_world.tolist(), tracks.rgb.tolist(), error.tolist(), seen_by, strict=True)
    return [
        f"{k + 1} {' '.join(f'{v:.12g}' for v in p)} {' '.join(map(str, rgb))} {e / 2 / len(seen):.4f} {' '.join(seen)}"
        for k, (p, rgb, e, seen) in enumerate(rows)
        if seen
    ]
