"""A capture as a colour camera takes it: materials, defocus, interreflection, room light, lens, sensor, JPEG."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from numpy import ndarray
from scipy.ndimage import map_coordinates

from sl_nerfstudio.geometry.lie import DevicePoses, exp_so3
from sl_nerfstudio.synthesis.appearance import Look, Ranges, draw, draw_log, moved
from sl_nerfstudio.synthesis.devices import rays
from sl_nerfstudio.synthesis.render import (
    FrameGeometry,
    RayCaster,
    RenderedCapture,
    VisiblePoints,
    sample_view,
    shading_normals,
    visible_centres,
)

# One bounce: light of the projector that one surface throws onto another.
#
# The pattern's light is cast in a coarse bundle of rays; each point that it meets shines on like a small matte lamp
# (Keller's virtual point lights, 1997). What they send to a surface is gathered at a coarse grid of image pixels, with
# shadow rays, as a vector of light for each colour, so that fine relief is still shaded by its own normals. The pattern
# itself is too fine to survive the bounce, so its mean is used.

_FACING = 1e-3  # cosines below this carry no light


@dataclass(frozen=True)
class SmallLamps:
    """Points that shine on the light that they receive, in all directions of their side."""

    p_world: Float[ndarray, "m 3"]
    normal: Float[ndarray, "m 3"]
    power: Float[ndarray, "m 3"]  # reflected light times area, red, green, blue
    width: Float[ndarray, "m"]  # of the patch that each stands for, millimetres


def light_vectors(
    caster: RayCaster, lamps: SmallLamps, p_world: Float[ndarray, "n 3"], normal: Float[ndarray, "n 3"]
) -> Float32[ndarray, "n 3 3"]:
    """Sum of the lamps' light over directions at points, (colour, axis): its product with a normal is the light there.

    Lamps behind the surface, and lamps that another surface hides, give nothing.
    """
    out = np.zeros((len(p_world), 3, 3))
    for q, towards, power, width in zip(lamps.p_world, lamps.normal, lamps.power, lamps.width, strict=True):
        ray = q - p_world
        distance2 = (ray**2).sum(-1)
        direction = ray / np.sqrt(np.maximum(distance2, 1e-12))[:, None]
        leaving = -(direction @ towards)
        reached = (leaving > _FACING) & ((direction * normal).sum(-1) > _FACING)
        reached[reached] = _clear(caster, q, towards, p_world[reached])
        # a lamp stands for a patch: nearer than its width, the inverse-square law does not hold
        weight = leaving[reached] / (np.pi * np.maximum(distance2[reached], width**2))
        out[reached] += power[:, None] * (weight[:, None] * direction[reached])[:, None, :]
    return out.astype(np.float32)


def interpolate_vectors(
    vectors: Float32[ndarray, "n 3 3"], known: Bool[ndarray, "a b"], stride: int, shape: tuple[int, int]
) -> Float32[ndarray, "h w 3 3"]:
    """Vectors at every pixel from those on a grid of every `stride`-th pixel, of which `known` ones exist."""
    h, w = shape
    grid = np.zeros((*known.shape, 10), dtype=np.float32)
    grid[known, :9] = vectors.reshape(-1, 9)
    grid[known, 9] = 1
    i, j = np.meshgrid((np.arange(h) - stride // 2) / stride, (np.arange(w) - stride // 2) / stride, indexing="ij")
    full = np.stack([map_coordinates(grid[..., k], [i, j], order=1, mode="nearest") for k in range(10)], -1)
    return (full[..., :9] / np.maximum(full[..., 9:], 1e-3)).reshape(h, w, 3, 3)


def _clear(
    caster: RayCaster, origin: Float[ndarray, "3"], normal: Float[ndarray, "3"], p_world: Float[ndarray, "n 3"]
) -> Bool[ndarray, "n"]:
    """Whether nothing is between a lamp, lifted off its own surface, and points."""
    lift = 1e-3 * caster.scene.size
    return caster.sees(origin + lift * normal, p_world, np.full(len(p_world), -2))


# From light to a file: exposure, noise, saturation, gamma, JPEG.

_READ_NOISE = 0.15  # share of the variance at full scale that is there in the dark, too


@dataclass(frozen=True)
class Sensor:
    """A colour camera."""

    gain: float  # signal at full scale is 1
    noise: float  # at full scale, as a fraction of it
    gamma: float
    jpeg_quality: int

    def develop(self, light: Float32[ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[ndarray, "h w 3"]:
        """An 8-bit image in red, green, blue: shot and read noise, saturation, gamma, rounding."""
        signal = np.clip(light * np.float32(self.gain), 0, None)
        sigma = np.float32(self.noise) * np.sqrt(_READ_NOISE + (1 - _READ_NOISE) * np.minimum(signal, 1))
        signal = signal + sigma * rng.standard_normal(signal.shape, dtype=np.float32)
        return np.rint(255 * np.clip(signal, 0, 1) ** np.float32(1 / self.gamma)).astype(np.uint8)

    def encode(self, image: UInt8[ndarray, "h w 3"]) -> bytes:
        """The file that the camera writes."""
        ok, content = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        assert ok
        return content.tobytes()


def decode_jpeg(content: bytes) -> UInt8[ndarray, "h w 3"]:
    """The image as readers see it, in red, green, blue."""
    return np.ascontiguousarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1])


# What differs from frame to frame: exposure, motion, compression, and which frames are of no use.

Fault = Literal["object out of view", "blurred by motion"]
_AWAY_DEG = (24.0, 40.0)  # that the camera is turned away from the object


@dataclass(frozen=True)
class Shot:
    """One frame; `fault` says why it is of no use."""

    exposure: float  # times the one that suits the object
    motion: float  # pixels of an image 600 pixels wide
    motion_direction: float  # in the image, radians
    jpeg_quality: int
    fault: Fault | None = None


def plan_shots(ranges: Ranges, rngs: list[np.random.Generator], useless: frozenset[int]) -> tuple[Shot, ...]:
    """Each frame from its own stream; those in `useless` are spoiled one way or the other."""
    return tuple(_shot(ranges, rng, frame in useless) for frame, rng in enumerate(rngs))


def choose_useless(frames: int, ranges: Ranges, rng: np.random.Generator) -> frozenset[int]:
    """Frames of no use: the share that the ranges give, rounded at random, and never the first."""
    wanted = ranges.useless * frames
    count = int(wanted) + int(rng.random() < wanted % 1)
    return frozenset(int(n) for n in 1 + rng.permutation(frames - 1)[:count])


def turn_away(poses: DevicePoses, shots: tuple[Shot, ...], rngs: list[np.random.Generator]) -> DevicePoses:
    """The camera looks past the object in frames that say so."""
    camera = poses.T_world_camera.copy()
    for n, (shot, rng) in enumerate(zip(shots, rngs, strict=True)):
        if shot.fault == "object out of view":
            camera[n] = camera[n] @ _turn(rng)
    return DevicePoses(camera, poses.T_world_projector)


def _shot(ranges: Ranges, rng: np.random.Generator, useless: bool) -> Shot:
    exposure, motion = draw_log(rng, ranges.exposure), draw(rng, ranges.motion)
    direction, quality = float(rng.uniform(0, np.pi)), round(draw(rng, ranges.jpeg_quality))
    if not useless:
        return Shot(exposure, motion, direction, quality)
    if rng.random() < 0.5:
        return Shot(exposure, motion, direction, quality, "object out of view")
    return Shot(exposure, draw(rng, ranges.shake), direction, quality, "blurred by motion")


def _turn(rng: np.random.Generator) -> Float64[ndarray, "4 4"]:
    """A rotation of a device about a random axis across its line of sight."""
    angle, axis = np.radians(draw(rng, _AWAY_DEG)), rng.uniform(0, 2 * np.pi)
    T = np.eye(4)
    w: Float[ndarray, 3] = angle * np.array([np.cos(axis), np.sin(axis), 0.0])
    T[:3, :3] = exp_so3(torch.from_numpy(w)).numpy()
    return T


_LAMPS_ACROSS = 16  # small lamps along each side of the pattern
_GATHERED_ACROSS = 50  # pixels along each side of the image where bounced light is gathered
_LIFT = 1e-4  # of the scene, that shadow rays to the room's lamp start above a surface
_FAR = 50.0  # distance of the room's lamp, in sizes of the scene
_MOTION_WIDTH = 600  # pixels, of the image in which a shot's motion is given


@dataclass(frozen=True)
class Photograph(RenderedCapture):
    """One frame: the truth at pixel centres, the image, and the file that the camera writes."""

    image: UInt8[ndarray, "h w 3"]  # as decoded from `jpeg`
    jpeg: bytes


def take_photograph(
    stage: FrameGeometry, look: Look, shot: Shot, supersampling: int, rng: np.random.Generator
) -> Photograph:
    """Render a frame and develop it; `rng` is for the sensor's noise."""
    centres = visible_centres(stage)
    bounced = _bounced_vectors(stage, look, centres)

    def light(seen: VisiblePoints, pixel: Int64[ndarray, "n"]) -> Float32[ndarray, "n 3"]:
        return _reflected(stage, look, seen, bounced[pixel])

    view = sample_view(stage, centres, light, look.room.nothing, supersampling)
    depth = -(centres.p_world - stage.T_world_camera[:3, 3]) @ stage.T_world_camera[:3, 2]
    image = look.lens.blurred(view.radiance, depth.reshape(view.mask.shape))
    image = moved(image, shot.motion * stage.devices.camera.w / _MOTION_WIDTH, shot.motion_direction)
    sensor = Sensor(look.gain * shot.exposure, look.noise, look.gamma, shot.jpeg_quality)
    jpeg = sensor.encode(sensor.develop(image, rng))
    return Photograph(**vars(view), image=decode_jpeg(jpeg), jpeg=jpeg)


def _reflected(
    stage: FrameGeometry, look: Look, seen: VisiblePoints, bounced: Float32[ndarray, "n 3 3"]
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
    stage: FrameGeometry,
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
    stage: FrameGeometry, look: Look, p: Float64[ndarray, "n 3"], face: Int64[ndarray, "n"]
) -> Float32[ndarray, "n"]:
    """1 where the room's lamp reaches a surface, 0 in its shadow."""
    scene = stage.caster.scene
    towards = look.room.towards_lamp.astype(np.float64)
    reached = scene.face_normals[face] @ towards > 0
    origin = scene.centre + _FAR * scene.size * towards
    reached[reached] = stage.caster.sees(origin, p[reached] + _LIFT * scene.size * towards, face[reached])
    return reached.astype(np.float32)


def _bounced_vectors(stage: FrameGeometry, look: Look, centres: VisiblePoints) -> Float32[ndarray, "n 3 3"]:
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


def _small_lamps(stage: FrameGeometry, look: Look) -> SmallLamps:
    """Small lamps where a coarse bundle of the projector's rays ends, with the light reflected there."""
    projector, origin = stage.devices.projector, stage.T_world_projector[:3, 3]
    place = (np.arange(_LAMPS_ACROSS) + 0.5) / _LAMPS_ACROSS
    uv = np.stack(np.meshgrid(place * projector.w, place * projector.h), -1).reshape(-1, 2)
    direction = rays(projector, stage.T_world_projector, uv)
    face, p = stage.caster.first_hits(origin, direction)
    hit = face >= 0
    p, face = p[hit], face[hit]
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
