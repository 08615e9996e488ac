"""Interactive views of surfaces, cameras and projectors, by Plotly, that work without a network."""

import base64
import gzip
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int
from matplotlib import colormaps
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.evaluation.report.charts import CLAY, ColourLayer
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.geometry.triangulation import OUTLINE, Viewpoint, beside, far_enough, frustum
from sl_nerfstudio.late_imports import open3d as o3d
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.processing.scan_poses import PlacedFrame, PlacedGroup

CAMERA_COLOUR, PROJECTOR_COLOUR = "#2563a8", "#c2571a"
HEIGHT = 560  # of the view in the page, pixels
_ASPECT = 1030 / HEIGHT
_FIELD_OF_VIEW = math.pi / 4  # Plotly's, vertical
_FRUSTUM = 0.18  # length of a pyramid, of the median distance between devices and object


@dataclass(frozen=True)
class PlotBox:
    """The box around everything that is drawn; Plotly's own coordinates have their origin in its middle."""

    lower: Float64[ndarray, "3"]
    upper: Float64[ndarray, "3"]

    @staticmethod
    def around(points: Float[ndarray, "n 3"]) -> "PlotBox":
        """A box with a margin; points that are not finite do not count."""
        known = points[np.isfinite(points).all(1)].astype(np.float64)
        lower, upper = known.min(0), known.max(0)
        margin = 0.05 * float((upper - lower).max()) or 1.0
        return PlotBox(lower - margin, upper + margin)

    @property
    def scale(self) -> float:
        """Plotly's unit by the unit of the points: the longest side becomes one."""
        return 1.0 / float((self.upper - self.lower).max())

    def plotted(self, p: Float[ndarray, "3"]) -> dict[str, float]:
        """A point in Plotly's coordinates."""
        return _xyz(self.scale * (p - (self.lower + self.upper) / 2))

    def camera(self, view: Viewpoint) -> dict[str, Any]:
        """Plotly's camera at a viewpoint."""
        return {"eye": self.plotted(view.eye), "center": self.plotted(view.centre), "up": _xyz(view.up)}

    def axes(self) -> dict[str, Any]:
        """The axes of the plot: not drawn, and of equal scale."""
        sides = zip("xyz", self.lower.tolist(), self.upper.tolist(), strict=True)
        ranges = {f"{axis}axis": {"visible": False, "range": [low, high]} for axis, low, high in sides}
        return {**ranges, "aspectmode": "manual", "aspectratio": _xyz(self.scale * (self.upper - self.lower))}


def viewpoint(
    points: Float64[ndarray, "n 3"], centre: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "m 4 4"]
) -> Viewpoint:
    """Look from where all points are in the picture, beside the first of the cameras; up is the cameras' up."""
    up = T_world_camera[:, :3, 1].mean(0)
    if np.linalg.norm(up) < 0.1:  # cameras held in every orientation
        up = T_world_camera[0, :3, 1]
    towards = T_world_camera[0, :3, 3] - centre
    direction = beside(towards if np.linalg.norm(towards) > 0 else T_world_camera[0, :3, 2], up)
    return far_enough(points, centre, direction, up / np.linalg.norm(up), _FIELD_OF_VIEW, _ASPECT)


def frustum_length(T_world_device: Float64[ndarray, "n 4 4"], centre: Float64[ndarray, "3"]) -> float:
    """Choose how long to draw the pyramids of some devices around an object."""
    return _FRUSTUM * float(np.median(np.linalg.norm(T_world_device[:, :3, 3] - centre, axis=1)))


@dataclass(frozen=True)
class DrawnDevices:
    """Devices that are drawn alike, under one name."""

    name: str
    labels: Sequence[str]  # one for each, shown where the pointer is
    devices: Sequence[Device]
    T_world_device: Float64[ndarray, "n 4 4"]
    colour: str
    dash: str = "solid"

    def points(self, length: float) -> Float64[ndarray, "n 8 3"]:
        """The points of all pyramids."""
        drawn = [frustum(device, T, length) for device, T in zip(self.devices, self.T_world_device, strict=True)]
        return np.array(drawn).reshape(-1, 8, 3)

    def trace(self, length: float, **look: Any) -> dict[str, Any]:
        """One line of Plotly's that draws all pyramids, with gaps between them."""
        lines = self.points(length)[:, OUTLINE]
        gapped = np.concatenate([lines, np.full((len(lines), 1, 3), np.nan)], 1).reshape(-1, 3).astype(np.float32)
        text = [label for label in self.labels for _ in range(len(OUTLINE) + 1)]
        return {
            "type": "scatter3d", "mode": "lines", "name": self.name, "text": text, "hoverinfo": "text",
            "line": {"color": self.colour, "width": 3, "dash": self.dash}, "connectgaps": False,
            **dict(zip("xyz", gapped.T, strict=True)), **look,
        }  # fmt: skip


def as_json(traces: Sequence[Any], layout: dict[str, Any]) -> str:
    """A Plotly figure for a <script> element of a page."""
    import plotly.graph_objects as go

    common = {
        "template": "none", "height": HEIGHT, "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"orientation": "h", "x": 0, "y": 0, "bgcolor": "rgba(255,255,255,0.7)"},
        "font": {"family": "inherit", "size": 12},
    }  # fmt: skip
    figure = go.Figure(list(traces), {**common, **layout})
    return str(figure.to_json()).replace("<", "\\u003c")


def menu(buttons: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A menu at the top left of the view."""
    return {"buttons": list(buttons), "x": 0, "xanchor": "left", "y": 1, "yanchor": "top", "bgcolor": "white"}


def camera_buttons(cameras: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Buttons that look through Plotly's cameras, by their labels."""
    return [
        {"label": label, "method": "relayout", "args": [{"scene.camera": camera}]} for label, camera in cameras.items()
    ]


def view_buttons(buttons: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Buttons side by side at the lower right of the view."""
    place = {"x": 1, "xanchor": "right", "y": 0, "yanchor": "bottom", "bgcolor": "white"}
    return {"type": "buttons", "direction": "right", "showactive": False, "buttons": list(buttons), **place}


def _xyz(v: Float[ndarray, "3"]) -> dict[str, float]:
    return {axis: float(value) for axis, value in zip("xyz", v, strict=True)}


# The surface as an interactive plot that works without a network.

MOST_TRIANGLES = 40_000  # about 1 MB in the page

MEASURED_LINE = {
    "type": "scatter3d", "mode": "lines+markers", "name": "measured", "x": [], "y": [], "z": [], "hoverinfo": "skip",
    "showlegend": False, "line": {"color": "#111111", "width": 6}, "marker": {"color": "#111111", "size": 6},
}  # fmt: skip


@dataclass(frozen=True)
class SceneDevices:
    """Names and intrinsics of what took the frames."""

    names: Sequence[str]
    cameras: Sequence[Device]
    projector: Device

    def drawn(self, poses: DevicePoses) -> tuple[DrawnDevices, DrawnDevices]:
        """Cameras and projectors at some poses."""
        of = [f"of frame {k}: {name}" for k, name in enumerate(self.names)]
        return (
            DrawnDevices("cameras", [f"camera {o}" for o in of], self.cameras, poses.T_world_camera, CAMERA_COLOUR),
            DrawnDevices(
                "projectors",
                [f"projector {o}" for o in of],
                [self.projector] * len(of),
                poses.T_world_projector,
                PROJECTOR_COLOUR,
            ),
        )


def decimated(mesh: Mesh, most: int = MOST_TRIANGLES) -> tuple[Mesh, ndarray]:
    """The mesh reduced to about `most` triangles, and for each of its vertices the nearest one of the original."""
    if len(mesh.faces) <= most:
        return mesh, np.arange(len(mesh.vertices))
    centre = mesh.vertices.mean(0)
    size = float(np.ptp(mesh.vertices, axis=0).max()) or 1.0
    plain = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector((mesh.vertices - centre) / size),
        o3d.utility.Vector3iVector(mesh.faces.astype(np.int32)),
    )
    if len(mesh.faces) > 5 * most:  # first a coarse pass: precise decimation of a million triangles takes 10 s
        cell = float(np.sqrt(mesh.face_areas().sum() / most)) / size
        plain = plain.simplify_vertex_clustering(cell, o3d.geometry.SimplificationContraction.Average)
    small = plain.simplify_quadric_decimation(most)
    vertices = np.asarray(small.vertices) * size + centre
    used = np.unique(mesh.faces)
    nearest = used[np.asarray(KDTree(mesh.vertices[used]).query(vertices)[1])]
    return Mesh(vertices, np.asarray(small.triangles).astype(np.int64)), nearest


def mesh_figure(
    mesh: Mesh,
    layers: Sequence[ColourLayer],
    poses: DevicePoses,
    devices: SceneDevices,
    sigma: Float[ndarray, "v"] | None = None,
) -> str:
    """Plotly figure (JSON): the surface with cameras and projectors, a menu of what colours it, and two viewpoints.

    The first of the layers colours it at the start; without layers it is clay, and there is no such menu. `sigma` is
    what the page says of the ends of a measured line; the line is the last trace.
    """
    small, nearest = decimated(mesh)
    x, y, z = small.vertices.astype(np.float32).T
    i, j, k = small.faces.astype(np.int32).T
    look: dict[str, Any] = {"color": f"rgb{tuple(int(255 * c) for c in CLAY)}", "hoverinfo": "none"}
    if layers:
        look = _look(layers[0], nearest)
    if sigma is not None:
        look["customdata"] = sigma[nearest].astype(np.float32)
    surface = {
        "type": "mesh3d", "x": x, "y": y, "z": z, "i": i, "j": j, "k": k, "name": "surface", "showlegend": False,
        "flatshading": False,
        "lighting": {"ambient": 0.55, "diffuse": 0.6, "specular": 0.05, "roughness": 0.9}, **look,
    }  # fmt: skip
    centre = (small.vertices.min(0) + small.vertices.max(0)) / 2
    drawn = devices.drawn(poses)
    length = frustum_length(poses.stacked(), centre)
    everything = np.concatenate([small.vertices, *(d.points(length).reshape(-1, 3) for d in drawn)])
    box = PlotBox.around(everything)
    cameras = {
        label: box.camera(viewpoint(points, centre, poses.T_world_camera))
        for label, points in (("object", small.vertices), ("all devices", everything))
    }
    menus = [view_buttons(camera_buttons(cameras))]
    if len(layers) > 1:
        menus.insert(0, _menu(layers, nearest))
    return as_json(
        [surface, *(d.trace(length) for d in drawn), MEASURED_LINE],
        {"scene": {**box.axes(), "camera": cameras["object"]}, "updatemenus": menus},
    )


def _look(layer: ColourLayer, nearest: Int[ndarray, "n"]) -> dict[str, Any]:
    """The colours of the surface's trace."""
    scale, stops = layer.scale, np.linspace(0, 1, 11)
    colours = scale(scale.lower + stops * (scale.upper - scale.lower))
    digits = max(0, 3 - math.floor(math.log10(max(abs(scale.lower), abs(scale.upper), 1e-12))))
    return {
        "intensity": np.round(layer.values[nearest], digits).tolist(),  # a menu cannot hold Plotly's packed arrays
        "colorscale": [
            [float(s), f"rgb{tuple(int(255 * c) for c in rgb)}"] for s, rgb in zip(stops, colours, strict=True)
        ],
        "cmin": scale.lower,
        "cmax": scale.upper,
        "colorbar": {"title": {"text": layer.units, "side": "right"}, "thickness": 12, "len": 0.7},
        "hovertemplate": f"%{{intensity:.3g}} {layer.units}<extra></extra>",
    }


def _menu(layers: Sequence[ColourLayer], nearest: Int[ndarray, "n"]) -> dict[str, Any]:
    """The menu that changes the colours of the first trace."""
    buttons = []
    for layer in layers:
        look = _look(layer, nearest)
        nested = {key: [look[key]] for key in ("intensity", "colorscale")}
        plain = {key: look[key] for key in ("cmin", "cmax", "hovertemplate")}
        change = {**nested, **plain, "colorbar.title.text": layer.units}
        buttons.append({"label": layer.name, "method": "restyle", "args": [change, [0]]})
    return menu(buttons)


def compressed_script() -> str:
    """Plotly's JavaScript, gzipped, in base64: a third of its size; the page decompresses it."""
    from plotly.offline import get_plotlyjs

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), 9, mtime=0)).decode()


# The 3D view of the report of `sl-process`: cameras, projectors and surfaces, one group of frames at a time.

UNDECIDED_COLOUR, MISSING_COLOUR = "#d99a00", "#1d7a46"
_POINTS = "surface of each frame"


@dataclass(frozen=True)
class _Scene:
    """What is drawn of one group, and from where."""

    name: str
    traces: list[dict[str, Any]]
    layout: dict[str, Any]  # axes and camera
    buttons: list[dict[str, Any]]  # which look at everything, and at the object


def placed_figure(
    groups: Sequence[PlacedGroup], undecided: Sequence[str], missing: Sequence[tuple[str, str]], numbers: dict[str, int]
) -> str:
    """Plotly figure (JSON) with a menu of the groups; the first one is shown.

    `undecided` are frames whose poses are not certain; `missing` are pairs between which a frame should be added;
    `numbers` are the frames' places among all captures.
    """
    scenes = [_scene(group, set(undecided), missing, numbers) for group in groups]
    traces = [{**trace, "visible": k == 0} for k, scene in enumerate(scenes) for trace in scene.traces]
    owner = [k for k, scene in enumerate(scenes) for _ in scene.traces]
    menus = [view_buttons(scenes[0].buttons)]
    if len(scenes) > 1:
        buttons = [
            {"label": scene.name, "method": "update", "args": [
                {"visible": [o == k for o in owner]},
                {**scene.layout, "updatemenus[1].buttons": scene.buttons},
            ]}
            for k, scene in enumerate(scenes)
        ]  # fmt: skip
        menus.insert(0, menu(buttons))
    first = {key.removeprefix("scene."): value for key, value in scenes[0].layout.items()}
    return as_json(traces, {"scene": first, "updatemenus": menus})


def _scene(
    group: PlacedGroup, undecided: set[str], missing: Sequence[tuple[str, str]], numbers: dict[str, int]
) -> _Scene:
    frames = group.frames
    cameras = np.array([frame.T_world_camera for frame in frames])
    points = np.concatenate([frame.points for frame in frames]).astype(np.float64)
    if not len(points):  # nothing of the object: the devices alone
        points = cameras[:, :3, 3] - cameras[:, :3, 2]
    centre = np.median(points, axis=0)
    drawn = _devices(frames, undecided, numbers)
    added = _between(frames, missing, centre) if group.component == 0 else None
    drawn += [] if added is None else [added]
    length = frustum_length(cameras, centre)
    everything = np.concatenate([points, *(d.points(length).reshape(-1, 3) for d in drawn)])
    box = PlotBox.around(everything)
    views = {
        label: box.camera(viewpoint(seen, centre, cameras))
        for label, seen in (("all devices", everything), ("object", points))
    }
    traces = [_cloud(frames, numbers), *(d.trace(length) for d in drawn), _names(frames, numbers)]
    layout = {f"scene.{key}": value for key, value in {**box.axes(), "camera": views["all devices"]}.items()}
    return _Scene(_group_name(group), traces, layout, camera_buttons(views))


def _group_name(group: PlacedGroup) -> str:
    count = len(group.frames)
    if group.component == 0:
        return f"the scan: {count} frames"
    return f"group {group.component}: {count} frames" if count > 1 else f"{group.frames[0].name} by itself"


def _devices(frames: Sequence[PlacedFrame], undecided: set[str], numbers: dict[str, int]) -> list[DrawnDevices]:
    certain = [frame for frame in frames if frame.name not in undecided]
    doubtful = [frame for frame in frames if frame.name in undecided]
    drawn = (
        _drawn("cameras", ("camera",), certain, CAMERA_COLOUR, numbers),
        _drawn("projectors", ("projector",), certain, PROJECTOR_COLOUR, numbers),
        _drawn("undecided frames", ("camera", "projector"), doubtful, UNDECIDED_COLOUR, numbers),
    )
    return [group for group in drawn if group.labels]


def _drawn(
    name: str, kinds: Sequence[str], frames: Sequence[PlacedFrame], colour: str, numbers: dict[str, int]
) -> DrawnDevices:
    """Devices of one or both kinds, of some frames."""
    each = [(kind, frame) for frame in frames for kind in kinds]
    poses = [getattr(frame, f"T_world_{kind}") for kind, frame in each]
    return DrawnDevices(
        name,
        [f"{kind} of frame {numbers[frame.name]}: {frame.name}" for kind, frame in each],
        [getattr(frame, kind) for kind, frame in each],
        np.array(poses).reshape(-1, 4, 4),
        colour,
    )


def _between(
    frames: Sequence[PlacedFrame], missing: Sequence[tuple[str, str]], centre: Float64[ndarray, "3"]
) -> DrawnDevices | None:
    """Draw where frames should be added: midway between two cameras, as far from the object, looking at it."""
    named = {frame.name: frame for frame in frames}
    pairs = [(named[a], named[b]) for a, b in missing if a in named and b in named]
    if not pairs:
        return None
    poses = [_midway(a.T_world_camera, b.T_world_camera, centre) for a, b in pairs]
    labels = [f"add a frame here, between {a.name} and {b.name}" for a, b in pairs]
    return DrawnDevices(
        "add a frame here", labels, [a.camera for a, _ in pairs], np.array(poses), MISSING_COLOUR, dash="dash"
    )


def _midway(
    T_world_a: Float64[ndarray, "4 4"], T_world_b: Float64[ndarray, "4 4"], centre: Float64[ndarray, "3"]
) -> Float64[ndarray, "4 4"]:
    a, b = T_world_a[:3, 3] - centre, T_world_b[:3, 3] - centre
    distance = (np.linalg.norm(a), np.linalg.norm(b))
    back = a / distance[0] + b / distance[1]
    if np.linalg.norm(back) < 1e-6:  # opposite each other: over the cameras' heads
        back = T_world_a[:3, 1] + T_world_b[:3, 1]
    back = back / np.linalg.norm(back)
    right = np.cross(T_world_a[:3, 1] + T_world_b[:3, 1], back)
    if np.linalg.norm(right) < 1e-6:
        right = T_world_a[:3, 0] - (T_world_a[:3, 0] @ back) * back
    right = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(back, right), back], 1)
    T[:3, 3] = centre + 0.5 * sum(distance) * back
    return T


def _cloud(frames: Sequence[PlacedFrame], numbers: dict[str, int]) -> dict[str, Any]:
    """The points of all frames, each frame in a colour of its own."""
    count = np.array([len(frame.points) for frame in frames])
    points = np.concatenate([frame.points for frame in frames])
    colours = [f"rgb{tuple(int(255 * c) for c in colormaps['turbo'](0.05 + 0.9 * k / max(len(frames) - 1, 1))[:3])}"
               for k in range(len(frames))]  # fmt: skip
    scale = [[share, colour] for k, colour in enumerate(colours)
             for share in (k / len(colours), (k + 1) / len(colours))]  # fmt: skip
    return {
        "type": "scatter3d", "mode": "markers", "name": _POINTS, **dict(zip("xyz", points.T, strict=True)),
        "customdata": np.repeat([numbers[frame.name] for frame in frames], count).astype(np.int32),
        "hovertemplate": "frame %{customdata}<extra></extra>",
        "marker": {"size": 1.6, "color": np.repeat(np.arange(len(frames)), count).astype(np.float32), "cmin": -0.5,
                   "cmax": len(frames) - 0.5, "colorscale": scale, "showscale": False},
    }  # fmt: skip


def _names(frames: Sequence[PlacedFrame], numbers: dict[str, int]) -> dict[str, Any]:
    """The numbers of the frames at their cameras."""
    x, y, z = np.array([frame.T_world_camera[:3, 3] for frame in frames], np.float32).T
    return {
        "type": "scatter3d", "mode": "text", "name": "numbers of frames", "x": x, "y": y, "z": z, "hoverinfo": "skip",
        "text": [str(numbers[frame.name]) for frame in frames], "textfont": {"size": 11, "color": CAMERA_COLOUR},
    }  # fmt: skip
