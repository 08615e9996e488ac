"""The 3D view of the report of `sl-process`: cameras, projectors and surfaces, one group of frames at a time."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from matplotlib import colormaps
from numpy import ndarray

from sl_nerfstudio.evaluation.report.view3d import (
    CAMERA_COLOUR,
    PROJECTOR_COLOUR,
    DrawnDevices,
    PlotBox,
    as_json,
    camera_buttons,
    frustum_length,
    menu,
    view_buttons,
    viewpoint,
)
from sl_nerfstudio.processing.placed import PlacedFrame, PlacedGroup

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
    """Where frames should be added: midway between two cameras, as far from the object, looking at it."""
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
