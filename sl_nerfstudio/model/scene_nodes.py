"""What viewers draw of a scan, and the view that they begin with. It needs no nerfstudio."""

import math
from collections.abc import Sequence

import numpy as np
import torch
import viser
import viser.transforms as vtf
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, Intrinsics, unproject
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.geometry.triangulation import Viewpoint, beside, far_enough, triangulate_pixels

SCENE_SCALE = 10.0
"""By which viewers enlarge the scene, as nerfstudio does (`VISER_NERFSTUDIO_SCALE_RATIO`)."""

# Lines as thin rods: one mesh for any number of them, where the viewer has no line segments.

_SIDES = 3


def rods(segments: Float[ndarray, "n 2 3"], radius: float) -> tuple[Float[ndarray, "v 3"], Int64[ndarray, "f 3"]]:
    """Vertices and triangles of open prisms around the segments; those without a length are left out."""
    axis = segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(axis, axis=1)
    kept = np.isfinite(length) & (length > 0)
    segments, axis = segments[kept], axis[kept] / length[kept, None]
    least = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    u = np.cross(axis, least)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = radius * (np.cos(angle)[None, :, None] * u[:, None] + np.sin(angle)[None, :, None] * v[:, None])
    vertices = (segments[:, :, None] + ring[:, None]).reshape(-1, 3)
    k, after = np.arange(_SIDES), (np.arange(_SIDES) + 1) % _SIDES
    one = np.concatenate([np.stack([k, after, after + _SIDES], 1), np.stack([k, after + _SIDES, k + _SIDES], 1)])
    faces = one[None] + 2 * _SIDES * np.arange(len(segments))[:, None, None]
    return vertices, faces.reshape(-1, 3).astype(np.int64)


# Cameras and projectors in the viewer's scene: pyramids at starting and current poses, the way between, and names.

Colour = tuple[int, int, int]
GREY: Colour = (130, 130, 130)
UNPLACED_COLOUR: Colour = (230, 60, 50)
CLAY: Colour = (112, 109, 103)  # of surfaces: dark, because viewers have strong lights
_STARTING_SIZE = 0.8  # of the current ones
_ROD = 0.02  # radius of the line from start to current pose, as a share of a pyramid's size

COLOURS: dict[str, Colour] = {"camera": (90, 160, 255), "projector": (255, 140, 40)}


class DeviceNodes:
    """Nodes of the cameras, or of the projectors, one of each frame; poses are in the scene."""

    def __init__(
        self,
        scene: viser.SceneApi,
        kind: str,
        names: Sequence[str],
        devices: Sequence[Device],
        start: Float64[ndarray, "n 4 4"],
        current: Float64[ndarray, "n 4 4"],
        scale: float,
        image: UInt8[ndarray, "h w 3"] | None = None,
    ) -> None:
        """`names` are the frames'; `scale` is viser's size of a pyramid; `image` is drawn on the current ones."""
        self._scene, self._kind, self._names, self._scale, self._image = scene, kind, names, scale, image
        self._shapes = [(vertical_fov(device), device.w / device.h) for device in devices]
        self.start, self.current = start, current
        self.unplaced = [False] * len(names)
        self.starting = [
            scene.add_camera_frustum(f"/starting/{kind}/{name}", *shape, _STARTING_SIZE * scale, color=GREY)
            for name, shape in zip(names, self._shapes, strict=True)
        ]
        for handle, T in zip(self.starting, start, strict=True):
            place(handle, T)
        drawn = [self._current_nodes(k) for k in range(len(names))]
        self.refined, self.labels = [nodes[0] for nodes in drawn], [nodes[1] for nodes in drawn]
        self.path = self._drawn_path()
        self.move(current)

    def _current_nodes(self, k: int) -> tuple[viser.CameraFrustumHandle, viser.LabelHandle]:
        """The pyramid and the name of a frame's device at its current pose; they replace those that are there."""
        kind, lost, path = self._kind, self.unplaced[k], f"{self._kind}/{self._names[k]}"
        colour = UNPLACED_COLOUR if lost else COLOURS[kind]
        pyramid = self._scene.add_camera_frustum(
            f"/refined/{path}", *self._shapes[k], self._scale, color=colour, image=self._image
        )
        return pyramid, self._scene.add_label(f"/names/{path}", f"{kind} {k}: not placed" if lost else f"{kind} {k}")

    def mark(self, unplaced: Sequence[bool]) -> None:
        """Show in red, and say, which frames do not agree with the others."""
        changed = [k for k, lost in enumerate(unplaced) if lost != self.unplaced[k]]
        self.unplaced = list(unplaced)
        for k in changed:
            shown = self.refined[k].visible, self.labels[k].visible
            self.refined[k], self.labels[k] = self._current_nodes(k)
            self.refined[k].visible, self.labels[k].visible = shown
        if changed:
            self.move(self.current)

    def move(self, current: Float64[ndarray, "n 4 4"]) -> None:
        """To other current poses; the lines from the starting poses follow."""
        for handle, label, T in zip(self.refined, self.labels, current, strict=True):
            place(handle, T)
            label.position = T[:3, 3] * SCENE_SCALE
        if not np.array_equal(current, self.current):
            shown = self.path.visible
            self.current = current
            self.path = self._drawn_path()
            self.path.visible = shown

    def show(self, *, refined: bool, starting: bool, named: Sequence[int]) -> None:
        """Choose what is visible; `named` are the frames with a name. Lines are where both of their ends are."""
        for handles, visible in ((self.refined, refined), (self.starting, starting)):
            for handle in handles:
                handle.visible = visible
        for k, label in enumerate(self.labels):
            label.visible = refined and k in named
        self.path.visible = refined and starting

    def _drawn_path(self) -> viser.MeshHandle:
        ends = np.stack([self.start[:, :3, 3], self.current[:, :3, 3]], 1) * SCENE_SCALE
        return add_rods(self._scene, f"/moved/{self._kind}", ends, _ROD * self._scale, COLOURS[self._kind])


def add_rods(
    scene: viser.SceneApi, name: str, segments: Float[ndarray, "n 2 3"], radius: float, colour: Colour
) -> viser.MeshHandle:
    """A mesh of rods; the viewer accepts no empty one, so it has an invisible triangle then."""
    vertices, faces = rods(segments, radius)
    if not len(faces):
        vertices, faces = np.zeros((3, 3)), np.array([[0, 1, 2]])
    return scene.add_mesh_simple(name, vertices, faces, color=colour, side="double")


def vertical_fov(device: Device) -> float:
    """Angle in radian between the rays through the middle of the upper and of the lower edge."""
    uv = torch.tensor([[device.w / 2, 0.0], [device.w / 2, float(device.h)]], dtype=torch.float64)
    up, down = unproject(Intrinsics.of(device, torch.float64), uv)
    return math.acos(max(-1.0, min(1.0, float(up @ down))))


def place(handle: viser.CameraFrustumHandle, T_scene_device: Float64[ndarray, "4 4"]) -> None:
    """Viser's frusta look along +z with y down; nerfstudio draws the scene ten times as large."""
    R = vtf.SO3.from_matrix(T_scene_device[:3, :3]) @ vtf.SO3.from_x_radians(math.pi)
    handle.wxyz = R.wxyz
    handle.position = T_scene_device[:3, 3] * SCENE_SCALE


_PYRAMID = 0.04  # of the devices' distance from the object


def pyramid_size(T_scene_camera: Float64[ndarray, "n 4 4"]) -> float:
    """Viser's size of a device's pyramid in a scene with these cameras."""
    return _PYRAMID * SCENE_SCALE * float(np.median(np.linalg.norm(T_scene_camera[:, :3, 3], axis=1)))


# Points that a frame decoded.


def decoded_points(
    camera: Device,
    projector: Device,
    coords: Float32[ndarray, "h w 2"],
    T_world_camera: Float64[ndarray, "4 4"],
    T_world_projector: Float64[ndarray, "4 4"],
    most: int,
) -> Float64[ndarray, "n 3"]:
    """Where the rays of some decoded pixels meet, in world axes: at most `most`, evenly over the image.

    Pixels whose rays meet behind a device are left out.
    """
    row, column = _evenly(all_finite(coords), most)
    found = triangulate_pixels(camera, projector, T_world_camera, T_world_projector, coords, row, column)
    return found.p_world[(found.depth_camera > 0) & (found.depth_projector > 0)].numpy()


def _evenly(decoded: Bool[ndarray, "h w"], most: int) -> tuple[Int64[ndarray, "n"], Int64[ndarray, "n"]]:
    """Rows and columns of some decoded pixels, on a square lattice that has at most `most` of them."""
    step = max(1, int((decoded.sum() / most) ** 0.5))
    while True:
        row, column = np.nonzero(decoded[step // 2 :: step, step // 2 :: step])
        if len(row) <= most:
            return row * step + step // 2, column * step + step // 2
        step += 1


# The first view.

_OBJECT_RADIUS = 0.8  # scene units
_USUAL_FOV, _USUAL_ASPECT = math.radians(75), 1.5  # of a client that has not said its own
_MARGIN = 1.1


def look_at_object(
    client: viser.ClientHandle, T_scene_device: Float64[ndarray, "n 4 4"], surface: Float64[ndarray, "v 3"] | None
) -> None:
    """Move a browser's camera to the first view."""
    view = first_view(T_scene_device, surface, client.camera.fov or _USUAL_FOV, client.camera.aspect or _USUAL_ASPECT)
    client.camera.up_direction = view.up
    client.camera.position = view.eye * SCENE_SCALE
    client.camera.look_at = view.centre * SCENE_SCALE


def first_view(
    T_scene_device: Float64[ndarray, "n 4 4"],
    surface: Float64[ndarray, "v 3"] | None,
    vertical_fov: float,
    aspect: float,
) -> Viewpoint:
    """Framed on the surface, or on where it will be, beside the first device."""
    if surface is None:
        surface = _OBJECT_RADIUS * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    up, position = np.array([0.0, 0.0, 1.0]), T_scene_device[0, :3, 3]
    direction = beside(position if np.linalg.norm(position) > 0 else T_scene_device[0, :3, 2], up)
    return far_enough(surface, (surface.min(0) + surface.max(0)) / 2, direction, up, vertical_fov, aspect, _MARGIN)
