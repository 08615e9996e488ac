"""What a browser shows while `sl-scan` works: devices and points of the registered frames, then the surface.

One server of viser's from the photographs to the mesh, so that one page shows it all. nerfstudio's viewer would begin
with the training, under another address, and render pictures on the cores that train. Nothing that is drawn here
changes a result, and during the training nothing is computed unless a browser is connected.
"""

import colorsys
import io
import math
import socket
import time
from collections.abc import Iterable, Sequence
from contextlib import redirect_stdout, suppress
from typing import TYPE_CHECKING

import numpy as np
import viser
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, centred_on
from sl_nerfstudio.geometry.triangulation import upright
from sl_nerfstudio.model.scene_nodes import (
    CLAY,
    COLOURS,
    SCENE_SCALE,
    decoded_points,
    look_at_object,
    place,
    pyramid_size,
    vertical_fov,
)
from sl_nerfstudio.registration.surfaces import FrameCloud

if TYPE_CHECKING:
    from sl_nerfstudio.model.outputs import TrainedModel

HOST, PORT = "127.0.0.1", 7007  # as nerfstudio's viewer
EVERYWHERE = "0.0.0.0"  # for all machines of the network
_ELSEWHERE = "192.0.2.1", 9  # an address that no machine has: which of our own would be used to reach others
_PORTS = 100  # that are tried
MOST_POINTS = 100_000  # of all frames together
_MOST_OF_A_FRAME = 4_000
_OUTSIDE = 2.0  # percent of the points beyond each side of the box that is looked at
_FARTHEST = 1.5  # from the middle of the scene, in half the diagonal of that box: points beyond are decoding errors
_POINT_SIZE = 0.004
_RESOLUTION = 80  # cells along the scene's box
_TRAINING_PER_DRAWING = 20  # seconds of training for each second that the surface takes
_FIRST_SECONDS = 0.2  # counted for the frames, which are drawn once


class Preview:
    """A page that shows what has been found; it ends with the block that it is opened for."""

    def __init__(self, title: str, shared: bool = False) -> None:
        """Serve the page at the first free port; `shared`: to the whole network. Raises UserError if there is none."""
        port = _free_port()
        with redirect_stdout(io.StringIO()):  # viser prints its address, in a frame
            self.server = viser.ViserServer(EVERYWHERE if shared else HOST, port, verbose=False)
        found = self.server.get_port()
        address = (
            f"{_own_address() if shared else HOST}:{found} (open it in a browser; the page ends with this command)"
        )
        self.where = address if found == PORT else f"{address}; port {PORT} is in use by another program"
        self._devices: Float64[ndarray, "n 4 4"] | None = None
        self._surface: Float64[ndarray, "v 3"] | None = None
        self._drawn: dict[str, viser.SceneNodeHandle] = {}
        self._training = False
        self._due = -math.inf
        gui = self.server.gui
        self._title = title
        self._said = gui.add_markdown("")
        self._shown = {name: gui.add_checkbox(name, True) for name in ("points", "cameras", "projectors", "surface")}
        self._groups: dict[str, viser.SceneNodeHandle] = {
            name: self.server.scene.add_frame(f"/{name}", show_axes=False) for name in self._shown if name != "surface"
        }
        for name, box in self._shown.items():
            box.on_update(lambda _, name=name: self._show(name))
        self.server.on_client_connect(self._look)

    def __enter__(self) -> "Preview":
        return self

    def __exit__(self, *_: object) -> None:
        self.server.stop()
        loop = self.server._websock_server._broadcast_buffer.event_loop
        with suppress(RuntimeError):
            loop.call_soon_threadsafe(lambda: None)  # wake it, or it closes the port with the next message only

    def offer_choices(self, offered: bool) -> None:
        """Whether the page has boxes that choose what is shown; they do nothing while others show things on it."""
        for box in self._shown.values():
            box.visible = offered

    def say(self, what: str) -> None:
        """Say on the page what the command is doing."""
        self._said.content = f"**{self._title}**\n\n{what}"

    def registered(self, clouds: Sequence[FrameCloud], poses: DevicePoses, what: str) -> None:
        """Draw the frames whose poses are known (not NaN), and say what was done."""
        index = np.flatnonzero(np.isfinite(poses.T_world_camera).all((1, 2)))
        chosen = [clouds[k] for k in index]
        self._draw([(c.name, c.camera, c.projector) for c in chosen], (c.coords for c in chosen), poses[index])
        self.say(f"{len(index)} of {len(clouds)} frames {what}")

    def trained(self, model: "TrainedModel") -> None:
        """Draw the surface after a step of the training, if a browser is connected and enough time has passed."""
        begun = time.monotonic()
        if begun < self._due or not self.server.get_clients():
            return
        if not self._training:  # there is no surface yet, but a sphere
            self._training = True
            scan = model.scan
            frames = [(frame.name, frame.camera, scan.projector) for frame in scan.frames]
            coords = (frame.read_coords() for frame in scan.frames)
            self._draw(frames, coords, model.poses(), model.S_scene_world)
            self.say(f"training, step {model.step}")
            self._due = time.monotonic() + _TRAINING_PER_DRAWING * _FIRST_SECONDS
            return
        self._draw_surface(model)
        self._due = time.monotonic() + _TRAINING_PER_DRAWING * (time.monotonic() - begun)

    # ---- the scene

    def _draw(
        self,
        frames: Sequence[tuple[str, Device, Device]],
        coords: Iterable[Float32[ndarray, "h w 2"]],
        poses: DevicePoses,
        S_scene_world: Similarity | None = None,
    ) -> None:
        """Draw devices and points in place of those that are there, and look at them if they are the first.

        `frames` are names, cameras and projectors. Without `S_scene_world`, the scene is like that of the training:
        upright, about the points.
        """
        scene, first = self.server.scene, self._devices is None
        most = min(_MOST_OF_A_FRAME, MOST_POINTS // max(len(poses), 1))
        seen = zip(frames, coords, poses.T_world_camera, poses.T_world_projector, strict=True)
        points = [
            decoded_points(camera, projector, uv, T_camera, T_projector, most)
            for (_, camera, projector), uv, T_camera, T_projector in seen
        ]
        if S_scene_world is None:
            turned = Similarity(1.0, upright(poses.T_world_camera), np.zeros(3))
            S_scene_world = centred_on(turned.points(np.concatenate(points)), _OUTSIDE) @ turned
        placed = poses.mapped(S_scene_world)
        self._devices, size = placed.stacked(), pyramid_size(placed.T_world_camera)
        before, self._drawn = self._drawn, {}
        with self.server.atomic():
            colours = _colours(len(frames))
            rows = zip(frames, placed.T_world_camera, placed.T_world_projector, points, colours, strict=True)
            for (name, camera, projector), T_camera, T_projector, p, colour in rows:
                for kind, device, T in (("camera", camera, T_camera), ("projector", projector, T_projector)):
                    path, shape = f"/{kind}s/{name}", (vertical_fov(device), device.w / device.h)
                    self._drawn[path] = node = scene.add_camera_frustum(path, *shape, size, color=COLOURS[kind])
                    place(node, T)
                p, path = S_scene_world.points(p), f"/points/{name}"
                p = p[np.linalg.norm(p, axis=1) < _FARTHEST] * SCENE_SCALE
                rgb = np.tile(colour, (len(p), 1))
                self._drawn[path] = scene.add_point_cloud(path, p, rgb, _POINT_SIZE * SCENE_SCALE, "circle")
            for name in before.keys() - self._drawn.keys():
                before[name].remove()
        if first or self._training:
            for client in self.server.get_clients().values():
                self._look(client)

    def _draw_surface(self, model: "TrainedModel") -> None:
        from sl_nerfstudio.meshing.extract import extract_mesh

        try:
            mesh = extract_mesh(model.sdf, _RESOLUTION, device=model.device)
        except UserError as error:
            return self.say(f"training, step {model.step}: {first_line(error)}")
        first, self._surface = self._surface is None, mesh.vertices
        self._groups["surface"] = self.server.scene.add_mesh_simple(
            "/surface", SCENE_SCALE * mesh.vertices, mesh.faces, color=CLAY, visible=self._shown["surface"].value
        )
        if first:
            self._shown["points"].value = False
            self._show("points")
        self.say(f"training, step {model.step}")

    def _show(self, name: str) -> None:
        if name in self._groups:
            self._groups[name].visible = self._shown[name].value

    def _look(self, client: viser.ClientHandle) -> None:
        if self._devices is not None:
            look_at_object(client, self._devices, self._surface)


def _free_port() -> int:
    """The first port that can be listened at. viser would try for ever where none can."""
    for port in range(PORT, PORT + _PORTS):
        with socket.socket() as tried, suppress(OSError):
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind((HOST, port))
            return port
    raise UserError(
        f"--preview: no port from {PORT} to {PORT + _PORTS - 1} of this machine can be used\n"
        "    cause:  other programs have them, or this program may not open any\n    remedy: leave the flag out"
    )


def _own_address() -> str:
    """The address at which others in the network reach this machine; nothing is sent to find it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tried:
        try:
            tried.connect(_ELSEWHERE)
            return str(tried.getsockname()[0])
        except OSError:
            return HOST


def _colours(count: int) -> list[UInt8[ndarray, "3"]]:
    """One for each frame, in the order of capture around the circle of hues."""
    hues = (colorsys.hsv_to_rgb(0.85 * k / max(count - 1, 1), 0.65, 0.85) for k in range(count))
    return [np.rint(255 * np.array(rgb)).astype(np.uint8) for rgb in hues]
