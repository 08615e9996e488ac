"""Cameras and projectors in nerfstudio's viewer: their starting poses (grey) and their current poses (coloured)."""

import math
import time
from collections.abc import Callable

import numpy as np
import torch
import viser
import viser.transforms as vtf
from jaxtyping import Float, UInt8
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer.viewer_elements import ViewerCheckbox, ViewerControl
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.geometry.devices import Device, Intrinsics, unproject
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.scan import Scan

GREY = (130, 130, 130)
CAMERA_COLOUR = (90, 160, 255)
PROJECTOR_COLOUR = (255, 140, 40)
_PATTERN_PIXELS = 256  # longest side of the pattern drawn on a projector
_SECONDS_BETWEEN_UPDATES = 0.5
_FRUSTUM_SIZE = 0.6  # of the devices' distance from the object, times nerfstudio's --viewer.camera-frustum-scale of 0.1
_VIEWING_DISTANCE = 3.0  # scene units; the object's radius is 0.8
_VIEWING_ANGLES = (0.35, 0.3)  # radian beside and above the first camera

ScenePoses = tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n 4 4"]]


class SceneView(ViewerControl):
    """Draws the frusta once a viewer exists, and moves the coloured ones while poses are refined.

    nerfstudio finds the object as an attribute of the pipeline and calls `_setup`, in training and in `ns-viewer`.
    """

    def __init__(self, scan: Scan, S_scene_world: Similarity, current_poses: Callable[[], ScenePoses]) -> None:
        """`current_poses` returns the poses of cameras and projectors in the scene."""
        self._scan = scan
        self._initial = tuple(S_scene_world.poses(T) for T in (scan.poses.T_world_camera, scan.poses.T_world_projector))
        self._current_poses = current_poses
        self._refined: tuple[list[viser.CameraFrustumHandle], list[viser.CameraFrustumHandle]] = ([], [])
        self._starting: tuple[list[viser.CameraFrustumHandle], list[viser.CameraFrustumHandle]] = ([], [])
        self._last_update = 0.0
        self.show_projectors = ViewerCheckbox("Projectors", True, cb_hook=lambda _: self._set_visibility())
        self.show_starting = ViewerCheckbox("Starting poses", True, cb_hook=lambda _: self._set_visibility())

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        if viewer.config.websocket_host == "0.0.0.0":  # the default of ns-viewer, which a plugin cannot change
            print("The viewer listens on all networks; --viewer.websocket-host 127.0.0.1 restricts it to this machine.")
        # nerfstudio assumes that cameras are inside the unit box; here the object is, and they are far outside.
        # It draws its own frusta after this, with the same setting.
        distance = float(np.median(np.linalg.norm(self._initial[0][:, :3, 3], axis=1)))
        viewer.config.camera_frustum_scale *= _FRUSTUM_SIZE * distance * VISER_NERFSTUDIO_SCALE_RATIO
        scale = viewer.config.camera_frustum_scale
        cameras = [frame.camera for frame in self._scan.frames]
        projectors = [self._scan.projector] * len(cameras)
        pattern = _thumbnail(self._scan.read_pattern())
        camera_poses, projector_poses = self._numpy_poses()
        self._starting = (
            self._frusta("starting/camera", cameras, self._initial[0], GREY, scale * 0.8),
            self._frusta("starting/projector", projectors, self._initial[1], GREY, scale * 0.8),
        )
        self._refined = (
            self._frusta("refined/camera", cameras, camera_poses, CAMERA_COLOUR, scale),
            self._frusta("refined/projector", projectors, projector_poses, PROJECTOR_COLOUR, scale, pattern),
        )

        self.viser_server.on_client_connect(self._look_at_object)

    def _look_at_object(self, client: viser.ClientHandle) -> None:
        client.camera.up_direction = (0.0, 0.0, 1.0)
        client.camera.position = first_viewpoint(self._initial[0][0]) * VISER_NERFSTUDIO_SCALE_RATIO
        client.camera.look_at = (0.0, 0.0, 0.0)

    def update(self, force: bool = False) -> None:
        """Move the coloured frusta to the current poses; at most twice a second, and only if a client is connected."""
        if not self._refined[0] or not (force or self._is_due()):
            return
        self._last_update = time.monotonic()
        # nerfstudio's own frusta show the captured images; it would leave them at the starting poses
        stock = getattr(self.viewer, "camera_handles", {})
        camera_poses, projector_poses = self._numpy_poses()
        with self.viser_server.atomic():
            for i in range(len(camera_poses)):
                _place(self._refined[0][i], camera_poses[i])
                _place(self._refined[1][i], projector_poses[i])
                if i in stock:
                    _place(stock[i], camera_poses[i])

    def _is_due(self) -> bool:
        return time.monotonic() - self._last_update > _SECONDS_BETWEEN_UPDATES and bool(self.viser_server.get_clients())

    def _set_visibility(self) -> None:
        projectors, starting = self.show_projectors.value, self.show_starting.value
        with self.viser_server.atomic():
            for handle in self._refined[1]:
                handle.visible = projectors
            for handle in self._starting[0]:
                handle.visible = starting
            for handle in self._starting[1]:
                handle.visible = starting and projectors

    def _numpy_poses(self) -> tuple[Float[ndarray, "n 4 4"], Float[ndarray, "n 4 4"]]:
        camera, projector = self._current_poses()
        return camera.detach().cpu().double().numpy(), projector.detach().cpu().double().numpy()

    def _frusta(
        self,
        name: str,
        devices: list[Device],
        poses: Float[ndarray, "n 4 4"],
        colour: tuple[int, int, int],
        scale: float,
        image: UInt8[ndarray, "h w 3"] | None = None,
    ) -> list[viser.CameraFrustumHandle]:
        handles = []
        for frame, device, T in zip(self._scan.frames, devices, poses, strict=True):
            handle = self.viser_server.scene.add_camera_frustum(
                f"/{name}/{frame.name}", vertical_fov(device), device.w / device.h, scale, color=colour, image=image
            )
            _place(handle, T)
            handles.append(handle)
        return handles


def first_viewpoint(T_scene_camera: Float[ndarray, "4 4"]) -> Float[ndarray, "3"]:
    """A viewpoint near the object, a little beside and above the line to the first camera."""
    towards = T_scene_camera[:3, 3] / np.linalg.norm(T_scene_camera[:3, 3])
    azimuth = math.atan2(towards[1], towards[0]) + _VIEWING_ANGLES[0]
    elevation = min(math.asin(towards[2]) + _VIEWING_ANGLES[1], 1.2)
    direction = [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    return _VIEWING_DISTANCE * np.array(direction)


def vertical_fov(device: Device) -> float:
    """Angle in radian between the rays through the middle of the upper and of the lower edge."""
    uv = torch.tensor([[device.w / 2, 0.0], [device.w / 2, float(device.h)]], dtype=torch.float64)
    up, down = unproject(Intrinsics.of(device, torch.float64), uv)
    return math.acos(max(-1.0, min(1.0, float(up @ down))))


def _place(handle: viser.CameraFrustumHandle, T_scene_device: Float[ndarray, "4 4"]) -> None:
    """Viser's frusta look along +z with y down; nerfstudio draws the scene ten times as large."""
    R = vtf.SO3.from_matrix(T_scene_device[:3, :3]) @ vtf.SO3.from_x_radians(math.pi)
    handle.wxyz = R.wxyz
    handle.position = T_scene_device[:3, 3] * VISER_NERFSTUDIO_SCALE_RATIO


def _thumbnail(pattern: Float[ndarray, "h w"]) -> UInt8[ndarray, "h2 w2 3"]:
    step = max(1, math.ceil(max(pattern.shape) / _PATTERN_PIXELS))
    grey = (pattern[::step, ::step] * 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
