"""The page of a live scan: the growing surface, devices, the camera's picture, what is missing, and where to go.

It is drawn on the page of the preview, which goes on with the pipeline when the live scan has ended.
"""

import base64
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
import viser
from jaxtyping import Float64, UInt8
from numpy import ndarray

from sl_nerfstudio.capture.camera import draw_pixels
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import Similarity, centred_on
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.geometry.triangulation import upright
from sl_nerfstudio.live.next_view import NextView
from sl_nerfstudio.live.session import Row, Update
from sl_nerfstudio.live.sight import Fault, Sight
from sl_nerfstudio.live.surfels import ENOUGH, Surfels
from sl_nerfstudio.live.tracker import Doubt, Model, State
from sl_nerfstudio.model.preview import Preview
from sl_nerfstudio.model.scene_nodes import COLOURS, SCENE_SCALE, look_at_object, place, pyramid_size, vertical_fov

# Words: what is the matter, and what to do.

_SAYS: dict[Fault | Doubt, tuple[str, str]] = {
    Fault.NO_PATTERN: ("the pattern is not in view", "point the camera at what the projector lights"),
    Fault.BLURRED: ("blurred: too fast, or out of focus", "move more slowly, or hold still and focus again"),
    Fault.DARK: ("too dark, or nothing that is lit is in view", "point the camera at the object, or expose longer"),
    Fault.BRIGHT: ("too bright", "shorten the exposure"),
    Fault.TOO_FAR: ("too far away: the pattern is too fine in the picture", "go closer with the camera"),
    Fault.TOO_LITTLE: ("too little of the pattern is read", "go closer, and light the object in the picture's middle"),
    Fault.NO_RELATIVE_POSE: ("camera and projector do not fit each other", "hold both still for a moment; move the "
                             "projector farther from the camera"),
    Doubt.RIVAL: ("another place fits nearly as well", "show something irregular as well: a corner, a mark, an edge"),
    Doubt.SLIPS: ("the surface looks the same if it is turned", "put marks or something irregular beside the object"),
    Doubt.UNSTEADY: ("the place is known roughly", "show more of the surface that is there already"),
    Doubt.RELATIVE_POSE: ("several poses of the projector fit", "move the projector farther from the camera"),
    Doubt.UNCONFIRMED: ("found again, not yet for certain", "stay here for a moment"),
    Doubt.JUMP: ("the camera would have jumped", "move more slowly, or stay here for a moment"),
    Doubt.NO_OVERLAP: ("this side has not been seen yet", "go back to what the page shows, then slowly on"),
    Doubt.TOO_FAST: ("too fast: nothing fits what was seen before", "go back a little, then more slowly"),
    Doubt.WEAK_START: ("the projector's pose is not clear", "begin with the object in the middle, both devices apart"),
}  # fmt: skip
_LEAST_WORTH_DEG = 8.0  # of a turn to the next view that is said

# Colours and sizes.

_STATE_COLOURS = {State.TRACKED: (60, 190, 90), State.UNCERTAIN: (235, 180, 40), State.LOST: (230, 60, 50)}
_VIEW_COLOURS = np.array([[205, 70, 50], [225, 165, 50], [95, 165, 95]], np.float64)  # cells seen once, twice, more
_GHOST = (225, 70, 210)
_UNCERTAIN_CELLS = 1.0  # sigma over the size of a cell, beyond which a cell is drawn as seen once
_PICTURE, _PICTURE_QUALITY = 480, 80  # width of the camera's picture, and quality of its JPEG
_KEPT_SIZE, _NOW_SIZE, _GHOST_SIZE = 0.25, 0.6, 0.8  # of pyramids, over the usual size
_OVERLAP = 1.5  # size of a drawn cell over its own
_NARROW, _LOWER = 0.8, 0.5  # width of a window over its height, and by how much its view is moved, scene units
_LEAST_SHADE = 0.45
_OUTSIDE = 1.0  # percent of the first surface beyond each side of the box that is looked at
_WIDER = 1.4  # than what the first frame saw, is what is looked at
_ROOM = 1.6  # radius of the scene over that of what the first frame saw


class LivePage:
    """Shows a session on the page of a preview, while it is open as a context."""

    def __init__(self, preview: Preview, camera: Device, projector: Device) -> None:
        self._preview, self._server, self._devices = preview, preview.server, (camera, projector)
        self._stop = threading.Event()
        self._S_scene_world: Similarity | None = None
        self._first: tuple[Float64[ndarray, "n 4 4"], Float64[ndarray, "k 3"]] | None = None  # what is looked at first
        self._nodes: dict[str, viser.SceneNodeHandle] = {}
        self._kept = 0
        preview.offer_choices(False)
        gui = self._server.gui
        gui.configure_theme(control_layout="collapsible", control_width="medium", show_logo=False)
        self._status = gui.add_markdown("**waiting for the first image**")
        self._picture = gui.add_markdown("", image_root=Path())
        self._finish = gui.add_button("finish the scan")
        self._finish.on_click(lambda _: self._stop.set())
        self._server.on_client_connect(self._look)

    def __enter__(self) -> "LivePage":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the page to what comes next."""
        for node in (*self._nodes.values(), self._status, self._picture, self._finish):
            node.remove()
        self._preview.offer_choices(True)

    def stopped(self) -> bool:
        """Whether the user has asked for the end."""
        return self._stop.is_set()

    def show(self, update: Update) -> None:
        """Draw what one image changed."""
        self._status.content = said(update)
        self._picture.content = picture_text(decoded_picture(update.sight))
        model = update.model
        if not len(model):
            return
        if self._S_scene_world is None or len(model) < self._kept:
            self._begin(model)
        with self._server.atomic():
            if len(model) != self._kept:
                self._draw_model(model)
            self._draw_now(update)
            self._draw_ghost(update.next_view if len(model) > 1 else None)
        self._kept = len(model)

    def _begin(self, model: Model) -> None:
        """Fix the scene's axes: the first kept frame upright, what it saw in the middle."""
        cameras = model.poses.T_world_camera[:1]
        turned = Similarity(1.0, upright(cameras), np.zeros(3))
        box = centred_on(turned.points(model.surfels.position), _OUTSIDE)
        self._S_scene_world = Similarity.scaling(1 / _ROOM) @ box @ turned
        surface = self._S_scene_world.points(model.surfels.position)
        self._first = model.poses.mapped(self._S_scene_world).stacked(), _WIDER * surface
        for client in self._server.get_clients().values():
            self._look(client)

    def _draw_model(self, model: Model) -> None:
        S, scene = self._S_scene_world, self._server.scene
        assert S is not None
        surface, solid = model.surfels, model.surfels.solid
        placed = model.poses.mapped(S)
        self._size = pyramid_size(placed.T_world_camera)
        towards = model.poses.T_world_camera[-1, :3, 3]
        self._nodes["surface"] = scene.add_point_cloud(
            "/live/surface", (S.points(surface.position[solid]) * SCENE_SCALE).astype(np.float32),
            cell_colours(surface, towards)[solid], S.scale * surface.size * SCENE_SCALE * _OVERLAP, "circle",
        )  # fmt: skip
        for k, T in enumerate(placed.T_world_camera):
            name = f"/live/kept/{k}"
            node = self._nodes.get(name)
            if not isinstance(node, viser.CameraFrustumHandle):
                camera = self._devices[0]
                node = scene.add_camera_frustum(
                    name, vertical_fov(camera), camera.w / camera.h, _KEPT_SIZE * self._size, color=COLOURS["camera"]
                )
                self._nodes[name] = node
            place(node, T)
        for name in [n for n in self._nodes if n.startswith("/live/kept/") and int(n[11:]) >= len(model)]:
            self._nodes.pop(name).remove()

    def _draw_now(self, update: Update) -> None:
        """Both devices where they are, in the colour of the state; none where they are unknown."""
        S, now = self._S_scene_world, update.placed.S_world_camera
        assert S is not None
        for name in ("/live/now/camera", "/live/now/projector"):
            if name in self._nodes:
                self._nodes.pop(name).remove()
        if now is None or update.sight.cloud is None:
            return
        relative = update.sight.cloud.pose.T_camera_projector
        colours = _STATE_COLOURS[update.placed.state], COLOURS["projector"]
        for name, device, T, colour in zip(
            ("camera", "projector"), self._devices, (now.poses(np.eye(4)), now.poses(relative)), colours, strict=True
        ):
            node = self._server.scene.add_camera_frustum(
                f"/live/now/{name}", vertical_fov(device), device.w / device.h, _NOW_SIZE * self._size, color=colour
            )
            place(node, S.poses(T))
            self._nodes[f"/live/now/{name}"] = node

    def _draw_ghost(self, view: NextView | None) -> None:
        for name in ("/live/next", "/live/next-name"):
            if name in self._nodes:
                self._nodes.pop(name).remove()
        S, camera = self._S_scene_world, self._devices[0]
        if view is None or S is None:
            return
        T = S.poses(view.T_world_camera)
        ghost = self._server.scene.add_camera_frustum(
            "/live/next", vertical_fov(camera), camera.w / camera.h, _GHOST_SIZE * self._size, color=_GHOST
        )
        place(ghost, T)
        self._nodes["/live/next"] = ghost
        self._nodes["/live/next-name"] = self._server.scene.add_label(
            "/live/next-name", "next view", position=T[:3, 3] * SCENE_SCALE
        )

    def _look(self, client: viser.ClientHandle) -> None:
        if self._first is not None:
            look_at_object(client, *self._first)
            if (client.camera.aspect or 1) < _NARROW:  # the panel covers the lower half of a telephone
                lower = _LOWER * SCENE_SCALE * client.camera.up_direction
                client.camera.position, client.camera.look_at = (
                    client.camera.position - lower, client.camera.look_at - lower,
                )  # fmt: skip


def said(update: Update) -> str:
    """State, cause and remedy, where to go, and what there is; for the page and, its first line, for the console."""
    placed, model = update.placed, update.model
    lines = [f"### {placed.state.value}"]
    if placed.cause is not None:
        problem, remedy = _SAYS[placed.cause]
        lines.append(f"{problem} → **{remedy}**")
    elif update.row.kept >= 0:
        lines.append("kept")
    else:
        lines.append("known already: go on")
    if placed.state is State.LOST and len(model):
        lines.append("to come back: show a part of the surface that is on the page already")
    elif len(model) > 1:
        lines.append(where_to(update.next_view, placed.S_world_camera))
    if len(model.surfels):
        thin = float((model.surfels.views[model.surfels.solid] < ENOUGH).mean())
        lines.append(f"{len(model)} frames kept, {1 - thin:.0%} of the surface seen {ENOUGH} times or more")
    lines.append(f"{update.row.seconds:.1f} s a frame")
    return "\n\n".join(lines)


def where_to(view: NextView | None, here: Similarity | None) -> str:
    """The way to the next view from where the camera is, as the user goes who looks at the object."""
    if view is None:
        return "the surface is known well from all sides that can be seen from here: finish, or look below and above"
    if here is None:
        return ""
    (right, above), parts = view.way_from(here), []
    for angle, more, less in ((right, "to the right", "to the left"), (above, "higher", "lower")):
        if abs(angle) >= _LEAST_WORTH_DEG:
            parts.append(f"{abs(angle):.0f}° {more if angle > 0 else less}")
    return f"next: **{', '.join(parts) or 'stay here a little longer'}**"


def cell_colours(surface: Surfels, towards: Float64[ndarray, "3"]) -> UInt8[ndarray, "n 3"]:
    """Red where a cell was seen once or is uncertain, yellow twice, green more often; shaded by its direction."""
    seen = np.where(surface.sigma > _UNCERTAIN_CELLS * surface.size, 1, surface.views).clip(1, ENOUGH)
    ray = towards - surface.position
    cosine = np.abs((ray * surface.normal).sum(1)) / np.linalg.norm(ray, axis=1)
    shade = _LEAST_SHADE + (1 - _LEAST_SHADE) * cosine
    return np.rint(_VIEW_COLOURS[seen - 1] * shade[:, None]).astype(np.uint8)


def decoded_picture(sight: Sight) -> UInt8[ndarray, "h w 3"]:
    """The camera's picture with what was decoded in colour."""
    image = sight.image if sight.image.ndim == 3 else sight.image[..., None].repeat(3, -1)
    size = _PICTURE, round(_PICTURE * image.shape[0] / image.shape[1])
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    if sight.cloud is None:
        return small
    coords = cv2.resize(sight.cloud.coords, size, interpolation=cv2.INTER_NEAREST)
    xy = coords / np.array([sight.cloud.projector.w, sight.cloud.projector.h], dtype=np.float32)
    return draw_pixels(small, xy, all_finite(xy))


def picture_text(picture: UInt8[ndarray, "h w 3"]) -> str:
    """A picture as the text of a page: viser has no element for pictures that change."""
    encoded = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _PICTURE_QUALITY])[1]
    return f"![camera](data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()})"


class Console:
    """Says in lines of text when the state changes."""

    def __init__(self, say: Callable[[str], None], resumed: int = 0) -> None:
        """`resumed`: images of an earlier run."""
        self._say, self._before = say, ""
        if resumed:
            say(f"going on after {resumed} images")

    def show(self, update: Update) -> None:
        """Say a line if it differs from the one before."""
        placed = update.placed
        line = placed.state.value
        if placed.cause is not None:
            line += ": {}: {}".format(*_SAYS[placed.cause])
        if line != self._before:
            self._say(f"{update.row.name}: {line}")
        self._before = line

    @staticmethod
    def summary(rows: Sequence[Row]) -> str:
        """How many images there were, and how many were placed and kept."""
        states = [row.state for row in rows]
        counts = ", ".join(f"{states.count(state.value)} {state.value}" for state in State)
        return f"{len(rows)} images: {counts}; {sum(row.kept >= 0 for row in rows)} frames kept"
