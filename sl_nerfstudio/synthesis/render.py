"""Rendering of a scene lit by a projector: surroundings, ray casting, correspondences, reflected light."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64
from numpy import ndarray
from scipy.ndimage import binary_dilation

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.pattern.grid import sample_bilinear
from sl_nerfstudio.synthesis.appearance import Appearance, corner_fall_off
from sl_nerfstudio.synthesis.devices import DevicePair, pixels, rays
from sl_nerfstudio.synthesis.sdf import Scene

# What an object stands on and among: a table, and upright boards and boxes behind the object.

Background = Literal["none", "table", "walls"]
_LOWEST_ELEVATION, _HIGHEST_AT_LEAST = 26.0, 48.0  # degrees: the devices stay above the table
_TABLE_HALF_SIDE = (1.7, 2.6)  # in sizes of the object: a little more than the image shows
_TABLE_THICKNESS = 0.15
_GAP = 1e-4  # below the object, in its sizes: surfaces in one place would hide each other at random
_DISTANCE = (0.85, 1.7)  # of boards and boxes from the object's middle
_CLEARANCE = 0.8  # of the height at which the lowest cameras look over a board to the object's middle


def make_surroundings(scene: Scene, background: Background, rng: np.random.Generator) -> Scene | None:
    """Table, or table and two or three boards or boxes at random places around the object; None for "none"."""
    if background == "none":
        return None
    parts = [_table(scene, rng)]
    if background == "walls":
        number = int(rng.integers(2, 4))
        azimuth = rng.uniform(0, 2 * np.pi) + (np.arange(number) + rng.uniform(-0.3, 0.3, number)) * 2 * np.pi / number
        parts += [_board(scene, float(a), rng) for a in azimuth]
    return _faceted("surroundings", np.concatenate(parts))


def _faceted(name: str, corners: Float[ndarray, "f 3 3"]) -> Scene:
    """Triangles whose corners have the normal of their face, so that shading keeps the edges sharp."""
    scene = Scene(name, corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    return replace(scene, vertex_normals=np.repeat(scene.face_normals, 3, axis=0))


def above_the_table(scene: Scene) -> Scene:
    """The object, looked at only from elevations at which neither device dips below the table."""
    low, high = scene.elevation_deg
    bounds = (max(low, _LOWEST_ELEVATION), max(high, _HIGHEST_AT_LEAST))
    return replace(scene, elevation_deg=bounds)


def joined(scene: Scene, surroundings: Scene) -> Scene:
    """Both as one mesh; the faces of the object come first."""
    normals = None
    if scene.vertex_normals is not None and surroundings.vertex_normals is not None:
        normals = np.concatenate([scene.vertex_normals, surroundings.vertex_normals])
    return Scene(
        scene.name,
        np.concatenate([scene.vertices, surroundings.vertices]),
        np.concatenate([scene.faces, surroundings.faces + len(scene.vertices)]),
        normals,
        scene.elevation_deg,
    )


def _table(scene: Scene, rng: np.random.Generator) -> Float[ndarray, "12 3 3"]:
    """A turned slab below the object, not quite in the middle."""
    half = scene.size * rng.uniform(*_TABLE_HALF_SIDE, 2)
    thickness = _TABLE_THICKNESS * scene.size
    shift = scene.size * rng.uniform(-0.2, 0.2, 2)
    top = scene.vertices[:, 2].min() - _GAP * scene.size
    centre = np.array([scene.centre[0] + shift[0], scene.centre[1] + shift[1], top - thickness / 2])
    return _box(centre, np.array([half[0], half[1], thickness / 2]), rng.uniform(0, np.pi))


def _board(scene: Scene, azimuth: float, rng: np.random.Generator) -> Float[ndarray, "12 3 3"]:
    """A board or a box that stands on the table, low enough to look over it, turned roughly to the object."""
    thickness = rng.choice([0.03, rng.uniform(0.2, 0.5)])
    half_width = rng.uniform(0.25, 0.9)
    bottom = scene.vertices[:, 2].min() - _GAP * scene.size
    # no part of it may reach into the object, whatever the outline of both
    nearest = (
        np.linalg.norm(scene.vertices[:, :2] - scene.centre[:2], axis=1).max() + (0.15 + thickness / 2) * scene.size
    )
    distance = max(nearest, scene.size * rng.uniform(*_DISTANCE))
    look_over = scene.centre[2] - bottom + distance * np.tan(np.radians(scene.elevation_deg[0]))
    height = _CLEARANCE * look_over * rng.uniform(0.5, 1.0)
    direction = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    centre = np.array([scene.centre[0], scene.centre[1], bottom + height / 2]) + distance * direction
    half = np.array([scene.size * thickness / 2, scene.size * half_width, height / 2])
    return _box(centre, half, azimuth + np.radians(rng.uniform(-25, 25)))


def _box(centre: Float[ndarray, "3"], half: Float[ndarray, "3"], turn: float) -> Float[ndarray, "12 3 3"]:
    """Corners of the triangles of a cuboid, rotated about the vertical; seen from outside counter-clockwise."""
    triangles = []
    for axis in range(3):
        u, v = np.roll(np.eye(3), axis, axis=1)[1:]
        n = np.roll(np.eye(3), axis, axis=1)[0]
        for sign in (1.0, -1.0):
            a, b, c, d = (sign * n + s * sign * u + t * v for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
            triangles += [[a, b, c], [a, c, d]]
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return centre + np.array(triangles) * half @ R.T


# First hits of rays on a mesh: found by open3d in single precision, refined in double precision.

_SAME_POINT = 2e-5  # of the distance: a hit this close to a point is the point


class RayCaster:
    """Casts rays at an object and its surroundings; lengths in millimetres."""

    def __init__(self, scene: Scene, surroundings: Scene | None = None) -> None:
        """Build the search tree of one mesh; in `self.scene` the object's faces come before its surroundings'."""
        from sl_nerfstudio.late_imports import open3d as o3d

        self._object_faces = len(scene.faces)
        scene = scene if surroundings is None else joined(scene, surroundings)
        self.scene = scene
        self._tensor = o3d.core.Tensor
        self._tree = o3d.t.geometry.RaycastingScene()
        self._tree.add_triangles(
            o3d.core.Tensor(scene.vertices.astype(np.float32)), o3d.core.Tensor(scene.faces.astype(np.uint32))
        )

    def on_object(self, face: Int[ndarray, "n"]) -> Bool[ndarray, "n"]:
        """Whether faces belong to the object; false for surroundings, and where nothing is hit."""
        return (face >= 0) & (face < self._object_faces)

    def first_hits(
        self, origin: Float[ndarray, "3"], direction: Float[ndarray, "n 3"]
    ) -> tuple[Int64[ndarray, "n"], Float64[ndarray, "n 3"]]:
        """Faces and points of the first hits of unit rays from one place; -1 and NaN where there is none.

        open3d finds the face; the point on its plane is computed in double precision.
        """
        face, _ = self._cast(origin, direction)
        p_world = np.full(direction.shape, np.nan)
        hit = face >= 0
        normal = self.scene.face_normals[face[hit]]
        corner = self.scene.vertices[self.scene.faces[face[hit], 0]]
        along = ((corner - origin) * normal).sum(-1) / (direction[hit] * normal).sum(-1)
        p_world[hit] = origin + along[:, None] * direction[hit]
        return face, p_world

    def sees(
        self, origin: Float[ndarray, "3"], p_world: Float[ndarray, "n 3"], face: Int[ndarray, "n"]
    ) -> Bool[ndarray, "n"]:
        """Whether nothing is between `origin` and points on the given faces."""
        ray = p_world - origin
        distance = np.linalg.norm(ray, axis=-1)
        seen_face, seen_distance = self._cast(origin, ray / distance[:, None])
        return (seen_face == face) | (seen_distance >= distance * (1 - _SAME_POINT))

    def _cast(
        self, origin: Float[ndarray, "3"], direction: Float[ndarray, "n 3"]
    ) -> tuple[Int64[ndarray, "n"], Float64[ndarray, "n"]]:
        rays = np.empty((len(direction), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origin, direction
        answer = self._tree.cast_rays(self._tensor(rays))
        face = answer["primitive_ids"].numpy().astype(np.int64)
        distance = answer["t_hit"].numpy().astype(np.float64)
        return np.where(np.isfinite(distance), face, -1), distance


@dataclass(frozen=True)
class FrameGeometry:
    """Devices and surfaces of one frame, with their poses."""

    caster: RayCaster
    devices: DevicePair
    T_world_camera: Float[ndarray, "4 4"]
    T_world_projector: Float[ndarray, "4 4"]


@dataclass(frozen=True)
class VisiblePoints:
    """The surface points at some camera pixels; points and pattern pixels are NaN where the object is not hit."""

    hit: Bool[ndarray, "n"]
    face: Int64[ndarray, "n"]
    p_world: Float64[ndarray, "n 3"]
    uv_projector: Float64[ndarray, "n 2"]
    lit: Bool[ndarray, "n"]  # hit, inside the pattern, and lit on the side that the camera sees

    def coords(self, camera: Device) -> Float32[ndarray, "h w 2"]:
        """Pattern pixels seen through all pixels of a camera, row by row; NaN where no light falls."""
        lit = np.where(self.lit[:, None], self.uv_projector, np.nan)
        return lit.astype(np.float32).reshape(camera.h, camera.w, 2)


@dataclass(frozen=True)
class RenderedCapture:
    """One rendered frame, without any noise."""

    coords: Float32[ndarray, "h w 2"]  # exact at pixel centres; NaN outside the mask
    mask: Bool[ndarray, "h w"]
    object_mask: Bool[ndarray, "h w"]  # the object, lit or not, and not its surroundings
    radiance: Float32[ndarray, "h w *c"]  # mean over each pixel; 1: a white surface in the projector's full light


Light = Callable[[VisiblePoints, Int64[ndarray, "n"]], Float32[ndarray, "n *c"]]
"""Light that the points seen through some pixels (numbered row by row) send to the camera."""


def visible_points(frame: FrameGeometry, uv: Float[ndarray, "n 2"]) -> VisiblePoints:
    """Cast rays through camera pixels `uv` onto the scene, and a shadow ray from the projector to every point found."""
    caster, eye, lamp = frame.caster, frame.T_world_camera[:3, 3], frame.T_world_projector[:3, 3]
    all_faces, p_world = caster.first_hits(eye, rays(frame.devices.camera, frame.T_world_camera, uv))
    hit = all_faces >= 0
    uv_projector = np.full(uv.shape, np.nan)
    lit = np.zeros(len(uv), dtype=bool)
    p, face = p_world[hit], all_faces[hit]
    uv_projector[hit], inside = pixels(frame.devices.projector, frame.T_world_projector, p)
    normal = caster.scene.face_normals[face]
    same_side = ((eye - p) * normal).sum(-1) * ((lamp - p) * normal).sum(-1) > 0
    reached = inside & same_side
    reached[reached] = caster.sees(lamp, p[reached], face[reached])
    lit[hit] = reached
    return VisiblePoints(hit, all_faces, p_world, uv_projector, lit)


def render_capture(
    frame: FrameGeometry, pattern: Float32[ndarray, "ph pw"], appearance: Appearance, supersampling: int = 2
) -> RenderedCapture:
    """Render a frame: correspondences at pixel centres, light as the mean of `supersampling`^2 rays per pixel."""

    def light(seen: VisiblePoints, _: Int64[ndarray, "n"]) -> Float32[ndarray, "n"]:
        return _light(seen, frame, pattern, appearance)

    centres = visible_centres(frame)
    view = sample_view(frame, centres, light, np.float32(appearance.background), supersampling)
    return replace(view, radiance=appearance.through_lens(view.radiance))


def visible_centres(frame: FrameGeometry) -> VisiblePoints:
    """Trace the rays through all pixel centres, row by row."""
    return visible_points(frame, _corners(frame.devices.camera) + 0.5)


def sample_view(
    frame: FrameGeometry,
    centres: VisiblePoints,
    light: Light,
    nothing: Float32[ndarray, "*c"] | np.float32,
    supersampling: int,
) -> RenderedCapture:
    """Light as the mean of `supersampling`^2 rays per pixel; `nothing` is what is seen where no surface is."""
    w, h = frame.devices.camera.w, frame.devices.camera.h
    corner = _corners(frame.devices.camera)
    radiance = np.empty((h * w, *np.shape(nothing)), dtype=np.float32)
    radiance[:] = nothing
    # rays beside a pixel's centre may hit a surface that the one through it misses
    near = np.flatnonzero(binary_dilation(centres.hit.reshape(h, w), np.ones((3, 3))))
    total = np.zeros((len(near), *np.shape(nothing)), dtype=np.float32)
    step = (np.arange(supersampling) + 0.5) / supersampling
    for dy in step:
        for dx in step:
            total += light(visible_points(frame, corner[near] + (dx, dy)), near)
    radiance[near] = total / supersampling**2
    on_object = frame.caster.on_object(centres.face)
    return RenderedCapture(
        centres.coords(frame.devices.camera),
        centres.lit.reshape(h, w),
        on_object.reshape(h, w),
        radiance.reshape(h, w, *np.shape(nothing)),
    )


def _corners(camera: Device) -> Int64[ndarray, "n 2"]:
    """Upper left corners (x, y) of all pixels, row by row."""
    return np.stack(np.meshgrid(np.arange(camera.w), np.arange(camera.h)), -1).reshape(-1, 2)


def _light(
    seen: VisiblePoints, frame: FrameGeometry, pattern: Float32[ndarray, "ph pw"], appearance: Appearance
) -> Float32[ndarray, "n"]:
    """Light reflected by a matte surface: from the projector (cosine and inverse-square law) and from the room."""
    out = np.full(len(seen.hit), appearance.background, dtype=np.float32)
    p = seen.p_world[seen.hit]
    normal = shading_normals(frame.caster.scene, seen.face[seen.hit], p).astype(np.float32)
    light = appearance.ambient(normal)
    lit = seen.lit[seen.hit]
    uv = seen.uv_projector[seen.hit][lit]
    to_projector = frame.T_world_projector[:3, 3] - p[lit]
    distance2 = (to_projector**2).sum(-1)
    cosine = np.abs((to_projector * normal[lit]).sum(-1)) / np.sqrt(distance2)
    fall_off = corner_fall_off(uv, frame.devices.projector, appearance.corner_loss)
    strength = fall_off * appearance.reference_distance**2 / distance2
    light[lit] += (appearance.projected(sample_bilinear(pattern, uv)) * cosine * strength).astype(np.float32)
    out[seen.hit] = light * appearance.albedo(p)
    return out


def shading_normals(scene: Scene, face: Int64[ndarray, "n"], p: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
    """Normals interpolated between the vertices if the scene has them, else those of the faces."""
    if scene.vertex_normals is None:
        return scene.face_normals[face]
    corners = scene.faces[face]
    a, b, c = (scene.vertices[corners[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    area2 = np.maximum((flat * flat).sum(-1), 1e-300)
    wb = (np.cross(p - a, c - a) * flat).sum(-1) / area2
    wc = (np.cross(b - a, p - a) * flat).sum(-1) / area2
    weights = np.stack([1 - wb - wc, wb, wc], -1)
    normal = (weights[..., None] * scene.vertex_normals[corners]).sum(1)
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
