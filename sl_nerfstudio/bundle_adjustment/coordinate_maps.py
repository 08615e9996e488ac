"""Decoded coordinate images of all frames, looked up between pixels.

A look-up fits a paraboloid to the decoded pixels of a small window: this averages the decoding noise,
provides the derivative with respect to the pixel, and shows where the map is discontinuous (edges, wrong
cells). (A plane would average better, but on a curved surface it is off by the same amount everywhere, and
the adjustment would turn that offset into wrong poses.)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.settings import LookUpSettings
from sl_nerfstudio.bundle_adjustment.windows import WindowMemory, look_up_windows


@dataclass(frozen=True)
class MapSample:
    """Coordinates looked up at some positions."""

    uv_projector: Float[Tensor, "n 2"]
    jacobian: Float[Tensor, "n 2 2"]  # d uv_projector / d uv_camera
    valid: Bool[Tensor, "n"]  # enough decoded pixels, and a paraboloid fits them


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
    def of(images: Sequence[Float[Tensor, "_h _w 2"]], settings: LookUpSettings | None = None) -> "CoordinateMaps":
        """From one image per frame; sizes may differ."""
        settings = settings or LookUpSettings()
        sizes = torch.tensor([i.shape[0] * i.shape[1] for i in images])
        maps = CoordinateMaps(
            values=torch.cat([i.reshape(-1, 2) for i in images]).float(),
            offsets=torch.cumsum(sizes, 0) - sizes,
            widths=torch.tensor([i.shape[1] for i in images]),
            heights=torch.tensor([i.shape[0] for i in images]),
            settings=settings,
            max_roughness=settings.roughness_px,
        )
        usual = settings.roughness_medians * maps._median_roughness()
        return replace(maps, max_roughness=max(settings.roughness_px, usual))

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
            self.values.numpy(),
            self.offsets.numpy(),
            self.widths.numpy(),
            self.heights.numpy(),
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
        drawn = [self.draw(k, self.settings.sampled_windows, generator) for k in range(self.frames)]
        frame = torch.repeat_interleave(torch.arange(self.frames), torch.tensor([len(d) for d in drawn]))
        _, roughness = self._fit(frame, torch.cat(drawn), WindowMemory.empty(len(frame)))
        found = roughness[torch.isfinite(roughness)]
        return float(found.median()) if len(found) else 0.0

    def decoded_at(self, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """The decoded coordinate of the pixel under each position; NaN outside the image."""
        w, h, start = self.widths[frame], self.heights[frame], self.offsets[frame]
        inside = (uv_camera >= 0).all(-1) & (uv_camera[:, 0] < w) & (uv_camera[:, 1] < h)
        uv = torch.where(inside[:, None], uv_camera, torch.zeros_like(uv_camera)).long()
        found = self.values[start + uv[:, 1] * w + uv[:, 0]].double()
        return torch.where(inside[:, None], found, torch.full_like(found, float("nan")))
