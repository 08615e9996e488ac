"""Captures turned and scaled to the roll and period that the network was trained on.

The grid of a capture appears as peaks in the local power spectrum. They give its period and its roll up to quarter
turns; the symbols decide between the quarter turns later.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from sl_nerfstudio.decoding.grid.channels import RECTIFIED_PERIOD
from sl_nerfstudio.decoding.grid.unet import MULTIPLE

# Local power spectra.
_TILE = 128  # side of a tile, pixels
_STEP = 64  # between two tiles
_WEAKEST = 1e-3  # contrast of a tile, relative to the brightest pixel, below which it is ignored
# Their polar form.
PERIODS = (5.5, 40.0)
"""Pixels: the shortest and the longest period that is searched."""
_ANGLES, _RADII = 90, 72  # samples: angles over half a turn, periods on a logarithmic scale
# The peaks.
_LEAST_PEAK = 0.2  # of the highest one
_PEAK_RADII, _PEAK_ANGLES = 9, 8  # samples around a peak that count as the same one
_LARGEST_SIDE = 3000  # of a rectified image, pixels


@dataclass(frozen=True)
class GridAppearance:
    """How the grid appears in an image."""

    period: float  # pixels
    roll: float  # radian, clockwise, of the lines that are closest to horizontal; within an eighth of a turn


@dataclass(frozen=True)
class RectifiedImage:
    """An image turned and scaled; `from_image` maps pixels (x, y, 1) of the original to its own, centres at .5."""

    image: Float32[ndarray, "h w"]
    from_image: Float64[ndarray, "2 3"]


def guess_appearances(image: Float32[ndarray, "h w"], count: int = 3) -> list[GridAppearance]:
    """The most probable appearances of the grid, best first; none for an image without contrast."""
    power = _local_power(image)
    if power is None:
        return []
    polar = _polar(power)  # radii, angles over half a turn
    half = _ANGLES // 2
    # Both families of lines must be present.
    both = np.sqrt(polar[:, :half] * polar[:, half:]) + 0.1 * (polar[:, :half] + polar[:, half:])
    both = cv2.GaussianBlur(np.hstack([both[:, -8:], both, both[:, :8]]), (0, 0), 2.0)[:, 8:-8]
    found: list[GridAppearance] = []
    left = both.copy()
    for _ in range(count):
        r, a = np.unravel_index(int(left.argmax()), left.shape)
        if left[r, a] <= _LEAST_PEAK * both.max():
            break
        angle = a * np.pi / _ANGLES
        roll = float(angle if angle <= np.pi / 4 else angle - np.pi / 2)
        found.append(GridAppearance(float(1 / _frequencies()[r]), roll))
        far = np.abs(np.arange(half) - a)
        left[max(r - _PEAK_RADII, 0) : r + _PEAK_RADII + 1, np.minimum(far, half - far) < _PEAK_ANGLES] = 0
    return found


def rectify(image: Float32[ndarray, "h w"], appearance: GridAppearance) -> RectifiedImage:
    """The image turned upright and scaled until a period measures `RECTIFIED_PERIOD` pixels."""
    h, w = image.shape
    c, s = np.cos(-appearance.roll), np.sin(-appearance.roll)
    reach = max(abs(w * c) + abs(h * s), abs(w * s) + abs(h * c))
    scale = min(RECTIFIED_PERIOD / appearance.period, _LARGEST_SIDE / reach)
    linear = scale * np.array([[c, -s], [s, c]])
    corners = linear @ np.array([[0, w, 0, w], [0, 0, h, h]], dtype=np.float64)
    low, size = corners.min(1), np.ceil((corners.max(1) - corners.min(1)) / MULTIPLE).astype(int) * MULTIPLE
    from_image = np.hstack([linear, -low[:, None]])
    source = image if scale >= 0.8 else cv2.GaussianBlur(image, (0, 0), 0.45 * np.sqrt(1 / scale**2 - 1))
    flags = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_LINEAR
    moved = cv2.warpAffine(source, integer_centres(from_image), (int(size[0]), int(size[1])), flags=flags,
                           borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    return RectifiedImage(np.maximum(moved, 0), from_image)


def integer_centres(affine: Float64[ndarray, "2 3"]) -> Float64[ndarray, "2 3"]:
    """The same map for pixel coordinates whose first centre is 0, as in OpenCV."""
    out = affine.copy()
    out[:, 2] += affine[:, :2] @ np.array([0.5, 0.5]) - 0.5
    return out


def _local_power(image: Float32[ndarray, "h w"]) -> Float32[ndarray, "t t"] | None:
    """Mean power spectrum of overlapping tiles, each weighted by its contrast, not by its brightness."""
    h, w = image.shape
    padded = cv2.copyMakeBorder(image, 0, max(_TILE - h, 0), 0, max(_TILE - w, 0), cv2.BORDER_REFLECT_101)
    window = np.outer(np.hanning(_TILE), np.hanning(_TILE)).astype(np.float32)
    noise = _WEAKEST * max(float(padded.max()), 1e-6)
    total, weights = np.zeros((_TILE, _TILE), dtype=np.float32), 0.0
    for top in range(0, padded.shape[0] - _TILE + 1, _STEP):
        for left in range(0, padded.shape[1] - _TILE + 1, _STEP):
            tile = padded[top : top + _TILE, left : left + _TILE]
            slow = cv2.GaussianBlur(tile, (0, 0), PERIODS[1] / 3)
            flat = (tile - slow) * window
            power = float((flat * flat).sum())
            if power < (noise * _TILE) ** 2:
                continue
            spectrum = np.abs(np.fft.fft2(flat)) ** 2
            weight = power**0.25
            total += (weight / power) * spectrum.astype(np.float32)
            weights += weight
    return np.fft.fftshift(total) / np.float32(weights) if weights > 0 else None


def _frequencies() -> Float64[ndarray, "radii"]:
    return np.exp(np.linspace(np.log(1 / PERIODS[1]), np.log(1 / PERIODS[0]), _RADII))


def _polar(power: Float32[ndarray, "t t"]) -> Float32[ndarray, "radii angles"]:
    """Power by frequency and by the angle of the lines' normal over half a turn; the background is flattened."""
    radius = _frequencies()[:, None] * _TILE
    angle = np.arange(_ANGLES) * np.pi / _ANGLES
    x, y = radius * np.cos(angle) + _TILE // 2, radius * np.sin(angle) + _TILE // 2
    polar = cv2.remap(power, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    return np.maximum(polar - np.median(polar, axis=1, keepdims=True), 0)
