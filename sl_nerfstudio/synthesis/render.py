"""What a camera sees of a scene under a projector: exact correspondences, and the light that comes back."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.pattern.image import sample_bilinear
from sl_nerfstudio.synthesis.appearance import Appearance
from sl_nerfstudio.synthesis.devices import Pair, pixels, rays
from sl_nerfstudio.synthesis.ray_casting import Caster
from sl_nerfstudio.synthesis.scene import Scene


@dataclass(frozen=True)
class Sight:
    """What lies behind a set of camera pixels; points and pixels are NaN where the object is not hit."""

    hit: Bool[ndarray, "n"]
    face: Int64[ndarray, "n"]
    p_world: Float64[ndarray, "n 3"]
    uv_projector: Float64[ndarray, "n 2"]
    lit: Bool[ndarray, "n"]  # hit, inside the pattern, and seen by the projector from the camera's side of the surface


@dataclass(frozen=True)
class Capture:
    """One rendered frame, without any noise."""

    coords: Float32[ndarray, "h w 2"]  # exact at pixel centres; NaN outside the mask
    mask: Bool[ndarray, "h w"]
    radiance: Float32[ndarray, "h w"]  # 1 is a white, perpendicular surface in the full light of the projector


def look(
    caster: Caster,
    devices: Pair,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
    uv: Float[ndarray, "n 2"],
) -> Sight:
    """Cast camera pixels `uv` at the scene, and a shadow ray from the projector to every point found."""
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
    return Sight(hit, hits.face, hits.p_world, uv_projector, lit)


def capture(
    caster: Caster,
    devices: Pair,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
    pattern: Float32[ndarray, "ph pw"],
    appearance: Appearance,
    supersampling: int = 2,
) -> Capture:
    """Render a frame: correspondences at pixel centres, light as the mean of `supersampling`^2 rays a pixel."""
    w, h = devices.camera.w, devices.camera.h
    corner = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2)
    coords = np.full((h * w, 2), np.nan, dtype=np.float32)
    mask, hit = np.zeros((2, h * w), dtype=bool)
    box = _box_of_the_object(caster.scene, devices, T_world_camera).reshape(-1)
    at_centres = look(caster, devices, T_world_camera, T_world_projector, corner[box] + 0.5)
    mask[box], hit[box] = at_centres.lit, at_centres.hit
    coords[mask] = at_centres.uv_projector[at_centres.lit]
    radiance = np.full(h * w, appearance.background, dtype=np.float32)
    near = _near_the_object(hit.reshape(h, w)).reshape(-1)
    light = np.zeros(int(near.sum()), dtype=np.float32)
    step = (np.arange(supersampling) + 0.5) / supersampling
    for dy in step:
        for dx in step:
            sight = look(caster, devices, T_world_camera, T_world_projector, corner[near] + (dx, dy))
            light += _light(sight, caster.scene, devices, T_world_projector, pattern, appearance)
    radiance[near] = light / supersampling**2
    return Capture(coords.reshape(h, w, 2), mask.reshape(h, w), appearance.through_lens(radiance.reshape(h, w)))


def _box_of_the_object(scene: Scene, devices: Pair, T_world_camera: Float[ndarray, "4 4"]) -> Bool[ndarray, "h w"]:
    """Pixels that may see the object: a rectangle around its vertices; the whole image if some lie behind."""
    camera = devices.camera
    uv, _ = pixels(camera, T_world_camera, scene.vertices)
    depth = -(scene.vertices - T_world_camera[:3, 3]) @ T_world_camera[:3, 2]
    box = np.zeros((camera.h, camera.w), dtype=bool)
    if depth.min() <= 0 or camera.k1 or camera.k2 or camera.p1 or camera.p2:
        return ~box  # behind the camera, or bent edges
    (x0, y0), (x1, y1) = np.clip(np.floor(uv.min(0)) - 1, 0, None).astype(int), np.ceil(uv.max(0)).astype(int) + 1
    box[y0:y1, x0:x1] = True
    return box


def _near_the_object(hit: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Pixels whose rays may meet the object although the one through the centre does not, and those that do."""
    padded = np.pad(hit, 1)
    h, w = hit.shape
    return np.logical_or.reduce([padded[i : i + h, j : j + w] for i in range(3) for j in range(3)])


def _light(
    sight: Sight,
    scene: Scene,
    devices: Pair,
    T_world_projector: Float[ndarray, "4 4"],
    pattern: Float32[ndarray, "ph pw"],
    appearance: Appearance,
) -> Float32[ndarray, "n"]:
    """Light of a matte surface: the projector's by the cosine and distance laws, and the room's."""
    out = np.full(len(sight.hit), appearance.background, dtype=np.float32)
    p = sight.p_world[sight.hit]
    normal = _shading_normals(scene, sight.face[sight.hit], p).astype(np.float32)
    light = appearance.ambient(normal)
    lit = sight.lit[sight.hit]
    uv = sight.uv_projector[sight.hit][lit]
    to_projector = T_world_projector[:3, 3] - p[lit]
    distance2 = (to_projector**2).sum(-1)
    cosine = np.abs((to_projector * normal[lit]).sum(-1)) / np.sqrt(distance2)
    strength = appearance.projector_fall_off(uv, devices.projector) * appearance.reference_distance**2 / distance2
    light[lit] += (appearance.projected(sample_bilinear(pattern, uv)) * cosine * strength).astype(np.float32)
    out[sight.hit] = light * appearance.albedo(p)
    return out


def _shading_normals(scene: Scene, face: Int64[ndarray, "n"], p: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
    """Normals interpolated between the vertices, where the scene has them; else those of the faces."""
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
