"""The surface as an interactive plot that works without a network."""

import base64
import gzip
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.evaluation.report.colour_layers import ColourLayer
from sl_nerfstudio.evaluation.report.pictures import CLAY
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.open3d_core import open3d as o3d
from sl_nerfstudio.meshing.mesh import Mesh

MOST_TRIANGLES = 40_000  # about 1 MB in the page


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
        cell = float(np.sqrt(IndexedMesh(mesh).area / (2 * most))) / size
        plain = plain.simplify_vertex_clustering(cell, o3d.geometry.SimplificationContraction.Quadric)
    small = plain.simplify_quadric_decimation(most)
    vertices = np.asarray(small.vertices) * size + centre
    used = np.unique(mesh.faces)
    nearest = used[np.asarray(KDTree(mesh.vertices[used]).query(vertices)[1])]
    return Mesh(vertices, np.asarray(small.triangles).astype(np.int64)), nearest


def mesh_figure(mesh: Mesh, layers: Sequence[ColourLayer], poses: DevicePoses) -> str:
    """Plotly figure (JSON): the surface with cameras and projectors as dots, and a menu of what colours it.

    The first of the layers colours it at the start; without layers it is clay, and there is no menu.
    """
    import plotly.graph_objects as go

    small, nearest = decimated(mesh)
    x, y, z = small.vertices.astype(np.float32).T
    i, j, k = small.faces.astype(np.int32).T
    look: dict[str, Any] = {"color": f"rgb{tuple(int(255 * c) for c in CLAY)}", "hoverinfo": "skip"}
    if layers:
        look = _look(layers[0], nearest)
    figure = go.Figure(
        go.Mesh3d(
            x=x, y=y, z=z, i=i, j=j, k=k, name="surface", showlegend=False, flatshading=False,
            lighting={"ambient": 0.55, "diffuse": 0.6, "specular": 0.05, "roughness": 0.9}, **look,
        )
    )  # fmt: skip
    for name, T, colour, symbol in (
        ("cameras", poses.T_world_camera, "#2563a8", "circle"),
        ("projectors", poses.T_world_projector, "#c2571a", "diamond"),
    ):
        cx, cy, cz = T[:, :3, 3].T
        labels = [f"{name[:-1]} of frame {index}" for index in range(len(T))]
        figure.add_scatter3d(
            x=cx, y=cy, z=cz, mode="markers", name=name, visible="legendonly", text=labels, hoverinfo="text",
            marker={"size": 3, "color": colour, "symbol": symbol},
        )  # fmt: skip
    up = poses.T_world_camera[:, :3, 1].mean(0)
    eye = poses.T_world_camera[0, :3, 3] - small.vertices.mean(0)
    axis = {"visible": False}
    figure.update_layout(
        template="none", height=560, margin={"l": 0, "r": 0, "t": 0, "b": 0},
        scene={
            "xaxis": axis, "yaxis": axis, "zaxis": axis, "aspectmode": "data",
            "camera": {"up": _xyz(up), "eye": _xyz(eye)},
        },
        legend={"orientation": "h", "x": 0, "y": 0},
        font={"family": "inherit", "size": 12},
    )  # fmt: skip
    if len(layers) > 1:
        figure.update_layout(updatemenus=[_menu(layers, nearest)])
    return str(figure.to_json()).replace("<", "\\u003c")  # it goes into a <script> element


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
    return {"buttons": buttons, "x": 0, "xanchor": "left", "y": 1, "yanchor": "top", "bgcolor": "white"}


def _xyz(v: Float[ndarray, "3"]) -> dict[str, float]:
    length = float(np.linalg.norm(v)) or 1.0
    return {axis: 1.5 * float(value) / length for axis, value in zip("xyz", v, strict=True)}


def compressed_script() -> str:
    """Plotly's JavaScript, gzipped, in base64: a third of its size; the page decompresses it."""
    from plotly.offline import get_plotlyjs

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), 9, mtime=0)).decode()
