"""The scan in nerfstudio's viewer, in `ns-viewer` and during training."""

import contextlib
import math
import time
from contextlib import AbstractContextManager

import numpy as np
import viser
from jaxtyping import Float, Float64, UInt8
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer.viewer_elements import ViewerControl
from numpy import ndarray

from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.geometry.viewpoint import Viewpoint, beside, far_enough
from sl_nerfstudio.model.viewer.device_nodes import CAMERA, PROJECTOR, DeviceNodes, add_rods, place
from sl_nerfstudio.model.viewer.panel import Panel
from sl_nerfstudio.model.viewer.pattern_rays import pattern_rays
from sl_nerfstudio.model.viewer.rods import rods
from sl_nerfstudio.model.viewer.surface import RENDERED, Coloured, Surface
from sl_nerfstudio.model.viewer.viewed_model import ViewedModel

_PATTERN_PIXELS = 256  # longest side of the pattern drawn on a projector
_SECONDS_BETWEEN_UPDATES = 0.5
_FRUSTUM_SIZE = 0.4  # of the devices' distance from the object, times nerfstudio's --viewer.camera-frustum-scale of 0.1
_RAY = 0.012  # radius of a ray, as a share of a pyramid's size
_OBJECT_RADIUS = 0.8  # scene units
_USUAL_FOV, _USUAL_ASPECT = math.radians(75), 1.5  # of a client that has not said its own
_MARGIN = 1.1  # pyramids reach a little beyond their centres, and names beyond them

ScenePoses = tuple[Float64[ndarray, "n 4 4"], Float64[ndarray, "n 4 4"]]


class SceneView(ViewerControl):
    """Draws the scan once a viewer exists, and moves what depends on poses while these are refined.

    nerfstudio finds the object as an attribute of the pipeline and calls `_setup`, in training and in `ns-viewer`.
    """

    def __init__(self, model: ViewedModel) -> None:
        self._model = model
        self._devices: tuple[DeviceNodes, DeviceNodes] | None = None
        self._surface: Surface | None = None
        self._nodes: dict[str, viser.SceneNodeHandle] = {}  # of the surface and of the rays
        self._last_update = 0.0

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        if viewer.config.websocket_host == "0.0.0.0":  # the default of ns-viewer, which a plugin cannot change
            print("The viewer listens on all networks; --viewer.websocket-host 127.0.0.1 restricts it to this machine.")
        viewer.control_panel._layer_depth.value = False  # with it, the picture hides the devices behind the object
        scan = self._model.scan
        start = self._model.S_scene_world.poses(scan.poses.stacked())
        cameras, projectors = start[: len(scan.frames)], start[len(scan.frames) :]
        # nerfstudio assumes that cameras are inside the unit box; here the object is, and they are far outside.
        # It draws its own frusta after this, with the same setting.
        distance = float(np.median(np.linalg.norm(cameras[:, :3, 3], axis=1)))
        viewer.config.camera_frustum_scale *= _FRUSTUM_SIZE * distance * VISER_NERFSTUDIO_SCALE_RATIO
        self._scale = viewer.config.camera_frustum_scale
        names, current = [frame.name for frame in scan.frames], self._numpy_poses()
        scene, pattern = self.viser_server.scene, _thumbnail(scan.read_pattern())
        devices = [frame.camera for frame in scan.frames], [scan.projector] * len(names)
        self._devices = (
            DeviceNodes(scene, CAMERA, names, devices[0], cameras, current[0], self._scale),
            DeviceNodes(scene, PROJECTOR, names, devices[1], projectors, current[1], self._scale, pattern),
        )
        self._mark_unplaced()
        self.panel = Panel(self.viser_server, names, viewer.trainer is not None, self._changed)
        self.show_devices()
        self.viser_server.on_client_connect(self._look_at_object)

    # ---- the user's choices

    def _changed(self, what: str) -> None:
        """Called by viser's threads."""
        if what in ("frame", "projectors", "starting", "names"):
            self.show_devices()
        with self._lock():
            if what == "frame":
                self.panel.show_frame()
                self._model.viewed_frame = self.panel.chosen_frame
                self.viewer._trigger_rerender()
            if what in ("frame", "rays"):
                self.show_rays()
            if what == "update":
                self._surface = None
            if what in ("surface", "update") or (what == "frame" and self.panel.surface.value != RENDERED):
                self.show_surface()

    def _lock(self) -> AbstractContextManager[object]:
        """Training waits while something is computed from its field or poses."""
        return self.viewer.train_lock or contextlib.nullcontext()

    def show_devices(self) -> None:
        """Show and hide pyramids, lines and names as the panel says."""
        if self._devices is None:
            return
        cameras, projectors = self._devices
        panel = self.panel
        starting, projected = panel.starting.value, panel.projectors.value
        named = range(len(self._model.scan.frames)) if panel.names.value else [panel.chosen_frame]
        with self.viser_server.atomic():
            cameras.show(refined=True, starting=starting, named=named)
            projectors.show(refined=projected, starting=starting and projected, named=named)

    def show_rays(self) -> None:
        """Draw the rays of the chosen frame, or remove them."""
        for name in ("/rays/camera", "/rays/projector"):
            self._remove(name)
        if not self.panel.rays.value:
            return
        frame, (camera, projector) = self.panel.chosen_frame, self._model.poses_scene()
        segments = pattern_rays(self._model.scan, frame, camera[frame], projector[frame])
        for kind, ends in zip((CAMERA, PROJECTOR), segments, strict=True):
            drawn = rods(ends * VISER_NERFSTUDIO_SCALE_RATIO, _RAY * self._scale)
            name = f"/rays/{kind.name}"
            self._nodes[name] = add_rods(self.viser_server.scene, name, *drawn, kind.colour)

    def show_surface(self) -> None:
        """Draw the surface as a mesh in the chosen colours, or leave it to the rendered picture."""
        mode = self.panel.surface.value
        if mode == RENDERED:
            self._remove("/surface")
            self.panel.show_legend(None)
            return
        try:
            if self._surface is None or self._surface.step != self._model.step:
                self.panel.say("Extracting the surface …")
                self._surface = Surface(self._model)
            coloured = self._surface.coloured(mode, self.panel.chosen_frame)
        except UserError as error:
            self._remove("/surface")
            self.panel.say(first_line(error))
            return
        self._draw_surface(self._surface, coloured)
        self.panel.show_legend(coloured)

    def _draw_surface(self, surface: Surface, coloured: Coloured) -> None:
        import trimesh  # takes half a second, and only a viewer needs it

        mesh = trimesh.Trimesh(
            surface.mesh.vertices * VISER_NERFSTUDIO_SCALE_RATIO,
            surface.mesh.faces,
            vertex_colors=coloured.rgb,
            vertex_normals=surface.mesh.vertex_normals(),
            process=False,
        )
        self._nodes["/surface"] = self.viser_server.scene.add_mesh_trimesh("/surface", mesh)

    def _remove(self, name: str) -> None:
        node = self._nodes.pop(name, None)
        if node is not None:
            node.remove()

    # ---- poses

    def update(self, force: bool = False) -> None:
        """Move everything to the current poses; at most twice a second, and only if a client is connected."""
        if self._devices is None or not (force or self._is_due()):
            return
        self._last_update = time.monotonic()
        poses = self._numpy_poses()
        moved = not all(np.array_equal(T, d.current) for T, d in zip(poses, self._devices, strict=True))
        if not (self._mark_unplaced() or moved or force):
            return
        # nerfstudio's own frusta show the captured images; it would leave them at the starting poses
        stock = getattr(self.viewer, "camera_handles", {})
        with self.viser_server.atomic():
            for devices, T in zip(self._devices, poses, strict=True):
                devices.move(T)
            for k, handle in stock.items():
                place(handle, poses[0][k])
        if self.panel.rays.value:
            self.show_rays()

    def _mark_unplaced(self) -> bool:
        """Whether any frame is newly known not to agree with the others, or to do so."""
        assert self._devices is not None
        unplaced = self._model.unplaced()
        changed = unplaced != self._devices[0].unplaced
        for devices in self._devices:
            devices.mark(unplaced)
        return changed

    def _is_due(self) -> bool:
        return time.monotonic() - self._last_update > _SECONDS_BETWEEN_UPDATES and bool(self.viser_server.get_clients())

    def _numpy_poses(self) -> ScenePoses:
        camera, projector = self._model.poses_scene()
        return camera.detach().cpu().double().numpy(), projector.detach().cpu().double().numpy()

    # ---- the first view

    def _look_at_object(self, client: viser.ClientHandle) -> None:
        fov, aspect = client.camera.fov or _USUAL_FOV, client.camera.aspect or _USUAL_ASPECT
        view = first_view(np.concatenate(self._numpy_poses()), fov, aspect)
        client.camera.up_direction = view.up
        client.camera.position = view.eye * VISER_NERFSTUDIO_SCALE_RATIO
        client.camera.look_at = view.centre * VISER_NERFSTUDIO_SCALE_RATIO


def first_view(T_scene_device: Float64[ndarray, "n 4 4"], vertical_fov: float, aspect: float) -> Viewpoint:
    """Framed on the object, beside the first device, and so far away that all devices are in the picture."""
    corners = _OBJECT_RADIUS * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    up, position = np.array([0.0, 0.0, 1.0]), T_scene_device[0, :3, 3]
    direction = beside(position if np.linalg.norm(position) > 0 else T_scene_device[0, :3, 2], up)
    points = np.concatenate([T_scene_device[:, :3, 3], corners])
    return far_enough(points, np.zeros(3), direction, up, vertical_fov, aspect, _MARGIN)


def _thumbnail(pattern: Float[ndarray, "h w"]) -> UInt8[ndarray, "h2 w2 3"]:
    step = max(1, math.ceil(max(pattern.shape) / _PATTERN_PIXELS))
    grey = (pattern[::step, ::step] * 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
