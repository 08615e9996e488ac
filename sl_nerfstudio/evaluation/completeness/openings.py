"""Openings of a mesh: where its surface ends. Every real object is closed, so behind each of them something lacks."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from sl_nerfstudio.geometry.connectivity import component_labels
from sl_nerfstudio.meshing.mesh import Mesh

_SMOOTHING = 8  # steps, each over one edge: jags are one edge wide


@dataclass(frozen=True)
class Openings:
    """The connected borders of a mesh, the largest area first; lengths in the mesh's unit."""

    area: Float[ndarray, "n"]  # as seen along the normal
    length: Float[ndarray, "n"]  # of the border, smoothed: triangles make it jagged
    centre: Float[ndarray, "n 3"]
    normal: Float[ndarray, "n 3"]  # unit, outward: where somebody stands who looks into the opening
    fan: Float[ndarray, "m 3 3"]  # corners of all closing triangles, counter-clockwise as seen from outside
    opening: Int[ndarray, "m"]  # of each closing triangle

    def __len__(self) -> int:
        return len(self.area)

    def closing_mesh(self) -> Mesh:
        """The closing triangles, in the order of `fan`."""
        corners = self.fan.reshape(-1, 3)
        return Mesh(corners, np.arange(len(corners)).reshape(-1, 3))


def find_openings(mesh: Mesh) -> Openings:
    """All borders of the mesh; those that meet in a vertex count as one."""
    start, end = _border(mesh)
    label = component_labels(start, end, len(mesh.vertices))[start]
    _, label = np.unique(label, return_inverse=True)
    count = int(label.max()) + 1 if len(label) else 0
    a, b = mesh.vertices[start], mesh.vertices[end]
    edge = np.linalg.norm(b - a, axis=1)
    total = np.maximum(np.bincount(label, edge, count), 1e-300)
    centre = _sums(label, (a + b) / 2 * edge[:, None], count) / total[:, None]
    fan = np.stack([b, a, centre[label]], 1)  # against the direction of the faces beside the border
    cross = np.cross(fan[:, 1] - fan[:, 0], fan[:, 2] - fan[:, 0]) / 2
    normal = _sums(label, cross, count)
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-300)[:, None]
    order = np.argsort(-area, kind="stable")
    rank = np.argsort(order)
    smooth = _smoothed(mesh.vertices, start, end)
    length = np.bincount(label, np.linalg.norm(smooth[end] - smooth[start], axis=1), count).astype(np.float64)
    return Openings(area[order], length[order], centre[order], normal[order], fan, rank[label])


def _border(mesh: Mesh) -> tuple[Int[ndarray, "e"], Int[ndarray, "e"]]:
    """Edges of one triangle only, in the direction of its corners."""
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, which, uses = np.unique(low * len(mesh.vertices) + high, return_inverse=True, return_counts=True)
    single = uses[which] == 1
    return start[single], end[single]


def _smoothed(
    vertices: Float[ndarray, "v 3"], start: Int[ndarray, "e"], end: Int[ndarray, "e"]
) -> Float[ndarray, "v 3"]:
    """Vertices on borders, each moved to the middle of its neighbours along the border, a few times."""
    count = np.bincount(np.concatenate([start, end]), minlength=len(vertices))
    some = count > 0
    out = vertices.copy()
    for _ in range(_SMOOTHING):
        sums = _sums(np.concatenate([start, end]), np.concatenate([out[end], out[start]]), len(vertices))
        out[some] = 0.5 * (out[some] + sums[some] / count[some, None])
    return out


def _sums(label: Int[ndarray, "e"], values: Float[ndarray, "e 3"], count: int) -> Float[ndarray, "n 3"]:
    return np.stack([np.bincount(label, values[:, k], count) for k in range(3)], 1).astype(np.float64)
