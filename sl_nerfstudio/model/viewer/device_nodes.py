"""Cameras and projectors in the viewer's scene: pyramids at starting and current poses, the way between, and names."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import viser
import viser.transforms as vtf
from jaxtyping import Float, Float64, UInt8
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, Intrinsics, unproject
from sl_nerfstudio.model.viewer.rods import rods

Colour = tuple[int, int, int]
GREY: Colour = (130, 130, 130)
UNPLACED_COLOUR: Colour = (230, 60, 50)
_STARTING_SIZE = 0.8  # of the current ones
_ROD = 0.02  # radius of the line from start to current pose, as a share of a pyramid's size


@dataclass(frozen=True)
class DeviceKind:
    """What cameras, or projectors, have in common in the scene."""

    name: str
    colour: Colour


CAMERA, PROJECTOR = DeviceKind("camera", (90, 160, 255)), DeviceKind("projector", (255, 140, 40))


class DeviceNodes:
    """The nodes of all devices of one kind, one of each frame; poses are in the scene."""

    def __init__(
        self,
        scene: viser.SceneApi,
        kind: DeviceKind,
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
            scene.add_camera_frustum(f"/starting/{kind.name}/{name}", *shape, _STARTING_SIZE * scale, color=GREY)
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
        kind, lost, path = self._kind.name, self.unplaced[k], f"{self._kind.name}/{self._names[k]}"
        colour = UNPLACED_COLOUR if lost else self._kind.colour
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
            label.position = T[:3, 3] * VISER_NERFSTUDIO_SCALE_RATIO
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
        ends = np.stack([self.start[:, :3, 3], self.current[:, :3, 3]], 1) * VISER_NERFSTUDIO_SCALE_RATIO
        vertices, faces = rods(ends, _ROD * self._scale)
        return add_rods(self._scene, f"/moved/{self._kind.name}", vertices, faces, self._kind.colour)


def add_rods(
    scene: viser.SceneApi, name: str, vertices: Float[ndarray, "v 3"], faces: ndarray, colour: Colour
) -> viser.MeshHandle:
    """A mesh of rods; the viewer accepts no empty one, so it has an invisible triangle then."""
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
    handle.position = T_scene_device[:3, 3] * VISER_NERFSTUDIO_SCALE_RATIO
