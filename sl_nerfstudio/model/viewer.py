"""The scan in nerfstudio's viewer, in `ns-viewer` and during training."""

import base64
import contextlib
import io
import math
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import matplotlib
import numpy as np
import torch
import viser
from jaxtyping import Bool, Float, Float64, UInt8
from nerfstudio.viewer.viewer import Viewer
from nerfstudio.viewer.viewer_elements import ViewerControl
from numpy import ndarray
from PIL import Image
from torch import Tensor

from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.geometry.devices import Intrinsics, project
from sl_nerfstudio.geometry.lie import inverse, transform
from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.meshing.mesh import Mesh, VertexQuality
from sl_nerfstudio.meshing.uncertainty import vertex_uncertainty
from sl_nerfstudio.model.outputs import TrainedModel, coordinate_colours
from sl_nerfstudio.model.scene_nodes import (
    CLAY,
    COLOURS,
    SCENE_SCALE,
    DeviceNodes,
    add_rods,
    decoded_points,
    look_at_object,
    place,
    pyramid_size,
)
from sl_nerfstudio.scan import Scan

# Rays of a frame's camera and projector through pixels that decoded the same point of the surface.

MOST_RAYS = 60
_FARTHEST = 3.0  # from the object's centre, scene units, whose radius is 0.8: rays that meet beyond are decoding errors


def pattern_rays(
    scan: Scan, frame: int, T_scene_camera: Float[Tensor, "4 4"], T_scene_projector: Float[Tensor, "4 4"]
) -> tuple[Float64[ndarray, "n 2 3"], Float64[ndarray, "n 2 3"]]:
    """Segments from the camera, and from the projector, to where the two rays meet; in the scene.

    At most `MOST_RAYS` of the decoded pixels, evenly over the image; none where nothing was decoded.
    """
    camera, projector = (T.double().cpu().numpy() for T in (T_scene_camera, T_scene_projector))
    seen = scan.frames[frame]
    ends = decoded_points(seen.camera, scan.projector, seen.read_coords(), camera, projector, MOST_RAYS)
    ends = ends[np.linalg.norm(ends, axis=1) < _FARTHEST]
    starts = (np.broadcast_to(T[:3, 3], ends.shape) for T in (camera, projector))
    first, second = (np.stack([start, ends], 1) for start in starts)
    return first, second


# The surface of the field as a mesh for the viewer, and what it can be coloured by.

RENDERED, SHADED = "as rendered", "shaded"
MODES = (RENDERED, SHADED, "normals", "depth", "coordinates", "residual", "sigma", "views")
RESOLUTION = 192  # cells along the scene's box: seconds
UNKNOWN = (110, 110, 110)  # colour where a value does not exist


@dataclass(frozen=True)
class Coloured:
    """Colours of the vertices, and what they mean."""

    rgb: UInt8[ndarray, "v 3"]
    meaning: str
    scale: tuple[str, float, float, str] | None = None  # matplotlib's colour map, values at its ends, their unit


class ViewerSurface:
    """The zero level of a model's field at one step; lengths in the scene, values in the scan's unit."""

    def __init__(self, model: TrainedModel, resolution: int = RESOLUTION) -> None:
        """Raises UserError if there is no surface."""
        self._model = model
        self.step = model.step
        self.mesh: Mesh = extract_mesh(model.sdf, resolution, device=model.device)

    @cached_property
    def quality(self) -> VertexQuality:
        """What is known of each vertex, in the scan's unit: it needs the coordinates of all frames, so some seconds."""
        model = self._model
        world = self.mesh.mapped(model.S_scene_world.inverse())
        return vertex_uncertainty(world, model.scan, model.poses(), model.joint_covariance(), model.cell)

    def coloured(self, mode: str, frame: int) -> Coloured:
        """The colours of one of `MODES`; `frame` is the one whose devices depth and coordinates are of."""
        units = self._model.scan.units
        if mode == SHADED:
            rgb = np.tile(np.array(CLAY, np.uint8), (len(self.mesh.vertices), 1))
            return Coloured(rgb, f"The surface at step {self.step}.")
        if mode == "normals":
            rgb = 0.5 * self.mesh.vertex_normals() + 0.5
            return Coloured(_bytes(rgb), "Direction of the surface: red is x, green y, blue z.")
        if mode == "depth":
            return self._depth(frame, units)
        if mode == "coordinates":
            return self._coordinates(frame)
        of = f"Grey: no frame confirms the surface there. Step {self.step}."
        if mode == "residual":
            said = f"Mean distance of predicted and decoded coordinates. {of}"
            return _scaled(self.quality.residual, "inferno", "pattern px", said)
        if mode == "sigma":
            return _scaled(self.quality.sigma, "inferno", units, f"Uncertainty along the normal, 1 sigma. {of}")
        views = self.quality.views.astype(np.float64)
        said = f"Frames that saw, lit and confirmed it. {of}"
        return _scaled(np.where(views > 0, views, np.nan), "viridis", "frames", said, percentile=100.0)

    def _depth(self, frame: int, units: str) -> Coloured:
        T_scene_camera = self._model.poses_scene()[0][frame].double().cpu().numpy()
        distance = np.linalg.norm(self.mesh.vertices - T_scene_camera[:3, 3], axis=1)
        world = distance / self._model.S_scene_world.scale
        scale = ("turbo", float(world.min()), float(world.max()), units)
        return Coloured(_mapped(world, scale), f"Distance from the camera of frame {frame}.", scale)

    def _coordinates(self, frame: int) -> Coloured:
        T_projector_scene = inverse(self._model.poses_scene()[1][frame].double().cpu())
        projector = self._model.scan.projector
        p = transform(T_projector_scene, torch.from_numpy(self.mesh.vertices))
        uv, in_front = project(Intrinsics.of(projector, torch.float64), p)
        normals = torch.from_numpy(self.mesh.vertex_normals()) @ T_projector_scene[:3, :3].T
        inside = ((uv >= 0) & (uv <= torch.tensor([projector.w, projector.h]))).all(-1)
        lit = in_front & inside & ((normals * p).sum(-1) < 0)
        rgb = coordinate_colours(torch.where(lit[:, None], uv, 0.0), lit)
        meaning = f"Pattern coordinates of the projector of frame {frame}, modulo 128: x is red, y green."
        return Coloured(_bytes(rgb.numpy(), lit.numpy()), meaning)


def _scaled(
    values: Float64[ndarray, "v"], colours: str, units: str, meaning: str, percentile: float = 95.0
) -> Coloured:
    """Colours from 0 to a percentile of the values."""
    known = values[np.isfinite(values)]
    limit = float(np.percentile(known, percentile)) if len(known) else 1.0
    scale = (colours, 0.0, limit or 1.0, units)
    return Coloured(_mapped(values, scale), meaning, scale)


def _mapped(values: Float64[ndarray, "v"], scale: tuple[str, float, float, str]) -> UInt8[ndarray, "v 3"]:
    colours, lower, upper, _ = scale
    share = np.clip((np.nan_to_num(values) - lower) / max(upper - lower, 1e-12), 0, 1)
    return _bytes(np.asarray(matplotlib.colormaps[colours](share))[:, :3], np.isfinite(values))


def _bytes(rgb: Float64[ndarray, "v 3"], known: Bool[ndarray, "v"] | None = None) -> UInt8[ndarray, "v 3"]:
    out = np.rint(255 * np.clip(rgb, 0, 1)).astype(np.uint8)
    if known is not None:
        out[~known] = UNKNOWN
    return out


# The controls of a scan at the top of the viewer's panel.


class Panel:
    """The values that the user chose; every change calls `changed` with the name of what changed."""

    def __init__(
        self, server: viser.ViserServer, names: Sequence[str], training: bool, changed: Callable[[str], None]
    ) -> None:
        gui = server.gui
        with gui.add_folder("Scan", order=-1.0):
            mode = RENDERED if training else SHADED
            self.surface = gui.add_dropdown("Surface", MODES, mode, hint="The surface as a mesh, in these colours")
            self._legend = gui.add_markdown("", visible=False)
            self.update = gui.add_button("Update surface", visible=False, hint="Make the mesh of the current step")
            last = max(len(names) - 1, 1)
            self.frame = gui.add_slider(
                "Frame", 0, last, 1, 0, hint="Its projector lights the surface; depth, coordinates and rays are its own"
            )
            self._name = gui.add_markdown("")
            self.rays = gui.add_checkbox("Pattern rays", False, hint="Where rays of the frame's devices meet")
            self.projectors = gui.add_checkbox("Projectors", True)
            self.starting = gui.add_checkbox("Starting poses", True, hint="Grey, with a line to the current pose")
            self.names = gui.add_checkbox("All names", False, hint="Otherwise those of the chosen frame")
        self._frames, self._training = names, training
        for name in ("surface", "frame", "rays", "projectors", "starting", "names"):
            getattr(self, name).on_update(lambda _, name=name: changed(name))
        self.update.on_click(lambda _: changed("update"))
        self.show_frame()

    @property
    def chosen_frame(self) -> int:
        """Number of the chosen frame."""
        return min(int(self.frame.value), len(self._frames) - 1)

    def show_frame(self) -> None:
        """Write the chosen frame's name under the slider."""
        self._name.content = f"`{self._frames[self.chosen_frame]}`"

    def show_legend(self, coloured: Coloured | None) -> None:
        """Say what the colours mean; None if the surface is not drawn as a mesh."""
        self._legend.visible = coloured is not None
        self.update.visible = self._training and coloured is not None
        if coloured is not None:
            self.say(legend(coloured))

    def say(self, text: str) -> None:
        """Write something under the choice of the surface."""
        self._legend.visible = True
        self._legend._image_root = Path()  # pictures are data, not files
        self._legend.content = text


def legend(coloured: Coloured) -> str:
    """Markdown: the colour scale with its limits, and what it shows."""
    if coloured.scale is None:
        return coloured.meaning
    colours, lower, upper, units = coloured.scale
    strip = np.repeat(matplotlib.colormaps[colours](np.linspace(0, 1, 240))[None, :, :3], 10, 0)
    buffer = io.BytesIO()
    Image.fromarray(np.rint(255 * strip).astype(np.uint8)).save(buffer, "PNG")
    address = "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
    return f"![colours]({address})\n\n**{lower:.3g}** to **{upper:.3g} {units}**. {coloured.meaning}"


_PATTERN_PIXELS = 256  # longest side of the pattern drawn on a projector
_SECONDS_BETWEEN_UPDATES = 0.5
_RAY = 0.012  # radius of a ray, as a share of a pyramid's size


class SceneView(ViewerControl):
    """Draws the scan once a viewer exists, and moves what depends on poses while these are refined.

    nerfstudio finds the object as an attribute of the pipeline and calls `_setup`, in training and in `ns-viewer`.
    """

    def __init__(self, model: TrainedModel) -> None:
        self._model = model
        self._devices: tuple[DeviceNodes, DeviceNodes] | None = None
        self._surface: ViewerSurface | None = None
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
        # It draws its own frusta after this, with the same setting, whose default is 0.1.
        self._scale = 10 * viewer.config.camera_frustum_scale * pyramid_size(cameras)
        viewer.config.camera_frustum_scale = self._scale
        names, current = [frame.name for frame in scan.frames], self._numpy_poses()
        scene, pattern = self.viser_server.scene, _thumbnail(scan.read_pattern())
        devices = [frame.camera for frame in scan.frames], [scan.projector] * len(names)
        self._devices = (
            DeviceNodes(scene, "camera", names, devices[0], cameras, current[0], self._scale),
            DeviceNodes(scene, "projector", names, devices[1], projectors, current[1], self._scale, pattern),
        )
        self._mark_unplaced()
        self.panel = Panel(self.viser_server, names, viewer.trainer is not None, self._changed)
        self.show_devices()
        if viewer.trainer is None:
            self.show_surface()  # at once: what was trained is there
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
        assert self._devices is not None
        (cameras, projectors), panel = self._devices, self.panel
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
        for kind, ends in zip(COLOURS, segments, strict=True):
            name, scene = f"/rays/{kind}", self.viser_server.scene
            self._nodes[name] = add_rods(scene, name, ends * SCENE_SCALE, _RAY * self._scale, COLOURS[kind])

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
                self._surface = ViewerSurface(self._model)
            coloured = self._surface.coloured(mode, self.panel.chosen_frame)
        except UserError as error:
            self._remove("/surface")
            self.panel.say(first_line(error))
            return
        self._draw_surface(self._surface, coloured)
        self.panel.show_legend(coloured)

    def _draw_surface(self, surface: ViewerSurface, coloured: Coloured) -> None:
        import trimesh  # takes half a second, and only a viewer needs it

        mesh = trimesh.Trimesh(
            surface.mesh.vertices * SCENE_SCALE,
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

    def _numpy_poses(self) -> tuple[Float64[ndarray, "n 4 4"], Float64[ndarray, "n 4 4"]]:
        camera, projector = self._model.poses_scene()
        return camera.detach().cpu().double().numpy(), projector.detach().cpu().double().numpy()

    # ---- the first view

    def _look_at_object(self, client: viser.ClientHandle) -> None:
        points = None if self._surface is None else self._surface.mesh.vertices
        look_at_object(client, np.concatenate(self._numpy_poses()), points)


def _thumbnail(pattern: Float[ndarray, "h w"]) -> UInt8[ndarray, "h2 w2 3"]:
    step = max(1, math.ceil(max(pattern.shape) / _PATTERN_PIXELS))
    grey = (pattern[::step, ::step] * 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
