"""Decoded coordinate images of all frames, looked up between pixels.

A look-up fits a plane to the decoded pixels of a small window: this averages the decoding noise,
gives the derivative with respect to the pixel, and shows where the map is torn (edges, wrong cells).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.calibration.compiled import compiled

_HALF_WINDOW = 2  # pixels: 5 x 5 windows
_MIN_PIXELS = 10  # decoded pixels a window must hold
_MAX_ROUGHNESS = 2.0  # projector pixels: RMS distance of a window's pixels from their plane


@dataclass(frozen=True)
class MapSample:
    """Coordinates looked up at some positions."""

    uv_projector: Float[Tensor, "n 2"]
    jacobian: Float[Tensor, "n 2 2"]  # d uv_projector / d uv_camera
    valid: Bool[Tensor, "n"]  # enough decoded pixels, and they lie on a plane


@dataclass(frozen=True)
class CoordinateMaps:
    """Coordinate images of all frames (sizes may differ), NaN where not decoded."""

    values: Float[Tensor, "pixels 2"]  # all frames one after the other, rows first
    offsets: Int[Tensor, "frames"]
    widths: Int[Tensor, "frames"]
    heights: Int[Tensor, "frames"]

    @staticmethod
    def of(images: Sequence[Float[Tensor, "_h _w 2"]]) -> "CoordinateMaps":
        """From one image per frame; sizes may differ."""
        sizes = torch.tensor([i.shape[0] * i.shape[1] for i in images])
        return CoordinateMaps(
            values=torch.cat([i.reshape(-1, 2) for i in images]).float(),
            offsets=torch.cumsum(sizes, 0) - sizes,
            widths=torch.tensor([i.shape[1] for i in images]),
            heights=torch.tensor([i.shape[0] for i in images]),
        )

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.offsets)

    def draw(self, frame: int, count: int, generator: torch.Generator) -> Float[Tensor, "n 2"]:
        """Up to `count` random decoded pixel centres of a frame, one for each occupied square of a lattice."""
        w, h = int(self.widths[frame]), int(self.heights[frame])
        start = int(self.offsets[frame])
        decoded = torch.isfinite(self.values[start : start + w * h, 0]).nonzero().squeeze(-1)
        if len(decoded) == 0:
            return torch.zeros(0, 2, dtype=torch.float64)
        step = max(1, int((len(decoded) / count) ** 0.5))
        decoded = decoded[torch.randperm(len(decoded), generator=generator)]
        square = decoded // w // step * (w // step + 1) + decoded % w // step
        order = torch.argsort(square, stable=True)
        first = torch.ones(len(order), dtype=torch.bool)
        first[1:] = square[order][1:] != square[order][:-1]
        chosen = decoded[order[first]]
        chosen = chosen[torch.randperm(len(chosen), generator=generator)[:count]]
        return torch.stack([chosen % w + 0.5, chosen // w + 0.5], -1).double()

    def look_up(self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"]) -> MapSample:
        """Plane fits around positions in the camera images of `frame`; invalid outside the image."""
        n = len(frame)
        plane = np.zeros((n, 3, 2))
        valid = np.zeros(n, dtype=np.bool_)
        _fit_planes(
            self.values.numpy(),
            self.offsets.numpy(),
            self.widths.numpy(),
            self.heights.numpy(),
            frame.numpy(),
            uv_camera.detach().double().numpy(),
            plane,
            valid,
        )
        fitted = torch.from_numpy(plane)
        return MapSample(fitted[:, 0], fitted[:, 1:].transpose(1, 2), torch.from_numpy(valid))

    def decoded_at(self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """The decoded coordinate of the pixel under each position; NaN outside the image."""
        w, h, start = self.widths[frame], self.heights[frame], self.offsets[frame]
        inside = (uv_camera >= 0).all(-1) & (uv_camera[:, 0] < w) & (uv_camera[:, 1] < h)
        uv = torch.where(inside[:, None], uv_camera, torch.zeros_like(uv_camera)).long()
        found = self.values[start + uv[:, 1] * w + uv[:, 0]].double()
        return torch.where(inside[:, None], found, torch.full_like(found, float("nan")))


@compiled
def _fit_planes(values, offsets, widths, heights, frame, uv, plane, valid):
    """Least-squares planes `c0 + cx dx + cy dy` around each position, from its window's decoded pixels."""
    for k in numba.prange(len(frame)):
        f, px, py = frame[k], uv[k, 0], uv[k, 1]
        w, h = widths[f], heights[f]
        if not (px >= 0 and py >= 0 and px < w and py < h):
            continue
        column, row = int(px), int(py)
        n = sx = sy = sxx = sxy = syy = 0.0
        a0 = ax = ay = aa = b0 = bx = by = bb = 0.0
        origin_a = origin_b = np.nan
        for y in range(max(row - _HALF_WINDOW, 0), min(row + _HALF_WINDOW + 1, h)):
            for x in range(max(column - _HALF_WINDOW, 0), min(column + _HALF_WINDOW + 1, w)):
                pixel = offsets[f] + y * w + x
                a, b = float(values[pixel, 0]), float(values[pixel, 1])
                if not (np.isfinite(a) and np.isfinite(b)):
                    continue
                if n == 0.0:
                    origin_a, origin_b = a, b  # keeps the sums small
                a, b = a - origin_a, b - origin_b
                dx, dy = x + 0.5 - px, y + 0.5 - py
                n += 1.0
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
                a0 += a
                ax += a * dx
                ay += a * dy
                aa += a * a
                b0 += b
                bx += b * dx
                by += b * dy
                bb += b * b
        # inverse of the symmetric [[n, sx, sy], [sx, sxx, sxy], [sy, sxy, syy]] by cofactors
        c00, c01, c02 = sxx * syy - sxy * sxy, sxy * sy - sx * syy, sx * sxy - sxx * sy
        c11, c12, c22 = n * syy - sy * sy, sx * sy - n * sxy, n * sxx - sx * sx
        det = n * c00 + sx * c01 + sy * c02
        if n < _MIN_PIXELS or det < 1e-3 * n:
            continue
        a_0, a_x, a_y = (
            (c00 * a0 + c01 * ax + c02 * ay) / det,
            (c01 * a0 + c11 * ax + c12 * ay) / det,
            (c02 * a0 + c12 * ax + c22 * ay) / det,
        )
        b_0, b_x, b_y = (
            (c00 * b0 + c01 * bx + c02 * by) / det,
            (c01 * b0 + c11 * bx + c12 * by) / det,
            (c02 * b0 + c12 * bx + c22 * by) / det,
        )
        plane[k, 0, 0], plane[k, 1, 0], plane[k, 2, 0] = a_0 + origin_a, a_x, a_y
        plane[k, 0, 1], plane[k, 1, 1], plane[k, 2, 1] = b_0 + origin_b, b_x, b_y
        rough2 = (aa - a_0 * a0 - a_x * ax - a_y * ay + bb - b_0 * b0 - b_x * bx - b_y * by) / n
        valid[k] = rough2 < _MAX_ROUGHNESS * _MAX_ROUGHNESS
