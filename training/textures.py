"""Random fields, and textures made of them: natural ones, and prints at the scales of the grid."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray


def smooth_field(rng: np.random.Generator, size: int, knots: int) -> Float32[ndarray, "n n"]:
    """Random values of unit variance at `knots` x `knots` places, smoothly interpolated to `size` x `size`."""
    coarse = rng.standard_normal((knots + 3, knots + 3)).astype(np.float32)
    step, start = knots / size, rng.uniform(0.5, 1.5, 2)
    place = np.array([[step, 0, start[0]], [0, step, start[1]]], dtype=np.float32)
    return cv2.warpAffine(coarse, place, (size, size), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A random number whose logarithm is uniform between those of `low` and `high`."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


_LETTERS = np.array(list("ABCDEFGHKLMNPRSTUXYZabdeghkmnprstuw0123456789#%&+="))
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)


def natural(rng: np.random.Generator, n: int) -> Float32[ndarray, "n n"]:
    """Blotches of every size, such as stone and skin, or drawn out in one direction, such as wood."""
    steep, field, knots = rng.uniform(0.6, 1.4), np.zeros((n, n), dtype=np.float32), int(rng.integers(2, 6))
    first = knots
    while knots < n / 2:
        field += smooth_field(rng, n, knots) * np.float32((first / knots) ** steep)
        knots *= 2
    if rng.random() < 0.3:
        affine, flags = _random_affine(rng, n, log_uniform(rng, 4, 12)), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        drawn_out = cv2.warpAffine(field, affine, (n, n), flags=flags, borderMode=cv2.BORDER_REFLECT_101)
        field = np.sin(drawn_out * np.float32(rng.uniform(1, 8))) if rng.random() < 0.5 else drawn_out
    field /= max(float(field.std()), 1e-6)
    return np.exp(-rng.uniform(0.05, 0.5) * np.clip(1.5 - field, 0, 4)).astype(np.float32)


def printed(rng: np.random.Generator, n: int, period: float) -> Float32[ndarray, "n n"]:
    """Checks, stripes, dots, another grid, or letters, in ink of some darkness."""
    kind: Callable[..., Float32[ndarray, "n n"]] = (_checks, _stripes, _dots, _grid, _text)[rng.integers(5)]
    ink = kind(rng, n, period * log_uniform(rng, 0.3, 4.0))
    return (1 - rng.uniform(0.25, 0.95) * ink).astype(np.float32)


def _checks(rng: np.random.Generator, n: int, width: float) -> Float32[ndarray, "n n"]:
    u, v = _directions(rng, n, width)
    return ((np.floor(u) + np.floor(v)) % 2).astype(np.float32)


def _stripes(rng: np.random.Generator, n: int, width: float) -> Float32[ndarray, "n n"]:
    u, _ = _directions(rng, n, width)
    share = rng.uniform(0.15, 0.85)
    if rng.random() < 0.4:  # of different widths, such as a bar code
        return (rng.random(4096)[np.floor(2 * u).astype(np.int64) % 4096] < share).astype(np.float32)
    return (u % 1 < share).astype(np.float32)


def _dots(rng: np.random.Generator, n: int, width: float) -> Float32[ndarray, "n n"]:
    u, v = _directions(rng, n, width)
    return (np.hypot(u % 1 - 0.5, v % 1 - 0.5) < rng.uniform(0.15, 0.45)).astype(np.float32)


def _grid(rng: np.random.Generator, n: int, width: float) -> Float32[ndarray, "n n"]:
    """Joints of tiles or bricks: lines that are not the pattern's; dark, or bright on dark tiles."""
    u, v = _directions(rng, n, width)
    u = u * rng.uniform(0.4, 1.0)
    if rng.random() < 0.4:
        u = u + 0.5 * (np.floor(v) % 2)
    joint = rng.uniform(0.05, 0.25)
    lines = ((u % 1 < joint) | (v % 1 < joint)).astype(np.float32)
    return 1 - lines if rng.random() < 0.5 else lines


def _text(rng: np.random.Generator, n: int, height: float) -> Float32[ndarray, "n n"]:
    page = np.zeros((n, n), dtype=np.uint8)
    height = float(np.clip(height, 6, n / 3))
    font, bold = int(rng.choice(_FONTS)), max(1, round(height * rng.uniform(0.06, 0.2)))
    for line in range(int(n / (1.4 * height)) + 1):
        words = "".join(rng.choice(_LETTERS, max(4, int(1.6 * n / height))))
        at = (round(rng.uniform(-height, 0)), round((1.4 * line + 1) * height))
        cv2.putText(page, words, at, font, height / 22, (255,), bold, cv2.LINE_AA)
    turned = cv2.warpAffine(page, _random_affine(rng, n, 1.0), (n, n), borderMode=cv2.BORDER_REFLECT_101)
    return turned.astype(np.float32) / 255


def _directions(
    rng: np.random.Generator, n: int, width: float
) -> tuple[Float32[ndarray, "n n"], Float32[ndarray, "n n"]]:
    """Two coordinates, in units of `width`, that are turned, foreshortened and slightly bent."""
    y, x = (np.mgrid[:n, :n] / np.float32(width)).astype(np.float32)
    bend = np.float32(rng.uniform(0, 0.15) * n / width) * smooth_field(rng, n, 2)
    angle, squeeze = rng.uniform(0, np.pi), rng.uniform(1, 2)
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    return c * x + s * y + bend, np.float32(squeeze) * (c * y - s * x) + np.float32(rng.uniform(0, 4))


def _random_affine(rng: np.random.Generator, n: int, squeeze: float) -> Float32[ndarray, "2 3"]:
    """A turn about the middle, after which one direction is squeezed."""
    angle = rng.uniform(0, 2 * np.pi)
    linear = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([1, 1 / squeeze])
    middle = np.full(2, n / 2)
    return np.hstack([linear, (middle - linear @ middle)[:, None]]).astype(np.float32)
