"""Decoded coordinate images of all frames, looked up between pixels.

A look-up fits a paraboloid to the decoded pixels of a small window: this averages the decoding noise,
provides the derivative with respect to the pixel, and shows where the map is discontinuous (edges, wrong
cells). (A plane would average better, but on a curved surface it is off by the same amount everywhere, and
the adjustment would turn that offset into wrong poses.)
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.loops.borders import border_distances
from sl_nerfstudio.bundle_adjustment.loops.drawing import draw_pixels
from sl_nerfstudio.bundle_adjustment.loops.windows import WindowMemory, look_up_windows
from sl_nerfstudio.bundle_adjustment.settings import LookUpSettings
from sl_nerfstudio.files.large_arrays import GrowingArray, largest_in_memory


@dataclass(frozen=True)
class MapSample:
    """Coordinates looked up at some positions."""

    uv_projector: Float[Tensor, "n 2"]
    jacobian: Float[Tensor, "n 2 2"]  # d uv_projector / d uv_camera
    valid: Bool[Tensor, "n"]  # enough decoded pixels, and a paraboloid fits them


@dataclass(frozen=True)
class DrawnPixels:
    """Centres of some pixels of some frames."""

    frame: Int[Tensor, "n"]
    uv_camera: Float[Tensor, "n 2"]


@dataclass(frozen=True)
class CoordinateMaps:
    """Coordinate images of all frames (sizes may differ), NaN where not decoded."""

    values: Float[Tensor, "pixels 2"]  # all frames one after the other, rows first
    offsets: Int[Tensor, "frames"]
    widths: Int[Tensor, "frames"]
    heights: Int[Tensor, "frames"]
    settings: LookUpSettings
    max_roughness: float  # projector pixels; rougher windows are discontinuous

    @staticmethod
    def of(images: Iterable[Float[Tensor, "_h _w 2"]], settings: LookUpSettings | None = None) -> "CoordinateMaps":
        """From one image per frame; sizes may differ. What is too large for memory is kept in a file."""
        settings = settings or LookUpSettings()
        values, shapes = GrowingArray(largest_in_memory()), []
        for image in images:
            shapes.append(image.shape[:2])
            values.append(image.reshape(-1, 2).float().numpy())
        heights, widths = torch.tensor(shapes).T
        sizes = widths * heights
        maps = CoordinateMaps(
            values=torch.from_numpy(values.whole()),
            offsets=torch.cumsum(sizes, 0) - sizes,
            widths=widths.contiguous(),
            heights=heights.contiguous(),
            settings=settings,
            max_roughness=settings.roughness_px,
        )
        return maps._with_usual_roughness(settings)

    def _with_usual_roughness(self, settings: LookUpSettings) -> "CoordinateMaps":
        """With other settings; windows count as discontinuous that are much rougher than the median one."""
        maps = replace(self, settings=settings)
        return replace(
            maps, max_roughness=max(settings.roughness_px, settings.roughness_medians * maps._median_roughness())
        )

    def with_windows(self, half_window: int) -> "CoordinateMaps":
        """The same images, looked up in windows of another size, as full of decoded pixels as before."""
        growth = (2 * half_window + 1) / (2 * self.settings.half_window + 1)
        least = round(self.settings.least_pixels * growth**2)
        return self._with_usual_roughness(replace(self.settings, half_window=half_window, least_pixels=least))

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.offsets)

    def draw(self, frames: Int[Tensor, "m"], count: int, generator: torch.Generator) -> "DrawnPixels":
        """Up to `count` random decoded pixel centres of some frames each, at most one in each square of a lattice."""
        pixels, counts = np.zeros((len(frames), count), dtype=np.int64), np.zeros(len(frames), dtype=np.int64)
        draw_pixels(len(frames), frames.numpy(), *self.arrays, seed_from(generator), pixels, counts)
        frame = torch.repeat_interleave(frames, torch.from_numpy(counts))
        pixel = torch.from_numpy(pixels[np.arange(count) < counts[:, None]])
        w = self.widths[frame]
        return DrawnPixels(frame, torch.stack([pixel % w + 0.5, pixel // w + 0.5], -1).double())

    def image(self, frame: int) -> Float[Tensor, "h w 2"]:
        """The coordinate image of a frame."""
        w, h, start = int(self.widths[frame]), int(self.heights[frame]), int(self.offsets[frame])
        return self.values[start : start + w * h].reshape(h, w, 2)

    @property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """For compiled loops: values, offsets, widths, heights."""
        return self.values.numpy(), self.offsets.numpy(), self.widths.numpy(), self.heights.numpy()

    @cached_property
    def _border(self) -> UInt8[ndarray, "pixels"]:
        out = np.zeros(len(self.values), dtype=np.uint8)
        border_distances(self.frames, *self.arrays, out)
        return out

    def border_distance(self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        """Pixels to the nearest one without a coordinate, from positions in `frame`; 0 outside the image."""
        w, h = self.widths[frame], self.heights[frame]
        x, y = (uv_camera[:, k].nan_to_num(-1.0).clamp(-1, 2**30).floor().long() for k in range(2))
        inside = (x >= 0) & (y >= 0) & (x < w) & (y < h)
        pixel = torch.where(inside, self.offsets[frame] + y * w + x, torch.zeros_like(x))
        found = torch.from_numpy(self._border[pixel.numpy()]).double()
        return torch.where(inside, found, torch.zeros_like(found))

    def look_up(
        self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"], memory: WindowMemory | None = None
    ) -> MapSample:
        """Fit around positions in the camera images of `frame`; invalid outside the image.

        `memory` is that of an earlier look-up for the same frames: where a position is still in the same pixel, it
        saves the work.
        """
        fit, roughness = self._fit(frame, uv_camera, memory or WindowMemory.empty(len(frame)))
        return MapSample(fit[:, 0], fit[:, 1:].transpose(1, 2), roughness < self.max_roughness)

    def _fit(
        self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"], memory: WindowMemory
    ) -> tuple[Float[Tensor, "n 3 2"], Float[Tensor, "n"]]:
        """Value, derivatives by x and y, and the window's RMS distance from the paraboloid (infinite without a fit)."""
        n = len(frame)
        fit, roughness = np.zeros((n, 3, 2)), np.full(n, np.inf)
        look_up_windows(
            n,
            *self.arrays,
            frame.numpy(),
            uv_camera.detach().double().numpy(),
            (self.settings.half_window, self.settings.least_pixels, self.settings.least_pivot),
            (memory.pixel, memory.fit, memory.roughness),
            fit,
            roughness,
        )
        return torch.from_numpy(fit), torch.from_numpy(roughness)

    def _median_roughness(self) -> float:
        """Median roughness of windows all over the frames; 0 if nothing is decoded."""
        generator = torch.Generator().manual_seed(0)
        drawn = self.draw(torch.arange(self.frames), self.settings.sampled_windows, generator)
        _, roughness = self._fit(drawn.frame, drawn.uv_camera, WindowMemory.empty(len(drawn.frame)))
        found = roughness[torch.isfinite(roughness)]
        return float(found.median()) if len(found) else 0.0


def seed_from(generator: torch.Generator) -> int:
    """A new seed for choices in compiled loops."""
    return int(torch.randint(2**62, (), generator=generator))
