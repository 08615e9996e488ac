"""Phases and symbols as the U-Net reads them in a rectified image, and their values at the pixels of the capture."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int32
from numpy import ndarray
from torch import Tensor, nn
from torch.nn import functional as F

from sl_nerfstudio.decoding.decoder import Coords, Layer, Mask
from sl_nerfstudio.decoding.grid_graph import GridGraph, PhaseMaps, phase_maps
from sl_nerfstudio.parallel import DeviceName, compiled
from sl_nerfstudio.pattern.codes import SYMBOLS
from sl_nerfstudio.pattern.grid import GridPattern

# The two input channels of the U-Net: local contrast and brightness of an image.

RECTIFIED_PERIOD = 14.0
"""Median period of the grid, in pixels, in the images that the network is given."""
CHANNELS = 2
_WINDOW = 0.8  # of the local statistics, in periods
_FLOOR = 0.015  # of the full brightness: weaker contrast is treated as none


def network_channels(image: Layer, full: float | None = None) -> Float32[ndarray, "2 h w"]:
    """Local contrast and brightness of a rectified image whose intensities are at least 0.

    `full` is the intensity of brightly lit lines, by default the 99.5 % quantile of the image.
    """
    bright = max(float(np.quantile(image, 0.995)) if full is None else full, 1e-4)
    sigma = _WINDOW * RECTIFIED_PERIOD
    mean = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
    spread = image - mean
    variance = cv2.GaussianBlur(spread * spread, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
    contrast = np.clip(spread / (2 * (np.sqrt(np.maximum(variance, 0)) + _FLOOR * bright)), -2, 2)
    return np.stack([contrast, np.sqrt(np.clip(image / bright, 0, 2))]).astype(np.float32)


# The U-Net: where in a rectified image the pattern is, the phases of its grid, and the symbols.

STRIDE = 2
"""Pixels of the image per pixel of the network's maps."""
_WIDTHS = (16, 32, 64, 96)
MULTIPLE = STRIDE * 2 ** (len(_WIDTHS) - 1)
"""Width and height of the image must be multiples of this."""


class NetworkOutput(NamedTuple):
    """Prediction of the network, at half the resolution of its input; places lie where four pixels meet."""

    mask: Float[Tensor, "b h w"]  # logit: the pattern is here
    phase: Float[Tensor, "b 4 h w"]  # cosine and sine of the phase in x, then in y; both 0 where unknown
    symbol: Float[Tensor, "b 5 h w"]  # logits of the symbol of the nearest node


class LevelNetwork(nn.Module):
    """Levels of two 3 x 3 convolutions, down and up again; the image enters with 2 x 2 pixels folded into channels."""

    def __init__(self, channels: int, widths: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        self.down = nn.ModuleList(
            ConvolutionPair(n_in, n_out) for n_in, n_out in pairwise((channels * STRIDE**2, *widths))
        )
        self.up = nn.ModuleList(ConvolutionPair(deep + own, own) for own, deep in pairwise(widths))
        self.head = nn.Conv2d(widths[0], outputs, 1)

    def maps(self, channels: Float[Tensor, "b c h2 w2"]) -> Float[Tensor, "b outputs h w"]:
        """The outputs at half the resolution of the image."""
        x = F.pixel_unshuffle(channels, STRIDE)
        kept: list[Tensor] = []
        for level, block in enumerate(self.down):
            x = block(x if level == 0 else F.max_pool2d(x, 2))
            kept.append(x)
        for level in reversed(range(len(self.up))):
            larger = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = self.up[level](torch.cat([larger, kept[level]], 1))
        return self.head(x)


class UNet(LevelNetwork):
    """Four levels, for images whose sides are multiples of `MULTIPLE`."""

    def __init__(self) -> None:
        super().__init__(CHANNELS, _WIDTHS, 1 + 4 + SYMBOLS)

    def forward(self, channels: Float[Tensor, "b 2 h2 w2"]) -> NetworkOutput:
        """Predict for images whose sides are multiples of `MULTIPLE`."""
        out = self.maps(channels)
        return NetworkOutput(out[:, 0], out[:, 1:5], out[:, 5:])


Maps = Callable[[Float32[ndarray, "c h2 w2"]], Float32[ndarray, "h w outputs"]]
"""A network as a function of arrays: its outputs at half the resolution of the image."""


class NetworkOnDevice:
    """A network as `Maps`, wherever it computes."""

    def __init__(self, network: LevelNetwork, device: DeviceName = "cpu") -> None:
        self._network, self._device = network.to(device), device

    def __call__(self, channels: Float32[ndarray, "c h2 w2"]) -> Float32[ndarray, "h w outputs"]:
        """Its outputs; a GPU computes with all digits of float32, too."""
        image = torch.from_numpy(channels)[None].contiguous(memory_format=torch.channels_last)
        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            return self._network.maps(image.to(self._device))[0].permute(1, 2, 0).cpu().numpy()


class ConvolutionPair(nn.Sequential):
    """Two convolutions, each followed by batch normalisation and a rectifier."""

    def __init__(self, n_in: int, n_out: int) -> None:
        super().__init__(
            nn.Conv2d(n_in, n_out, 3, padding=1, bias=False),
            nn.BatchNorm2d(n_out),
            nn.ReLU(inplace=True),
            nn.Conv2d(n_out, n_out, 3, padding=1, bias=False),
            nn.BatchNorm2d(n_out),
            nn.ReLU(inplace=True),
        )


# Coordinates in the pattern as the camera sees it: turned by quarter turns until its lines are as in the image.


def to_pattern(turned: Float32[ndarray, "*n 2"], grid: GridPattern, turn: int) -> Float32[ndarray, "*n 2"]:
    """Pattern pixels of places (x, y), in periods, in the array of nodes after `turn` quarter turns."""
    x, y = turned[..., 0], turned[..., 1]
    last_i, last_j = grid.rows - 1, grid.columns - 1
    i, j = ((y, x), (last_i - x, y), (last_i - y, last_j - x), (x, last_j - y))[turn]
    return np.stack([grid.x0 + j * grid.period, grid.y0 + i * grid.period], -1).astype(np.float32)


def from_pattern(coords: Float32[ndarray, "*n 2"], grid: GridPattern, turn: int) -> Float32[ndarray, "*n 2"]:
    """The inverse of `to_pattern`."""
    j, i = (coords[..., 0] - grid.x0) / grid.period, (coords[..., 1] - grid.y0) / grid.period
    last_i, last_j = grid.rows - 1, grid.columns - 1
    x, y = ((j, i), (last_i - i, j), (last_j - j, last_i - i), (i, last_j - j))[turn]
    return np.stack([x, y], -1).astype(np.float32)


# Phase unwrapping: from nodes whose place is known to coordinates of all pixels.
#
# The coordinate of a pixel is a whole number plus its phase. The whole number spreads from the nodes over
# neighbouring pixels as long as the phase changes smoothly.

_LARGEST_STEP = 0.3  # periods between two neighbouring pixels
_FARTHEST = 2.0  # periods from the node


def spread(phase: Coords, seen: Mask, pixel: Int32[ndarray, "n 2"], place: Int32[ndarray, "n 2"]) -> Coords:
    """Coordinates (x, y) in periods; NaN where no node reaches.

    `phase` is from -0.5 to 0.5 periods; `pixel` (row, column) shows the node at `place` (row, column) of the pattern.
    """
    coords = np.full(phase.shape, np.nan, dtype=np.float32)
    _spread(phase, seen, pixel, place, coords, np.float32(_LARGEST_STEP), np.float32(_FARTHEST))
    return coords


@compiled
def _spread(
    phase: ndarray, seen: ndarray, pixel: ndarray, place: ndarray, coords: ndarray, largest_step: float, farthest: float
) -> None:
    """Breadth first: every pixel is reached from the nearest node, counted in pixels."""
    h, w = seen.shape
    queue = np.empty((h * w, 3), dtype=np.int32)
    end = 0
    for k in range(len(pixel)):
        r, c = pixel[k, 0], pixel[k, 1]
        if 0 <= r < h and 0 <= c < w and seen[r, c] and np.isnan(coords[r, c, 0]):
            coords[r, c, 0] = place[k, 1] + phase[r, c, 0]
            coords[r, c, 1] = place[k, 0] + phase[r, c, 1]
            queue[end, 0], queue[end, 1], queue[end, 2] = r, c, k
            end += 1
    start = 0
    while start < end:
        r, c, k = queue[start, 0], queue[start, 1], queue[start, 2]
        start += 1
        for d in range(4):
            rr = r + (d == 1) - (d == 3)
            cc = c + (d == 0) - (d == 2)
            if rr < 0 or cc < 0 or rr >= h or cc >= w or not seen[rr, cc] or not np.isnan(coords[rr, cc, 0]):
                continue
            dx = phase[rr, cc, 0] - phase[r, c, 0]
            dy = phase[rr, cc, 1] - phase[r, c, 1]
            dx -= np.rint(dx)
            dy -= np.rint(dy)
            x, y = coords[r, c, 0] + dx, coords[r, c, 1] + dy
            if max(abs(dx), abs(dy)) > largest_step or max(abs(x - place[k, 1]), abs(y - place[k, 0])) > farthest:
                continue
            coords[rr, cc, 0], coords[rr, cc, 1] = x, y
            queue[end, 0], queue[end, 1], queue[end, 2] = rr, cc, k
            end += 1


# Captures turned and scaled to the roll and period that the network was trained on.
#
# The grid of a capture appears as peaks in the local power spectrum. They give its period and its roll up to quarter
# turns; the symbols decide between the quarter turns later.

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
    """Appearance of the grid in an image."""

    period: float  # pixels
    roll: float  # radian, clockwise, of the lines that are closest to horizontal; within an eighth of a turn


@dataclass(frozen=True)
class RectifiedImage:
    """An image turned and scaled; `from_image` maps pixels (x, y, 1) of the original to its own, centres at .5."""

    image: Layer
    from_image: Float64[ndarray, "2 3"]


def guess_appearances(image: Layer, count: int = 3) -> list[GridAppearance]:
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


def rectify(image: Layer, appearance: GridAppearance) -> RectifiedImage:
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
    """Convert a map to pixel coordinates whose first centre is 0, as in OpenCV."""
    out = affine.copy()
    out[:, 2] += affine[:, :2] @ np.array([0.5, 0.5]) - 0.5
    return out


def _local_power(image: Layer) -> Float32[ndarray, "t t"] | None:
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


# Pixels of the capture that are used.
LEAST_MASK = 0.4
"""Probability above which a pixel shows the pattern."""
_LEAST_VECTOR = 0.35  # length of a phase's (cosine, sine) below which the phase is unknown
# Places of the maps by which the grid's appearance is measured: only clear ones.
_CLEAR_MASK, _CLEAR_VECTOR = 0.5, 0.6
_FEWEST = 12


@dataclass(frozen=True)
class PixelPhases:
    """Phases at the pixels of the capture."""

    phase: Coords  # periods, from -0.5 to 0.5
    probability: Layer  # that the pattern is there
    clear: Mask  # the pattern is there and its phases are known


def predict_maps(rectified: RectifiedImage, network: Maps) -> PhaseMaps:
    """Mask, phases and symbols of a rectified image, by the U-Net."""
    output = np.moveaxis(network(network_channels(rectified.image)), -1, 0)
    mask = torch.sigmoid(torch.from_numpy(output[0]))
    return phase_maps(mask.numpy(), np.ascontiguousarray(output[1:5]), np.ascontiguousarray(output[5:]))


def clear_places(maps: PhaseMaps) -> Mask:
    """Places of the maps at which the network is certain."""
    return (maps.mask > _CLEAR_MASK) & (np.hypot(maps.vector[0], maps.vector[1]) > _CLEAR_VECTOR)


def node_places(maps: PhaseMaps, graph: GridGraph, chosen: Bool[ndarray, "n"]) -> Mask:
    """The places of the chosen nodes of a graph."""
    where = np.zeros(maps.mask.shape, dtype=bool)
    column, row = np.rint(graph.place[chosen]).astype(int).T
    where[np.clip(row, 0, where.shape[0] - 1), np.clip(column, 0, where.shape[1] - 1)] = True
    return where


def measure_appearance(maps: PhaseMaps, guess: GridAppearance, where: Mask) -> GridAppearance | None:
    """Period and roll of the grid in the capture by the phases at some places; `guess` is what it was rectified by.

    None where there are hardly any places.
    """
    if where.sum() < _FEWEST:
        return None
    jacobian = np.moveaxis(maps.gradient[:, :, where], -1, 0) / STRIDE
    area = np.median(np.abs(np.linalg.det(jacobian)))
    middle = np.median(jacobian, axis=0)
    # Directions of the lines of constant y and of constant x, each as an angle from its own axis.
    tilt = np.arctan2(-middle[1, 0], middle[1, 1]), np.arctan2(middle[0, 1], middle[0, 0])
    period = guess.period * float(np.clip(area, 1e-4, 1) ** -0.5) / RECTIFIED_PERIOD
    return GridAppearance(period, guess.roll + float(np.mean(tilt)))


def sample_pixels(maps: PhaseMaps, rectified: RectifiedImage, shape: tuple[int, int]) -> PixelPhases:
    """Bilinear values of the maps at the pixels of the capture, which has the given `shape` (h, w)."""
    matrix = map_from_pixels(rectified)
    layers = np.dstack([maps.mask, *maps.vector])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    parts = [
        np.atleast_3d(cv2.warpAffine(np.ascontiguousarray(layers[..., k]), matrix, shape[::-1], flags=flags))
        for k in (slice(0, 1), slice(1, 5))
    ]
    mask, vector = parts[0][..., 0], parts[1]
    phase = np.stack([np.arctan2(vector[..., 1], vector[..., 0]), np.arctan2(vector[..., 3], vector[..., 2])], -1)
    strength = np.minimum(np.hypot(vector[..., 0], vector[..., 1]), np.hypot(vector[..., 2], vector[..., 3]))
    clear = (mask > LEAST_MASK) & (strength > _LEAST_VECTOR)
    return PixelPhases((phase / (2 * np.pi)).astype(np.float32), mask, clear)


def map_from_pixels(rectified: RectifiedImage) -> Float64[ndarray, "2 3"]:
    """Map from pixels (x, y, 1) of the capture to places in the network's maps; in both the first centre is 0."""
    to_map = np.array([[1 / STRIDE, 0, 0.5 / STRIDE - 0.5], [0, 1 / STRIDE, 0.5 / STRIDE - 0.5]])
    return to_map @ np.vstack([integer_centres(rectified.from_image), [0.0, 0.0, 1.0]])


def to_pixel_coordinates(place: Float32[ndarray, "n 2"], rectified: RectifiedImage) -> Float32[ndarray, "n 2"]:
    """Places (x, y) in the maps as continuous pixel coordinates of the capture (centres at .5)."""
    linear, shift = rectified.from_image[:, :2], rectified.from_image[:, 2]
    return np.linalg.solve(linear, (STRIDE * (place + 0.5) - shift).T).T.astype(np.float32)
