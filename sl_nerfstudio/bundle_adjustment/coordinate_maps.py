"""Decoded coordinate images of all frames, looked up between pixels.

A look-up fits a paraboloid to the decoded pixels of a small window: this averages the decoding noise,
provides the derivative with respect to the pixel, and shows where the map is discontinuous (edges, wrong
cells). (A plane would average better, but on a curved surface it is off by the same amount everywhere, and
the adjustment would turn that offset into wrong poses.)
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.loops.borders import border_distances
from sl_nerfstudio.bundle_adjustment.loops.drawing import draw_pixels
from sl_nerfstudio.bundle_adjustment.loops.groups import Groups
from sl_nerfstudio.bundle_adjustment.loops.pixel_index import PixelIndex, packed
from sl_nerfstudio.bundle_adjustment.loops.windows import WindowMemory, evaluate_windows, fit_windows, mark_moved
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
    """Coordinate images of all frames; sizes may differ."""

    values: Float[Tensor, "decoded 2"]  # those that are known: all frames one after the other, rows first
    index: PixelIndex
    settings: LookUpSettings
    max_roughness: float  # projector pixels; rougher windows are discontinuous

    @staticmethod
    def of(images: Iterable[Float[Tensor, "_h _w 2"]], settings: LookUpSettings | None = None) -> "CoordinateMaps":
        """From one image per frame; sizes may differ. What is too large for memory is kept in a file."""
        settings = settings or LookUpSettings()
        values, known, widths = GrowingArray(largest_in_memory()), [], []
        for image in images:
            coords = image.float().numpy()
            finite = np.isfinite(coords).all(-1)
            values.append(coords[finite])
            known.append(packed(finite))
            widths.append(image.shape[1])
        maps = CoordinateMaps(
            values=torch.from_numpy(values.whole()),
            index=PixelIndex.of(known, widths),
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
        return len(self.index.first)

    def draw(self, frames: Int[Tensor, "m"], count: int, generator: torch.Generator) -> "DrawnPixels":
        """Up to `count` random decoded pixel centres of some frames each, at most one in each square of a lattice."""
        pixels, counts = np.zeros((len(frames), count), dtype=np.int64), np.zeros(len(frames), dtype=np.int64)
        draw_pixels(len(frames), frames.numpy(), self.index.arrays, seed_from(generator), pixels, counts)
        frame = torch.repeat_interleave(frames, torch.from_numpy(counts))
        pixel = torch.from_numpy(pixels[np.arange(count) < counts[:, None]])
        w = self._sizes[0][frame]
        return DrawnPixels(frame, torch.stack([pixel % w + 0.5, pixel // w + 0.5], -1).double())

    def image(self, frame: int) -> Float[Tensor, "h w 2"]:
        """The coordinate image of a frame, NaN where not decoded."""
        return torch.from_numpy(self.index.image(self.values.numpy(), frame))

    @property
    def arrays(self) -> tuple[ndarray, tuple[ndarray, ...]]:
        """For compiled loops: values, index."""
        return self.values.numpy(), self.index.arrays

    @property
    def _sizes(self) -> tuple[Int[Tensor, "frames"], Int[Tensor, "frames"]]:
        return torch.from_numpy(self.index.widths), torch.from_numpy(self.index.heights)

    def border_distance(self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        """Pixels to the nearest one without a coordinate, from positions in `frame`; 0 outside the image."""
        w, h = (size[frame] for size in self._sizes)
        x, y = (uv_camera[:, k].nan_to_num(-1.0).clamp(-1, 2**30).floor().long() for k in range(2))
        inside = (x >= 0) & (y >= 0) & (x < w) & (y < h)
        pixel = torch.where(inside, y * w + x, torch.full_like(x, -1)).numpy()
        groups, found = Groups.of(frame.numpy(), self.frames), np.zeros(len(frame))
        border_distances(self.frames, self.index.arrays, groups.first, groups.entries, pixel, found)
        return torch.from_numpy(found)

    def look_up(
        self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"], memory: WindowMemory | None = None
    ) -> MapSample:
        """Fit around positions in the camera images of `frame`; invalid outside the image.

        `memory` is that of an earlier look-up for the same frames: where a position is still in the same pixel, it
        saves the work.
        """
        fit, roughness = self._fit(frame, uv_camera, memory or WindowMemory.empty(frame.numpy()))
        return MapSample(fit[:, 0], fit[:, 1:].transpose(1, 2), roughness < self.max_roughness)

    def _fit(
        self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"], memory: WindowMemory
    ) -> tuple[Float[Tensor, "n 3 2"], Float[Tensor, "n"]]:
        """Value, derivatives by x and y, and the window's RMS distance from the paraboloid (infinite without a fit)."""
        s, at, uv = self.settings, frame.numpy(), uv_camera.detach().double().numpy()
        values, index = self.arrays
        n, moved, found = len(at), np.empty(len(at), dtype=np.bool_), np.zeros((len(at), 3, 2))
        mark_moved(n, index, at, uv, memory.pixel, moved)
        chosen = memory.order[moved[memory.order]]
        limits = s.half_window, s.least_pixels, s.least_pivot
        fit_windows(len(chosen), chosen, values, index, at, memory.pixel, limits, memory.fit, memory.roughness)
        evaluate_windows(n, self.index.widths, at, uv, memory.pixel, memory.fit, memory.roughness, found)
        return torch.from_numpy(found), torch.from_numpy(memory.roughness.copy())

    def _median_roughness(self) -> float:
        """Median roughness of windows all over the frames; 0 if nothing is decoded."""
        generator = torch.Generator().manual_seed(0)
        drawn = self.draw(torch.arange(self.frames), self.settings.sampled_windows, generator)
        _, roughness = self._fit(drawn.frame, drawn.uv_camera, WindowMemory.empty(drawn.frame.numpy()))
        found = roughness[torch.isfinite(roughness)]
        return float(found.median()) if len(found) else 0.0


def seed_from(generator: torch.Generator) -> int:
    """A new seed for choices in compiled loops."""
    return int(torch.randint(2**62, (), generator=generator))
