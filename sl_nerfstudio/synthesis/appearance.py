"""Appearance of captures: material, light, projector and lens of photographs, and the plain surface of grey images."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32
from numpy import ndarray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.synthesis.sdf import Scene

# How strongly captures differ from ideal ones: the ranges of `--appearance realistic` and `hard`.

AppearanceKind = Literal["plain", "realistic", "hard"]
Range = tuple[float, float]


@dataclass(frozen=True)
class Ranges:
    """Each property is drawn between two values, once for a scan or once for each frame; the defaults are `realistic`.

    Blur of the camera is in pixels of an image 600 pixels wide, and grows with its width.
    """

    # of a scan
    pattern_blur: Range = (0.5, 0.9)  # sigma of the projected pattern in focus, pattern pixels
    pattern_defocus: Range = (1.0, 2.2)  # added in quadrature half the object's size off the focal plane, the same
    camera_blur: Range = (0.5, 0.9)  # sigma in focus, pixels
    camera_defocus: Range = (0.3, 1.1)  # added in quadrature half the object's size off the focal plane, the same
    brightness: Range = (0.45, 0.85)  # of the object's material, share of light reflected
    texture_contrast: Range = (0.2, 0.55)  # share of light that a layer of texture takes away at most
    texture_layers: tuple[int, int] = (1, 2)  # number on the object, least and most
    gloss: Range = (0.02, 0.2)  # strength of the highlight
    gloss_exponent: Range = (8.0, 60.0)
    room_light: Range = (0.06, 0.28)  # all of it, for a white surface, where the lamp of the projector has 1
    gamma: Range = (1.8, 2.4)
    noise: Range = (0.8, 1.8)  # times --sensor-noise
    useless: float = 0.04  # share of the frames
    # of a frame
    exposure: Range = (0.7, 1.4)  # times the one that suits the material
    motion: Range = (0.0, 2.2)  # length of the path of a point in the image while the shutter is open, pixels
    jpeg_quality: Range = (78.0, 95.0)
    shake: Range = (14.0, 30.0)  # the same as `motion`, in frames spoiled by it


REALISTIC = Ranges()
HARD = Ranges(
    pattern_blur=(0.6, 1.1),
    pattern_defocus=(1.3, 2.3),
    camera_blur=(0.5, 1.0),
    camera_defocus=(0.6, 1.5),
    brightness=(0.3, 0.85),
    texture_contrast=(0.3, 0.65),
    texture_layers=(1, 3),
    gloss=(0.08, 0.35),
    gloss_exponent=(8.0, 90.0),
    room_light=(0.12, 0.45),
    gamma=(1.6, 2.6),
    noise=(1.3, 3.0),
    useless=0.1,
    exposure=(0.55, 1.7),
    motion=(0.0, 3.5),
    jpeg_quality=(60.0, 88.0),
    shake=(12.0, 30.0),
)

RANGES: dict[AppearanceKind, Ranges] = {"realistic": REALISTIC, "hard": HARD}


def draw(rng: np.random.Generator, bounds: Range) -> float:
    """A value between both bounds, uniformly."""
    return float(rng.uniform(*bounds))


def draw_log(rng: np.random.Generator, bounds: Range) -> float:
    """A value between both bounds, uniformly in its logarithm."""
    return float(np.exp(rng.uniform(*np.log(bounds))))


# Solid textures: where a surface is darker, as a function of the point in space, so that all frames agree.
#
# Each function draws one texture for an object of a given size and returns a map from points (relative to the object's
# middle, in its unit) to values from 0 (untouched) to 1 (fully coloured).

Texture = Callable[[Float32[ndarray, "n 3"]], Float32[ndarray, "n"]]
TextureMaker = Callable[[float, np.random.Generator], Texture]


def blotches(size: float, rng: np.random.Generator) -> Texture:
    """Smooth stains of all sizes."""
    waves = _waves(size, (0.08, 0.9), rng)
    return lambda p: _smooth_step(0.5 + 0.45 * waves(p))


def specks(size: float, rng: np.random.Generator) -> Texture:
    """Small dark grains, as in stone or sprayed paint."""
    waves = _waves(size, (0.02, 0.06), rng)
    level = np.float32(rng.uniform(0.5, 1.1))
    return lambda p: _smooth_step((waves(p) - level) * 3)


def stripes(size: float, rng: np.random.Generator) -> Texture:
    """Printed bands with crisp edges."""
    across, width = _directions(rng)[0], np.float32(size * rng.uniform(0.06, 0.2))
    share, crisp = np.float32(rng.uniform(0.3, 0.6)), width / np.float32(0.004 * size)

    def value(p: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        phase = p @ across / width
        # distance from the middle of a band, in band widths
        return np.clip((share / 2 - np.abs(phase - np.round(phase))) * crisp + np.float32(0.5), 0, 1)

    return value


def checks(size: float, rng: np.random.Generator) -> Texture:
    """Squares of two colours, as on cloth."""
    axes, width = _directions(rng)[:2], np.float32(size * rng.uniform(0.08, 0.2))
    crisp = width / np.float32(0.004 * size)

    def value(p: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        a, b = (np.clip(_triangle(p @ axis / width) * crisp, -0.5, 0.5) for axis in axes)
        return np.float32(0.5) + 2 * a * b

    return value


def wood(size: float, rng: np.random.Generator) -> Texture:
    """Annual rings about an axis beside the object, wavy."""
    x, y, _ = _directions(rng)
    spacing = np.float32(size * rng.uniform(0.025, 0.07))
    offset = np.float32(size * rng.uniform(0.4, 1.2))
    bend, grain = _waves(size, (0.3, 1.0), rng), _waves(size, (0.015, 0.03), rng)

    def value(p: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        radius = np.hypot(p @ x + offset, p @ y) + np.float32(0.03 * size) * bend(p)
        ring = radius / spacing
        ring = ring - np.floor(ring)
        return np.clip(ring * ring * np.float32(0.85) + np.float32(0.12) * grain(p), 0, 1)

    return value


def marble(size: float, rng: np.random.Generator) -> Texture:
    """Thin dark veins."""
    across, width = _directions(rng)[0], np.float32(size * rng.uniform(0.15, 0.4))
    coarse, fine = _waves(size, (0.15, 0.6), rng), _waves(size, (0.04, 0.12), rng)

    def value(p: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        phase = p @ across / width + np.float32(0.5) * coarse(p) + np.float32(0.1) * fine(p)
        return (1 - np.abs(np.sin(np.float32(np.pi) * phase))) ** 4

    return value


def print_marks(size: float, rng: np.random.Generator) -> Texture:
    """Lines of marks like letters: each place of a row holds random strokes of 4 x 6 dots, or a blank."""
    u, v, _ = _directions(rng)
    dot = np.float32(size * rng.uniform(0.006, 0.014))
    dense, seed = rng.uniform(0.4, 0.6), int(rng.integers(2**20))

    def value(p: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        column, row = np.floor(p @ u / dot).astype(np.int32), np.floor(p @ v / dot).astype(np.int32)
        letter, line = column // 5, row // 10
        inside = (column % 5 < 4) & (row % 10 < 6)
        blank = _hash(letter // 2, line, seed) % 5 == 0  # gaps between words
        stroke = _hash(column, row, seed + 1) < 1000 * dense
        return (inside & ~blank & stroke).astype(np.float32)

    return value


TEXTURES: dict[str, TextureMaker] = {
    "blotches": blotches,
    "specks": specks,
    "stripes": stripes,
    "checks": checks,
    "wood": wood,
    "marble": marble,
    "print": print_marks,
}


def _waves(size: float, lengths: Range, rng: np.random.Generator, count: int = 12) -> Texture:
    """A smooth random function with mean 0 and standard deviation 1; wavelengths in sizes of the object."""
    shortest, longest = np.log(lengths)
    wavelength = size * np.exp(rng.uniform(shortest, longest, count))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    k = (direction * (2 * np.pi / wavelength)[:, None]).T.astype(np.float32)
    phase = rng.uniform(0, 2 * np.pi, count).astype(np.float32)
    return lambda p: np.cos(p @ k + phase).sum(-1) * np.float32(np.sqrt(2 / count))


def _directions(rng: np.random.Generator) -> Float32[ndarray, "3 3"]:
    """Three perpendicular directions."""
    return Rotation.random(random_state=rng).as_matrix().astype(np.float32)


def _smooth_step(x: Float32[ndarray, "n"]) -> Float32[ndarray, "n"]:
    t = np.clip(x, 0, 1)
    return t * t * (3 - 2 * t)


def _triangle(x: Float32[ndarray, "n"]) -> Float32[ndarray, "n"]:
    """A triangle wave of period 2 with slope 1, zero at every whole number."""
    return np.abs((x + np.float32(0.5)) % 2 - 1) - np.float32(0.5)


def _hash(i: Int32[ndarray, "n"], j: Int32[ndarray, "n"], seed: int) -> Int32[ndarray, "n"]:
    """A number from 0 to 999 for each pair, without visible order."""
    h = i.astype(np.uint32) * np.uint32(374761393) + j.astype(np.uint32) * np.uint32(668265263) + np.uint32(seed)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(1274126177)
    return ((h ^ (h >> np.uint32(16))) % np.uint32(1000)).astype(np.int32)


# What a surface does with light: a coloured, textured, matte base, and a highlight.

LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # Rec. 601, as captures are made grey
_DARKEST, _BRIGHTEST = 0.04, 0.95


@dataclass(frozen=True)
class Layer:
    """A texture, and the share of light (red, green, blue) that is left where it is 1."""

    texture: Texture
    left: Float32[ndarray, "3"]


@dataclass(frozen=True)
class Material:
    """A matte base under layers of texture, and a highlight by Blinn and Phong that keeps the lamp's colour."""

    centre: Float[ndarray, "3"]
    base: Float32[ndarray, "3"]
    layers: tuple[Layer, ...]
    gloss: float
    exponent: float

    def albedo(self, p_world: Float[ndarray, "n 3"]) -> Float32[ndarray, "n 3"]:
        """Share of light reflected in red, green and blue."""
        p = (p_world - self.centre).astype(np.float32)
        out = np.broadcast_to(self.base, (len(p), 3)).copy()
        for layer in self.layers:
            out *= 1 - layer.texture(p)[:, None] * (1 - layer.left)
        return np.clip(out, _DARKEST, _BRIGHTEST)

    def highlight(self, cosine: Float32[ndarray, "n"]) -> Float32[ndarray, "n"]:
        """Share of light in the highlight, by the cosine between normal and half-way direction.

        The factor (m + 8) / 8 keeps the energy about the same for every exponent m.
        """
        return np.float32(self.gloss * (self.exponent + 8) / 8) * np.maximum(cosine, 0) ** np.float32(self.exponent)


def make_material(
    centre: Float[ndarray, "3"], size: float, ranges: Ranges, most_layers: int, rng: np.random.Generator
) -> Material:
    """A random material: a tinted base, and different textures drawn without order."""
    least = min(ranges.texture_layers[0], most_layers)
    names = rng.permutation(list(TEXTURES))[: int(rng.integers(least, most_layers + 1))]
    layers = []
    for name in names:
        texture = TEXTURES[str(name)](size, rng)
        taken = draw(rng, ranges.texture_contrast) * rng.uniform(0.7, 1.0, 3)
        layers.append(Layer(texture, (1 - taken).astype(np.float32)))
    brightness = draw(rng, ranges.brightness)
    base = tint(0.25, rng) * np.float32(brightness)
    return Material(centre, base, tuple(layers), draw(rng, ranges.gloss), draw_log(rng, ranges.gloss_exponent))


def tint(strength: float, rng: np.random.Generator) -> Float32[ndarray, "3"]:
    """A random colour of luma 1; channels differ by about `strength`."""
    colour = np.exp(rng.uniform(-strength, strength, 3)).astype(np.float32)
    return colour / (colour @ LUMA)


# Where light comes from: the projector's lamp with its defocused pattern, and the room.

_DEFOCUS_LEVELS = np.array([0.0, 0.5, 0.8, 1.15, 1.55, 2.0, 2.5, 3.2], dtype=np.float32)  # sigma, pattern pixels
_LAMP_SHARE = (0.3, 0.7)  # of the room's light that comes from one lamp


@dataclass(frozen=True)
class Defocus:
    """Blur of a thin lens by distance; lengths in millimetres, sigmas in pixels of the device."""

    in_focus: float
    out_of_focus: float  # added in quadrature at `reach` from the focal plane
    focus: float  # distance of the focal plane
    reach: float
    largest: float

    def sigma(self, distance: Float[ndarray, "*n"]) -> Float32[ndarray, "*n"]:
        """Blur at a distance: it grows with the difference of the inverse distances; NaN, nothing there, is far."""
        off = (self.focus / np.where(np.isfinite(distance), distance, 2 * self.focus) - 1) * self.focus / self.reach
        return np.minimum(np.hypot(self.in_focus, self.out_of_focus * off), self.largest).astype(np.float32)


@dataclass(frozen=True)
class DefocusedPattern(Defocus):
    """The pattern blurred more and more; between two levels, values are interpolated."""

    levels: Float32[ndarray, "k h w"]

    def sample(self, uv: Float[ndarray, "n 2"], distance: Float[ndarray, "n"]) -> Float32[ndarray, "n"]:
        """Pattern values in [0, 1] at pattern pixels, as thrown onto surfaces at distances from the projector."""
        sigma = self.sigma(distance)
        upper = np.clip(np.searchsorted(_DEFOCUS_LEVELS, sigma), 1, len(_DEFOCUS_LEVELS) - 1)
        # variances add up, so interpolate in them
        low, high = _DEFOCUS_LEVELS[upper - 1] ** 2, _DEFOCUS_LEVELS[upper] ** 2
        share = (sigma**2 - low) / (high - low)
        return (1 - share) * self._bilinear(upper - 1, uv) + share * self._bilinear(upper, uv)

    def _bilinear(self, level: ndarray, uv: Float[ndarray, "n 2"]) -> Float32[ndarray, "n"]:
        h, w = self.levels.shape[1:]
        x, y = np.clip(uv[:, 0] - 0.5, 0, w - 1.001), np.clip(uv[:, 1] - 0.5, 0, h - 1.001)
        column, row = x.astype(np.int64), y.astype(np.int64)
        fx, fy = (x - column).astype(np.float32), (y - row).astype(np.float32)
        flat, at = self.levels.reshape(-1), (level * h + row) * w + column
        above = flat[at] * (1 - fx) + flat[at + 1] * fx
        below = flat[at + w] * (1 - fx) + flat[at + w + 1] * fx
        return above * (1 - fy) + below * fy


def corner_fall_off(uv: Float[ndarray, "n 2"], projector: Device, corner_loss: float) -> Float[ndarray, "n"]:
    """Strength of a lamp at pattern pixels: 1 in the middle, 1 - `corner_loss` in the corners."""
    middle, half = np.array([projector.w, projector.h]) / 2, np.hypot(projector.w, projector.h) / 2
    return 1 - corner_loss * ((uv - middle) ** 2).sum(-1) / half**2


@dataclass(frozen=True)
class Lamp:
    """The projector's lamp."""

    colour: Float32[ndarray, "3"]
    dark_leak: float  # light where the pattern is dark
    corner_loss: float
    reference_distance: float  # millimetres: where the light has unit strength

    def strength(
        self, uv: Float[ndarray, "n 2"], distance: Float[ndarray, "n"], projector: Device
    ) -> Float32[ndarray, "n"]:
        """Light on a surface that faces the lamp, by the inverse-square law and the fall-off to the corners."""
        fall_off = corner_fall_off(uv, projector, self.corner_loss)
        return (fall_off * (self.reference_distance / distance) ** 2).astype(np.float32)

    def through_pattern(self, value: Float32[ndarray, "n"]) -> Float32[ndarray, "n"]:
        """Share of the lamp's light for a pattern value."""
        return np.float32(self.dark_leak) + np.float32(1 - self.dark_leak) * value


@dataclass(frozen=True)
class Room:
    """Light from everywhere, more from above, and one far lamp that throws shadows."""

    ambient: Float32[ndarray, "3"]
    lamp: Float32[ndarray, "3"]
    towards_lamp: Float32[ndarray, "3"]
    nothing: Float32[ndarray, "3"]  # what is seen where no surface is

    def diffuse(self, normal: Float32[ndarray, "n 3"], lamp_seen: Float32[ndarray, "n"]) -> Float32[ndarray, "n 3"]:
        """Light on surfaces; `lamp_seen` is 0 in the lamp's shadow and 1 outside."""
        up = np.float32(0.75) + np.float32(0.25) * normal[:, 2]
        facing = np.maximum(normal @ self.towards_lamp, 0) * lamp_seen
        return up[:, None] * self.ambient + facing[:, None] * self.lamp


def make_pattern(
    pattern: Float32[ndarray, "h w"], distance: float, size: float, ranges: Ranges, rng: np.random.Generator
) -> DefocusedPattern:
    """The focal plane is anywhere within the object."""
    blurred = [
        pattern,
        *(cv2.GaussianBlur(pattern, (0, 0), float(s), borderType=cv2.BORDER_REPLICATE) for s in _DEFOCUS_LEVELS[1:]),
    ]
    return DefocusedPattern(
        draw(rng, ranges.pattern_blur),
        draw(rng, ranges.pattern_defocus),
        distance + size * rng.uniform(-0.35, 0.35),
        0.5 * size,
        float(_DEFOCUS_LEVELS[-1]),
        np.stack(blurred).astype(np.float32),
    )


def make_lamp(distance: float, rng: np.random.Generator) -> Lamp:
    """Draw a lamp: white, warm, cold or tinted."""
    return Lamp(tint(rng.choice([0.08, 0.3]), rng), rng.uniform(0.02, 0.08), rng.uniform(0.2, 0.5), distance)


def make_room(ranges: Ranges, rng: np.random.Generator) -> Room:
    """Room light in one tint, and its lamp above."""
    level, share = draw(rng, ranges.room_light), rng.uniform(*_LAMP_SHARE)
    colour = tint(0.15, rng)
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(35, 80))
    flat = np.cos(elevation)
    towards = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], dtype=np.float32)
    nothing = colour * np.float32(level * rng.uniform(0.05, 0.3) + 0.01)
    return Room(colour * np.float32(level * (1 - share)), tint(0.15, rng) * np.float32(level * share), towards, nothing)


# The camera's lens and the hand that holds it: defocus by depth, and motion blur.

_BLUR_LEVELS = 5  # blurred images between which each pixel is interpolated
_REFERENCE_WIDTH = 600  # pixels, of the image that the ranges are given for


class Lens(Defocus):
    """The camera's."""

    def blurred(self, image: Float32[ndarray, "h w 3"], depth: Float[ndarray, "h w"]) -> Float32[ndarray, "h w 3"]:
        """Each pixel from an image blurred as its depth demands: exact where the depth is the same all around."""
        sigma = self.sigma(depth)
        level = np.linspace(self.in_focus, max(float(sigma.max()), self.in_focus + 1e-3), _BLUR_LEVELS)
        stack = [cv2.GaussianBlur(image, (0, 0), float(s)) for s in level]
        place = (sigma - level[0]) / (level[1] - level[0])
        out = np.zeros_like(image)
        for k, one in enumerate(stack):
            out += np.maximum(1 - np.abs(place - k), 0)[..., None].astype(np.float32) * one
        return out


def make_lens(distance: float, size: float, width: int, ranges: Ranges, rng: np.random.Generator) -> Lens:
    """The focal plane is anywhere within the object."""
    zoom = width / _REFERENCE_WIDTH
    defocus = draw(rng, ranges.camera_defocus) * zoom
    focus = distance + size * rng.uniform(-0.35, 0.35)
    return Lens(draw(rng, ranges.camera_blur) * zoom, defocus, focus, 0.5 * size, 3.5 * zoom)


def moved(image: Float32[ndarray, "h w 3"], length: float, direction: float) -> Float32[ndarray, "h w 3"]:
    """The mean of the image along a straight path of `length` pixels in a direction (radians)."""
    if length < 0.1:
        return image
    half = int(np.ceil(length / 2)) + 1
    steps = ((np.arange(8 * half) + 0.5) / (8 * half) - 0.5) * length
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    for x, y in zip(half + steps * np.cos(direction), half + steps * np.sin(direction), strict=True):
        i, j = int(y), int(x)
        fy, fx = y - i, x - j
        kernel[i : i + 2, j : j + 2] += np.outer([1 - fy, fy], [1 - fx, fx])
    return cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


# All that a scan's captures have in common: materials, light, lens and sensor.

_EXPOSED_FOR = 0.8  # of full scale: the object's mean material, facing the lamp in full light
_MOST_LAYERS_AROUND = 3  # of texture, on what is around the object


@dataclass(frozen=True)
class Look:
    """Appearance of a scan; frames differ from it only by their `Shot`."""

    material: Material
    material_around: Material
    pattern: DefocusedPattern
    lamp: Lamp
    room: Room
    lens: Lens
    gain: float  # that suits the object
    noise: float
    gamma: float


def make_look(
    scene: Scene,
    distance: float,
    pattern: Float32[ndarray, "h w"],
    image_width: int,
    ranges: Ranges,
    sensor_noise: float,
    rng: np.random.Generator,
) -> Look:
    """A random look for devices at about `distance` (millimetres); each part has a random stream of its own."""
    of_object, around, of_pattern, of_lamp, of_room, of_lens, of_sensor = rng.spawn(7)
    material = make_material(scene.centre, scene.size, ranges, ranges.texture_layers[1], of_object)
    room = make_room(ranges, of_room)
    some = scene.vertices[:: max(1, len(scene.vertices) // 2000)]
    brightness = float((material.albedo(some) @ LUMA).mean())
    room_light = float((room.ambient + room.lamp) @ LUMA)
    return Look(
        material,
        make_material(scene.centre, scene.size, ranges, _MOST_LAYERS_AROUND, around),
        make_pattern(pattern, distance, scene.size, ranges, of_pattern),
        make_lamp(distance, of_lamp),
        room,
        make_lens(distance, scene.size, image_width, ranges, of_lens),
        _EXPOSED_FOR / (brightness * (1 + room_light)),
        sensor_noise * draw(of_sensor, ranges.noise),
        draw(of_sensor, ranges.gamma),
    )


# Plain images: one grey matte surface.


@dataclass(frozen=True)
class Appearance:
    """A matte surface with faint blotches, weak room light, a lamp that fades towards the corners, a slight blur."""

    reference_distance: float  # millimetres: where the lamp has unit strength
    blotches: Texture  # from some millimetres to the size of the object
    mean_albedo: float = 0.78
    albedo_contrast: float = 0.16
    room_light: float = 0.08
    background: float = 0.025
    dark_leak: float = 0.04  # light of the projector where the pattern is dark
    corner_loss: float = 0.35  # of the lamp, in the pattern's corners
    blur: float = 0.55  # sigma of the lens, pixels

    def albedo(self, p_world: Float[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        """Share of light reflected."""
        blotches = self.blotches(p_world.astype(np.float32))
        return np.clip(self.mean_albedo * (1 + self.albedo_contrast * blotches), 0.25, 1.0).astype(np.float32)

    def ambient(self, normal: Float32[ndarray, "n 3"]) -> Float32[ndarray, "n"]:
        """Light from the room, stronger from above."""
        return np.float32(self.room_light) * (np.float32(0.75) + np.float32(0.25) * normal[:, 2])

    def projected(self, intensity: Float32[ndarray, "n"]) -> Float32[ndarray, "n"]:
        """Light of the projector for a pattern value in [0, 1]."""
        return np.float32(self.dark_leak) + np.float32(1 - self.dark_leak) * intensity

    def through_lens(self, image: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
        """The image as blurred by the lens."""
        return gaussian_filter(image, self.blur, truncate=4.0).astype(np.float32)


def make_appearance(scene: Scene, distance: float, rng: np.random.Generator) -> Appearance:
    """A random texture in proportion to the object."""
    return Appearance(distance, _waves(scene.size, (0.08, 0.9), rng, 14))
