"""Triangle meshes, what is known about their vertices, and their textures."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64, UInt8
from numpy import ndarray

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.geometry.numerics import component_labels


@dataclass(frozen=True)
class Mesh:
    """Triangles, counter-clockwise as seen from outside."""

    vertices: Float64[ndarray, "v 3"]
    faces: Int64[ndarray, "f 3"]

    def mapped(self, S_a_b: Similarity) -> "Mesh":
        """The mesh of frame b in frame a."""
        return Mesh(S_a_b.points(self.vertices), self.faces)

    def with_faces(self, keep: Bool[ndarray, "f"]) -> "Mesh":
        """The chosen triangles, with the vertices that they use."""
        used = self.corners_of(keep)
        return Mesh(self.vertices[used], (np.cumsum(used) - 1)[self.faces[keep]])

    def corners_of(self, chosen: Bool[ndarray, "f"]) -> Bool[ndarray, "v"]:
        """The vertices that some of the chosen triangles use."""
        used = np.zeros(len(self.vertices), dtype=bool)
        used[self.faces[chosen]] = True
        return used

    def bounds(self) -> tuple[Float64[ndarray, "3"], Float64[ndarray, "3"]]:
        """Lowest and highest corner of the box around the vertices that triangles use; there must be one."""
        used = self.used_vertices()
        return used.min(0), used.max(0)

    def used_vertices(self) -> Float64[ndarray, "used 3"]:
        """The vertices that triangles use."""
        return self.vertices[self.corners_of(np.ones(len(self.faces), dtype=bool))]

    def edges(self) -> Int64[ndarray, "e 2"]:
        """The three sides of every triangle, in its direction: inner edges occur twice."""
        return np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]])

    def is_closed(self) -> bool:
        """Whether every edge joins exactly two triangles, which run along it in opposite directions."""
        a, b = self.edges().T
        there, count = np.unique(a * len(self.vertices) + b, return_counts=True)
        back = np.unique(b * len(self.vertices) + a)
        return bool((count == 1).all() and np.array_equal(there, back))

    def component_of_faces(self) -> Int64[ndarray, "f"]:
        """Number of the connected piece, from 0, that each triangle lies in; pieces share no edge, at most corners."""
        edges = np.sort(self.edges(), axis=1)
        _, edge = np.unique(edges, axis=0, return_inverse=True)
        triangle = np.tile(np.arange(len(self.faces)), 3)
        nodes = len(self.faces) + len(edges)
        label = component_labels(triangle, len(self.faces) + edge.reshape(-1), nodes)[: len(self.faces)]
        return np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int64)

    def vertex_normals(self) -> Float64[ndarray, "v 3"]:
        """Unit normals, outward, weighted by area; zero where a vertex has no triangle with an area."""
        return self._normals.copy()

    @cached_property
    def _normals(self) -> Float64[ndarray, "v 3"]:
        corner, count = self.faces.ravel(), len(self.vertices)
        out = np.stack([np.bincount(corner, np.repeat(values, 3), count) for values in self.face_cross().T], -1)
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return out / np.where(length > 0, length, 1.0)

    def face_cross(self) -> Float64[ndarray, "f 3"]:
        """Twice the area times the unit normal of each triangle."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return np.cross(b - a, c - a)

    def face_areas(self) -> Float64[ndarray, "f"]:
        """Area of each triangle."""
        return np.linalg.norm(self.face_cross(), axis=1) / 2

    def edge_length(self) -> float:
        """Median length of an edge: the resolution of the mesh."""
        a, b = self.vertices[self.faces[:, 0]], self.vertices[self.faces[:, 1]]
        return float(np.median(np.linalg.norm(a - b, axis=1))) if len(self.faces) else 0.0


def ray_scene(vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "f 3"]) -> Any:
    """open3d's search tree over triangles, in single precision: lengths should be about 1. Threads may share it."""
    from sl_nerfstudio.late_imports import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32)))
    scene.cast_rays(o3d.core.Tensor(np.zeros((1, 6), np.float32)))  # makes the tree
    return scene


# What is known about each vertex of a mesh.


@dataclass(frozen=True)
class VertexQuality:
    """Quality of every vertex; lengths in the scan's unit. NaN where no frame confirms the vertex."""

    sigma: Float64[ndarray, "v"]  # 1 sigma along the normal
    sigma_independent: Float64[ndarray, "v"]  # the part that distant vertices do not share
    views: Int64[ndarray, "v"]  # frames that saw, lit and confirmed it; 0: invented or interpolated surface
    residual: Float64[ndarray, "v"]  # mean distance of predicted and decoded coordinates, projector pixels
    ray_angle: Float64[ndarray, "v"]  # largest angle between camera ray and projector ray, degrees


# Everything that is written with a vertex beside its place.

GREY = 128
"""Colour of vertices that no capture shows."""


def as_linear(rgb: Float[ndarray, "*n"]) -> Float64[ndarray, "*n"]:
    """sRGB in [0, 1] as linear light."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def as_srgb(light: Float64[ndarray, "*n"]) -> Float64[ndarray, "*n"]:
    """Linear light as sRGB in [0, 1]."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


@dataclass(frozen=True)
class VertexProperties:
    """Properties of every vertex of a mesh."""

    quality: VertexQuality
    invented: Bool[ndarray, "v"]  # no frame observed the surface there: it is the field's own continuation
    colour: UInt8[ndarray, "v 3"] | None = None  # sRGB; None: no frame was also captured without the pattern

    def chosen(self, index: Int[ndarray, "n"] | Bool[ndarray, "v"]) -> "VertexProperties":
        """Properties of the chosen vertices, in that order."""
        quality = VertexQuality(**{name: values[index] for name, values in vars(self.quality).items()})
        return VertexProperties(quality, self.invented[index], None if self.colour is None else self.colour[index])

    def moved(self, distance: Float[ndarray, "v"]) -> "VertexProperties":
        """Add the distance by which vertices were moved away from the surface to their uncertainty."""
        q = self.quality
        sigma, independent = (np.hypot(values, distance) for values in (q.sigma, q.sigma_independent))
        return replace(self, quality=replace(q, sigma=sigma, sigma_independent=independent))


# What a textured mesh has beside its triangles.


@dataclass(frozen=True)
class Charts:
    """A mesh laid out flat in pieces: a vertex has one corner for each of the charts that it belongs to."""

    corners: Int64[ndarray, "f 3"]  # of each triangle
    uv: Float32[ndarray, "c 2"]  # of each corner, in [0, 1]: to the right, and down
    vertex: Int64[ndarray, "c"]  # of each corner
    count: int  # charts


@dataclass(frozen=True)
class Texture:
    """Texture coordinates of a mesh's triangles, and the image they refer to."""

    charts: Charts
    image: UInt8[ndarray, "n n 3"]  # sRGB; its first row is at v = 0
