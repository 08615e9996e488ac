"""A capture as a colour camera takes it: materials, defocus, interreflection, room light, lens, sensor, JPEG."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from numpy import ndarray

from sl_nerfstudio.synthesis.appearance.interreflection import SmallLamps, interpolate_vectors, light_vectors
from sl_nerfstudio.synthesis.appearance.lens import moved
from sl_nerfstudio.synthesis.appearance.look import Look
from sl_nerfstudio.synthesis.appearance.sensor import Sensor, decode_jpeg
from sl_nerfstudio.synthesis.capture_plan import Shot
from sl_nerfstudio.synthesis.devices import DevicePair, rays
from sl_nerfstudio.synthesis.ray_casting import RayCaster
from sl_nerfstudio.synthesis.render import VisiblePoints, sample_view, shading_normals, visible_centres

_LAMPS_ACROSS = 16  # small lamps along each side of the pattern
_GATHERED_ACROSS = 50  # pixels along each side of the image where bounced light is gathered
_LIFT = 1e-4  # of the scene, that shadow rays to the room's lamp start above a surface
_FAR = 50.0  # distance of the room's lamp, in sizes of the scene
_MOTION_WIDTH = 600  # pixels, of the image in which a shot's motion is given


@dataclass(frozen=True)
class Photograph:
    """One frame: the truth at pixel centres, the image, and the file that the camera writes."""

    coords: Float32[ndarray, "h w 2"]
    mask: Bool[ndarray, "h w"]
    object_mask: Bool[ndarray, "h w"]
    image: UInt8[ndarray, "h w 3"]  # as decoded from `jpeg`
    jpeg: bytes


@dataclass(frozen=True)
class Stage:
    """What stands where in one frame."""

    caster: RayCaster
    devices: DevicePair
    T_world_camera: Float[ndarray, "4 4"]
    T_world_projector: Float[ndarray, "4 4"]


def take_photograph(stage: Stage, look: Look, shot: Shot, supersampling: int, rng: np.random.Generator) -> Photograph:
    """Render a frame and develop it; `rng` is for the sensor's noise."""
    at = stage.caster, stage.devices, stage.T_world_camera, stage.T_world_projector
    centres = visible_centres(*at)
    bounced = _bounced_vectors(stage, look, centres)

    def light(seen: VisiblePoints, pixel: Int64[ndarray, "n"]) -> Float32[ndarray, "n 3"]:
        return _reflected(stage, look, seen, bounced[pixel])

    view = sample_view(*at, centres, light, look.room.nothing, supersampling)
    depth = -(centres.p_world - stage.T_world_camera[:3, 3]) @ stage.T_world_camera[:3, 2]
    image = look.lens.blurred(view.radiance, depth.reshape(view.shape))
    image = moved(image, shot.motion * stage.devices.camera.w / _MOTION_WIDTH, shot.motion_direction)
    sensor = Sensor(look.gain * shot.exposure, look.noise, look.gamma, shot.jpeg_quality)
    jpeg = sensor.encode(sensor.develop(image, rng))
    on_object = stage.caster.on_object(centres.face).reshape(view.shape)
    return Photograph(view.coords, view.mask, on_object, decode_jpeg(jpeg), jpeg)


def _reflected(
    stage: Stage, look: Look, seen: VisiblePoints, bounced: Float32[ndarray, "n 3 3"]
) -> Float32[ndarray, "n 3"]:
    """Light that surfaces send to the camera: matte reflection of all light, highlights of both lamps."""
    out = np.broadcast_to(look.room.nothing, (len(seen.hit), 3)).copy()
    p, face, lit = seen.p_world[seen.hit], seen.face[seen.hit], seen.lit[seen.hit]
    normal = shading_normals(stage.caster.scene, face, p).astype(np.float32)
    own = stage.caster.on_object(face)
    projected = _projected(stage, look, p, normal, seen.uv_projector[seen.hit], lit)
    lamp_seen = _room_lamp_seen(stage, look, p, face)
    diffuse = projected[:, None] * look.lamp.colour + look.room.diffuse(normal, lamp_seen)
    diffuse += np.maximum(np.einsum("nca,na->nc", bounced[seen.hit], normal), 0)
    reflected = _albedo(look, p, own) * diffuse
    to_camera = _unit(stage.T_world_camera[:3, 3] - p)
    to_projector = _unit(stage.T_world_projector[:3, 3] - p)
    lobe = _highlight(look, own, normal, to_camera, to_projector)
    reflected += (lobe * projected)[:, None] * look.lamp.colour
    lobe = _highlight(look, own, normal, to_camera, np.broadcast_to(look.room.towards_lamp, p.shape))
    reflected += (lobe * lamp_seen * np.maximum(normal @ look.room.towards_lamp, 0))[:, None] * look.room.lamp
    out[seen.hit] = reflected
    return out


def _projected(
    stage: Stage,
    look: Look,
    p: Float64[ndarray, "n 3"],
    normal: Float32[ndarray, "n 3"],
    uv: Float64[ndarray, "n 2"],
    lit: Bool[ndarray, "n"],
) -> Float32[ndarray, "n"]:
    """Light of the projector on surfaces, white."""
    out = np.zeros(len(p), dtype=np.float32)
    ray = stage.T_world_projector[:3, 3] - p[lit]
    distance = np.linalg.norm(ray, axis=-1)
    cosine = np.abs((ray * normal[lit]).sum(-1)) / distance
    value = look.lamp.through_pattern(look.pattern.sample(uv[lit], distance))
    out[lit] = value * cosine * look.lamp.strength(uv[lit], distance, stage.devices.projector)
    return out


def _albedo(look: Look, p: Float64[ndarray, "n 3"], own: Bool[ndarray, "n"]) -> Float32[ndarray, "n 3"]:
    out = np.empty((len(p), 3), dtype=np.float32)
    out[own], out[~own] = look.material.albedo(p[own]), look.material_around.albedo(p[~own])
    return out


def _highlight(
    look: Look,
    own: Bool[ndarray, "n"],
    normal: Float32[ndarray, "n 3"],
    to_camera: Float32[ndarray, "n 3"],
    to_lamp: Float32[ndarray, "n 3"],
) -> Float32[ndarray, "n"]:
    """Share of a lamp's light in the highlight, by the half-way direction."""
    cosine = np.abs((normal * _unit(to_camera + to_lamp)).sum(-1))
    return np.where(own, look.material.highlight(cosine), look.material_around.highlight(cosine))


def _room_lamp_seen(
    stage: Stage, look: Look, p: Float64[ndarray, "n 3"], face: Int64[ndarray, "n"]
) -> Float32[ndarray, "n"]:
    """1 where the room's lamp reaches a surface, 0 in its shadow."""
    scene = stage.caster.scene
    towards = look.room.towards_lamp.astype(np.float64)
    reached = scene.face_normals[face] @ towards > 0
    origin = scene.centre + _FAR * scene.size * towards
    reached[reached] = stage.caster.sees(origin, p[reached] + _LIFT * scene.size * towards, face[reached])
    return reached.astype(np.float32)


def _bounced_vectors(stage: Stage, look: Look, centres: VisiblePoints) -> Float32[ndarray, "n 3 3"]:
    """Light from one bounce at every pixel, as vectors."""
    w, h = stage.devices.camera.w, stage.devices.camera.h
    stride = max(1, w // _GATHERED_ACROSS)
    number = np.arange(w * h).reshape(h, w)[stride // 2 :: stride, stride // 2 :: stride]
    known = centres.hit[number]
    at = number[known]
    p = centres.p_world[at]
    normal = shading_normals(stage.caster.scene, centres.face[at], p)
    vectors = light_vectors(stage.caster, _small_lamps(stage, look), p, normal)
    return interpolate_vectors(vectors, known, stride, (h, w)).reshape(-1, 3, 3)


def _small_lamps(stage: Stage, look: Look) -> SmallLamps:
    """Where a coarse bundle of the projector's rays ends, and what is reflected there."""
    projector, origin = stage.devices.projector, stage.T_world_projector[:3, 3]
    place = (np.arange(_LAMPS_ACROSS) + 0.5) / _LAMPS_ACROSS
    uv = np.stack(np.meshgrid(place * projector.w, place * projector.h), -1).reshape(-1, 2)
    direction = rays(projector, stage.T_world_projector, uv)
    hits = stage.caster.first_hits(origin, direction)
    hit = hits.face >= 0
    p, face = hits.p_world[hit], hits.face[hit]
    distance = np.linalg.norm(p - origin, axis=-1)
    # light through a cell of the bundle: strength at a distance, times the cell's area there
    side = distance / projector.fl_x * projector.w / _LAMPS_ACROSS
    area = side * distance / projector.fl_y * projector.h / _LAMPS_ACROSS
    mean = look.lamp.through_pattern(np.full(len(p), look.pattern.levels[0].mean(), dtype=np.float32))
    power = look.lamp.strength(uv[hit], distance, projector) * area * mean
    albedo = _albedo(look, p, stage.caster.on_object(face))
    normal = stage.caster.scene.face_normals[face]
    normal = normal * -np.sign((normal * direction[hit]).sum(-1, keepdims=True))
    return SmallLamps(p, normal, power[:, None] * albedo * look.lamp.colour, side)


def _unit(v: Float[ndarray, "n 3"]) -> Float32[ndarray, "n 3"]:
    v = v.astype(np.float32)
    return v / np.sqrt(np.einsum("ij,ij->i", v, v))[:, None]
