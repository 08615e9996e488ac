"""Random surfaces as a camera sees them: which point of the pattern lights each pixel.

No ray is traced. A surface is a coordinate field: an affine map (distance, roll, foreshortening) with perspective, lens
or diffraction distortion, and relief that shifts coordinates in one direction, like parallax. Several such fields lie
on top of each other, with sharp borders, shadows beside them, and holes.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int8
from numpy import ndarray

from training.textures import log_uniform, smooth_field

LARGEST_ROLL = np.radians(40.0)  # that remains after the decoder has turned the image
PERIODS = (8.5, 24.0)  # pixels, before foreshortening
_SHORTEST = 4.5  # period at the steepest places, pixels


@dataclass(frozen=True)
class Surface:
    """Coordinates in periods (x, y), nodes at whole numbers; `layer` is -1 where there is no object."""

    coords: Float32[ndarray, "n n 2"]
    layer: Int8[ndarray, "n n"]
    lit: Bool[ndarray, "n n"]
    shading: Float32[ndarray, "n n"]
    defocus: Float32[ndarray, "n n"]  # of the projector: sigma in periods
    pixels_a_period: float  # typical, in samples


def random_surface(rng: np.random.Generator, size: int, sampling: int, cells: int) -> Surface:
    """`size` pixels per side, `sampling` samples per pixel and direction, of a pattern of `cells` periods per side.

    In a part of the captures the first surface is a background that is much nearer or farther than the others.
    """
    n = size * sampling
    place = ((np.arange(n, dtype=np.float32) + 0.5) / sampling) - size / 2
    x, y = np.meshgrid(place, place)
    jacobian = _random_jacobian(rng)
    centre = cells / 2 + rng.uniform(-1, 1, 2) * (cells / 2 - 3) * (1.0 if rng.random() < 0.25 else 0.5)
    parallax = rng.uniform(0, 2 * np.pi)
    coords, shading = _field(rng, x, y, _distant(rng, jacobian), centre, parallax)
    blur, defocus = rng.uniform(0, 0.16) if rng.random() < 0.5 else 0.0, np.zeros((n, n), dtype=np.float32)
    defocus[:] = _defocus(rng, n, blur)
    layer, lit = np.zeros((n, n), dtype=np.int8), np.ones((n, n), dtype=bool)
    for index in range(1, 1 + rng.choice(4, p=(0.35, 0.3, 0.2, 0.15))):
        shape = _random_shape(rng, x, y, size)
        lit &= ~_shadow(rng, shape, sampling)
        layer[shape], lit[shape] = index, True
        defocus[shape] = _defocus(rng, n, blur)[shape]
        slip = rng.uniform(-8, 8) * np.array([np.cos(parallax), np.sin(parallax)]) + rng.uniform(-0.5, 0.5, 2)
        own, own_shading = _field(rng, x, y, _nearby(rng, jacobian), centre + slip, parallax)
        coords[shape], shading[shape] = own[shape], own_shading[shape]
    if layer.any() and rng.random() < 0.2:  # nothing but the objects in front is lit
        layer[layer == 0] = -1
    elif rng.random() < 0.6:
        layer[_random_shape(rng, x, y, size)] = -1
    if rng.random() < 0.3:
        lit &= ~_holes(rng, n)
    lit &= layer >= 0
    for axis in (0, 1):
        lit &= (coords[..., axis] > -0.5) & (coords[..., axis] < cells - 0.5)
    return Surface(coords, layer, lit, shading, defocus, sampling / float(np.sqrt(abs(np.linalg.det(jacobian)))))


def _random_jacobian(rng: np.random.Generator) -> Float32[ndarray, "2 2"]:
    """Periods per pixel: from image (x, y) to pattern (x, y)."""
    period = log_uniform(rng, *PERIODS)
    roll = np.clip(rng.normal(0, np.radians(16.0)), -LARGEST_ROLL, LARGEST_ROLL)
    steepest = max(period / _SHORTEST, 1.0)
    steep = min(np.exp(abs(rng.normal(0, 0.4))), steepest)
    return (_rotation(roll) @ _stretch(rng.uniform(0, np.pi), steep) / period).astype(np.float32)


def _nearby(rng: np.random.Generator, jacobian: Float32[ndarray, "2 2"]) -> Float32[ndarray, "2 2"]:
    """The map of another surface in the same image: other slopes, nearly the same distance and roll."""
    turn = _rotation(rng.normal(0, np.radians(5.0)))
    steep = np.exp(abs(rng.normal(0, 0.25)))
    return (turn @ jacobian @ _stretch(rng.uniform(0, np.pi), steep) * np.exp(rng.normal(0, 0.08))).astype(np.float32)


def _distant(rng: np.random.Generator, jacobian: Float32[ndarray, "2 2"]) -> Float32[ndarray, "2 2"]:
    """The map of the first surface: as given, or with periods up to twice as short or long, and other slopes."""
    if rng.random() < 0.65:
        return jacobian
    shortest = 1 / float(np.linalg.norm(jacobian, 2))  # period at its steepest, pixels
    scale = log_uniform(rng, max(0.5, _SHORTEST / shortest), 2.0)
    return (jacobian @ _stretch(rng.uniform(0, np.pi), rng.uniform(1, 1.2)) / scale).astype(np.float32)


def _defocus(rng: np.random.Generator, n: int, largest: float) -> Float32[ndarray, "n n"]:
    """Blur by the projector, sigma in periods: it grows with the distance from the depth at which it is sharp."""
    if largest == 0:
        return np.zeros((n, n), dtype=np.float32)
    depth = rng.uniform(-1, 1) + rng.uniform(0, 0.8) * smooth_field(rng, n, 1)
    return (0.02 + largest * np.minimum(np.abs(depth), 1.2)).astype(np.float32)


def _rotation(angle: float) -> Float32[ndarray, "2 2"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]], dtype=np.float32)


def _stretch(direction: float, factor: float) -> Float32[ndarray, "2 2"]:
    d = np.array([np.cos(direction), np.sin(direction)])
    return (np.eye(2) + (factor - 1) * np.outer(d, d)).astype(np.float32)


def _field(
    rng: np.random.Generator, x: Float32[ndarray, "n n"], y: Float32[ndarray, "n n"], jacobian: Float32[ndarray, "2 2"],
    centre: Float32[ndarray, "2"], parallax: float,
) -> tuple[Float32[ndarray, "n n 2"], Float32[ndarray, "n n"]]:  # fmt: skip
    """Coordinates of one surface, and its shading in (0, 1.2)."""
    n, extent = len(x), float(x[0, -1] - x[0, 0])
    tilt = rng.normal(0, 0.12, 2) / extent
    bend = rng.normal(0, 0.05) / extent**2
    far = 1 / (1 + np.float32(tilt[0]) * x + np.float32(tilt[1]) * y)
    scale = far * (1 + np.float32(bend) * (x * x + y * y))
    height = _relief(rng, x, y, extent)
    steepness = np.abs(np.diff(height, axis=0)).max() + np.abs(np.diff(height, axis=1)).max()
    step = x[0, 1] - x[0, 0]
    largest = 0.45 * np.linalg.norm(jacobian, 2) * step  # periods a step that relief may add
    height *= rng.uniform(0, 1) * largest / max(float(steepness), 1e-9)
    coords = np.empty((n, n, 2), dtype=np.float32)
    for axis, way in enumerate((np.cos(parallax), np.sin(parallax))):
        flat = (jacobian[axis, 0] * x + jacobian[axis, 1] * y) * scale
        coords[..., axis] = flat + np.float32(way) * height + np.float32(centre[axis])
    return coords, _shading(rng, height, largest, n)


def _relief(
    rng: np.random.Generator, x: Float32[ndarray, "n n"], y: Float32[ndarray, "n n"], extent: float
) -> Float32[ndarray, "n n"]:
    """Hills of several sizes, and folds with a sharp ridge."""
    n = len(x)
    height = smooth_field(rng, n, int(rng.integers(1, 4)))
    if rng.random() < 0.5:
        height = height + smooth_field(rng, n, int(rng.integers(4, 9))) * rng.uniform(0.05, 0.3)
    for _ in range(rng.choice(3, p=(0.5, 0.3, 0.2))):
        angle, place = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.4) * extent
        along = np.cos(angle) * x + np.sin(angle) * y - place
        height = height + np.abs(along).astype(np.float32) / extent * rng.uniform(-6, 6)
    return height.astype(np.float32)


def _shading(
    rng: np.random.Generator, height: Float32[ndarray, "n n"], largest: float, n: int
) -> Float32[ndarray, "n n"]:
    """Light on the slopes, as if it came from a random direction, and a slow change across the image."""
    gy, gx = np.gradient(height)
    angle = rng.uniform(0, 2 * np.pi)
    slope = (np.cos(angle) * gx + np.sin(angle) * gy) / largest
    slow = smooth_field(rng, n, 2) * rng.uniform(0, 0.25)
    return np.clip(rng.uniform(0.35, 1.0) + rng.uniform(0, 0.6) * slope + slow, 0.06, 1.2).astype(np.float32)


def _random_shape(
    rng: np.random.Generator, x: Float32[ndarray, "n n"], y: Float32[ndarray, "n n"], size: int
) -> Bool[ndarray, "n n"]:
    """A half plane, an ellipse, a bar, a blob, or a few thin bars that may be bent."""
    kind, angle = rng.integers(5), rng.uniform(0, 2 * np.pi)
    along, across = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    shift = rng.uniform(-0.45, 0.45, 2) * size
    if kind == 0:
        wave = rng.uniform(0, 0.1) * size * np.sin(across * (2 * np.pi / (size * rng.uniform(0.3, 1.5))))
        return along + wave > shift[0]
    if kind == 1:
        radii = size * rng.uniform(0.08, 0.45, 2)
        return ((along - shift[0]) / radii[0]) ** 2 + ((across - shift[1]) / radii[1]) ** 2 < 1
    if kind == 2:
        return np.abs(along - shift[0]) < size * rng.uniform(0.03, 0.2)
    if kind == 3:
        return smooth_field(rng, len(x), int(rng.integers(2, 6))) > rng.uniform(0.2, 1.0)
    return _thin_shapes(rng, len(x))


def _thin_shapes(rng: np.random.Generator, n: int) -> Bool[ndarray, "n n"]:
    """Wires, legs, stalks: lines from one side of the image to another, or ending within it."""
    drawn = np.zeros((n, n), dtype=np.uint8)
    for _ in range(rng.integers(1, 6)):
        start, end = rng.uniform(-0.1, 1.1, 2) * n, rng.uniform(-0.1, 1.1, 2) * n
        t = np.linspace(0, 1, 24)[:, None]
        bent = rng.normal(0, 0.15, 2) * n * 4 * t * (1 - t)
        line = np.rint(start + t * (end - start) + bent).astype(np.int32)
        cv2.polylines(drawn, [line], False, (1,), round(n * log_uniform(rng, 0.04, 0.2)))
    return drawn.astype(bool)


def _shadow(rng: np.random.Generator, shape: Bool[ndarray, "n n"], sampling: int) -> Bool[ndarray, "n n"]:
    """The shadow of a shape in the projector's light: the shape itself, shifted."""
    if rng.random() < 0.3:
        return np.zeros_like(shape)
    shift = rng.normal(0, 12 * sampling, 2)
    move = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], dtype=np.float32)
    moved = cv2.warpAffine(shape.astype(np.uint8), move, shape.shape[::-1], flags=cv2.INTER_NEAREST)
    return moved.astype(bool)


def _holes(rng: np.random.Generator, n: int) -> Bool[ndarray, "n n"]:
    """Patches that reflect no light: dark spots, gloss, dust."""
    return smooth_field(rng, n, int(rng.integers(8, 24))) > rng.uniform(1.2, 2.2)
