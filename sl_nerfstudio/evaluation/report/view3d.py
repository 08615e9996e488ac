"""What the interactive views share: a box of equal scale in all directions, viewpoints, and devices as pyramids."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.frustum import OUTLINE, frustum
from sl_nerfstudio.geometry.viewpoint import Viewpoint, beside, far_enough

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
    """From where all points are in the picture, beside the first of the cameras; up is the cameras' up."""
    up = T_world_camera[:, :3, 1].mean(0)
    if np.linalg.norm(up) < 0.1:  # cameras held in every orientation
        up = T_world_camera[0, :3, 1]
    towards = T_world_camera[0, :3, 3] - centre
    direction = beside(towards if np.linalg.norm(towards) > 0 else T_world_camera[0, :3, 2], up)
    return far_enough(points, centre, direction, up / np.linalg.norm(up), _FIELD_OF_VIEW, _ASPECT)


def frustum_length(T_world_device: Float64[ndarray, "n 4 4"], centre: Float64[ndarray, "3"]) -> float:
    """How long to draw the pyramids of some devices around an object."""
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
