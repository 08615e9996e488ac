"""What a camera sees of a scene lit by a projector: exact correspondences, and the reflected light."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.pattern.image import sample_bilinear
from sl_nerfstudio.synthesis.appearance.plain import Appearance
from sl_nerfstudio.synthesis.devices import DevicePair, pixels, rays
from sl_nerfstudio.synthesis.ray_casting import RayCaster
from sl_nerfstudio.synthesis.scenes.scene import Scene


@dataclass(frozen=True)
class VisiblePoints:
    """The surface points at some camera pixels; points and pattern pixels are NaN where the object is not hit."""

    hit: Bool[ndarray, "n"]
    face: Int64[ndarray, "n"]
    p_world: Float64[ndarray, "n 3"]
    uv_projector: Float64[ndarray, "n 2"]
    lit: Bool[ndarray, "n"]  # hit, inside the pattern, and lit on the side that the camera sees


@dataclass(frozen=True)
class RenderedCapture:
    """One rendered frame, without any noise."""

    coords: Float32[ndarray, "h w 2"]  # exact at pixel centres; NaN outside the mask
    mask: Bool[ndarray, "h w"]
    object_mask: Bool[ndarray, "h w"]  # the object, lit or not, and not its surroundings
    radiance: Float32[ndarray, "h w"]  # 1 is a white surface facing the projector, in its full light


@dataclass(frozen=True)
class SampledView:
    """What rays through the pixels of a camera meet."""

    at_centres: VisiblePoints  # (h * w) pixels, row by row
    radiance: Float32[ndarray, "h w *c"]  # mean over each pixel

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the image."""
        return self.radiance.shape[0], self.radiance.shape[1]

    @property
    def mask(self) -> Bool[ndarray, "h w"]:
        """Pixels with coordinates."""
        return self.at_centres.lit.reshape(self.shape)

    @property
    def coords(self) -> Float32[ndarray, "h w 2"]:
        """Exact at pixel centres; NaN outside the mask."""
        coords = np.full((self.at_centres.lit.size, 2), np.nan, dtype=np.float32)
        coords[self.at_centres.lit] = self.at_centres.uv_projector[self.at_centres.lit]
        return coords.reshape(*self.shape, 2)


Light = Callable[[VisiblePoints, Int64[ndarray, "n"]], Float32[ndarray, "n *c"]]
"""Light that the points seen through some pixels (numbered row by row) send to the camera."""


def visible_points(
    caster: RayCaster,
    devices: DevicePair,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
    uv: Float[ndarray, "n 2"],
) -> VisiblePoints:
    """Cast rays through camera pixels `uv` onto the scene, and a shadow ray from the projector to every point found."""
    hits = caster.first_hits(T_world_camera[:3, 3], rays(devices.camera, T_world_camera, uv))
    hit = hits.face >= 0
    uv_projector = np.full(uv.shape, np.nan)
    lit = np.zeros(len(uv), dtype=bool)
    p, face = hits.p_world[hit], hits.face[hit]
    uv_projector[hit], inside = pixels(devices.projector, T_world_projector, p)
    normal = caster.scene.face_normals[face]
    same_side = ((T_world_camera[:3, 3] - p) * normal).sum(-1) * ((T_world_projector[:3, 3] - p) * normal).sum(-1) > 0
    reached = inside & same_side
    reached[reached] = caster.sees(T_world_projector[:3, 3], p[reached], face[reached])
    lit[hit] = reached
    return VisiblePoints(hit, hits.face, hits.p_world, uv_projector, lit)


def render_capture(
    caster: RayCaster,
    devices: DevicePair,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
    pattern: Float32[ndarray, "ph pw"],
    appearance: Appearance,
    supersampling: int = 2,
) -> RenderedCapture:
    """Render a frame: correspondences at pixel centres, light as the mean of `supersampling`^2 rays per pixel."""

    def light(seen: VisiblePoints, _: Int64[ndarray, "n"]) -> Float32[ndarray, "n"]:
        return _light(seen, caster.scene, devices, T_world_projector, pattern, appearance)

    nothing = np.float32(appearance.background)
    centres = visible_centres(caster, devices, T_world_camera, T_world_projector)
    view = sample_view(caster, devices, T_world_camera, T_world_projector, centres, light, nothing, supersampling)
    on_object = caster.on_object(centres.face).reshape(view.shape)
    return RenderedCapture(view.coords, view.mask, on_object, appearance.through_lens(view.radiance))


def visible_centres(
    caster: RayCaster,
    devices: DevicePair,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> VisiblePoints:
    """What the rays through all pixel centres meet, row by row."""
    n = devices.camera.w * devices.camera.h
    box = np.flatnonzero(_box_of_the_scene(caster.scene, devices, T_world_camera))
    uv = _corners(devices)[box] + 0.5
    found = visible_points(caster, devices, T_world_camera, T_world_projector, uv)
    hit, lit = np.zeros((2, n), dtype=bool)
    face, p_world, uv_projector = np.full(n, -1), np.full((n, 3), np.nan), np.full((n, 2), np.nan)
    hit[box], lit[box], face[box] = found.hit, found.lit, found.face
    p_world[box], uv_projector[box] = found.p_world, found.uv_projector
    return VisiblePoints(hit, face, p_world, uv_projector, lit)


def sample_view(
    caster: RayCaster,
    devices: DevicePair,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
    centres: VisiblePoints,
    light: Light,
    nothing: Float32[ndarray, "*c"] | np.float32,
    supersampling: int,
) -> SampledView:
    """Light as the mean of `supersampling`^2 rays per pixel; `nothing` is what is seen where no surface is."""
    w, h = devices.camera.w, devices.camera.h
    corner = _corners(devices)
    radiance = np.empty((h * w, *np.shape(nothing)), dtype=np.float32)
    radiance[:] = nothing
    near = np.flatnonzero(_near_a_hit(centres.hit.reshape(h, w)))
    total = np.zeros((len(near), *np.shape(nothing)), dtype=np.float32)
    step = (np.arange(supersampling) + 0.5) / supersampling
    for dy in step:
        for dx in step:
            seen = visible_points(caster, devices, T_world_camera, T_world_projector, corner[near] + (dx, dy))
            total += light(seen, near)
    radiance[near] = total / supersampling**2
    return SampledView(centres, radiance.reshape(h, w, *np.shape(nothing)))


def _corners(devices: DevicePair) -> Int64[ndarray, "n 2"]:
    """Upper left corners (x, y) of all pixels, row by row."""
    w, h = devices.camera.w, devices.camera.h
    return np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2)


def _box_of_the_scene(scene: Scene, devices: DevicePair, T_world_camera: Float[ndarray, "4 4"]) -> Bool[ndarray, "h w"]:
    """Pixels that may see a surface: a rectangle around its vertices, or all if some are behind the camera."""
    camera = devices.camera
    uv, _ = pixels(camera, T_world_camera, scene.vertices)
    depth = -(scene.vertices - T_world_camera[:3, 3]) @ T_world_camera[:3, 2]
    box = np.zeros((camera.h, camera.w), dtype=bool)
    if depth.min() <= 0 or camera.k1 or camera.k2 or camera.p1 or camera.p2:
        return ~box  # behind the camera, or edges bent by distortion
    (x0, y0), (x1, y1) = np.clip(np.floor(uv.min(0)) - 1, 0, None).astype(int), np.ceil(uv.max(0)).astype(int) + 1
    box[y0:y1, x0:x1] = True
    return box


def _near_a_hit(hit: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Pixels with a ray that may hit a surface, even if the ray through their centre does not."""
    padded = np.pad(hit, 1)
    h, w = hit.shape
    return np.logical_or.reduce([padded[i : i + h, j : j + w] for i in range(3) for j in range(3)])


def _light(
    seen: VisiblePoints,
    scene: Scene,
    devices: DevicePair,
    T_world_projector: Float[ndarray, "4 4"],
    pattern: Float32[ndarray, "ph pw"],
    appearance: Appearance,
) -> Float32[ndarray, "n"]:
    """Light reflected by a matte surface: from the projector (cosine and inverse-square law) and from the room."""
    out = np.full(len(seen.hit), appearance.background, dtype=np.float32)
    p = seen.p_world[seen.hit]
    normal = shading_normals(scene, seen.face[seen.hit], p).astype(np.float32)
    light = appearance.ambient(normal)
    lit = seen.lit[seen.hit]
    uv = seen.uv_projector[seen.hit][lit]
    to_projector = T_world_projector[:3, 3] - p[lit]
    distance2 = (to_projector**2).sum(-1)
    cosine = np.abs((to_projector * normal[lit]).sum(-1)) / np.sqrt(distance2)
    strength = appearance.projector_fall_off(uv, devices.projector) * appearance.reference_distance**2 / distance2
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
