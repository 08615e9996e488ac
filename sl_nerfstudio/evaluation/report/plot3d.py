"""The surface as an interactive plot that works without a network."""

import base64
import gzip
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.evaluation.report.colour_layers import ColourLayer
from sl_nerfstudio.evaluation.report.pictures import CLAY
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
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.open3d_core import open3d as o3d
from sl_nerfstudio.meshing.mesh import Mesh

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
