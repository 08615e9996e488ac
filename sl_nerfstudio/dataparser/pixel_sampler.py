"""Random pixels for a step of training or evaluation."""

import torch
from jaxtyping import Int
from torch import Tensor

from sl_nerfstudio.dataparser.samples import PixelBatch, PixelSamples

_STRIDE = 1_000_003  # a prime, so that seeds of neighbouring runs do not share the batches of neighbouring steps


class SLPixelSampler:
    """Draws `num_rays_per_batch` pixels; nerfstudio's exporters set that number from outside.

    The batch of a step depends only on the seed and the step, so that a resumed run continues like an uninterrupted
    one. A second call for the same step (as by `ns-export pointcloud`) draws other pixels.
    """

    def __init__(self, samples: PixelSamples, num_rays_per_batch: int, held_out: bool) -> None:
        """The seed is torch's, which nerfstudio sets from `--machine.seed` and the rank of the process."""
        self.samples = samples
        self.num_rays_per_batch = num_rays_per_batch
        self.held_out = held_out
        self.generator = torch.Generator(samples.device)
        self._seed = torch.initial_seed() + int(held_out)
        self._step: int | None = None

    def set_num_rays_per_batch(self, num_rays_per_batch: int) -> None:
        """Change the number of pixels of a batch."""
        self.num_rays_per_batch = num_rays_per_batch

    def begin(self, step: int) -> None:
        """Seed the draws of a step, unless that was done."""
        if step != self._step:
            self._step = step
            self.generator.manual_seed((self._seed * _STRIDE + step) % 2**63)

    def sample(self, step: int) -> PixelBatch:
        """Pixels for a step."""
        self.begin(step)
        return self.samples.at(self._draw())

    def choose(self, step: int) -> Int[Tensor, "n"]:
        """Pixels for a step: indices of the table, or on a GPU of those not held out (`PixelSamples.training`)."""
        self.begin(step)
        if self.samples.device.type == "cpu":
            return self._draw()
        return self.samples.randint(len(self.samples.training), self.num_rays_per_batch, self.generator)

    def _draw(self) -> Int[Tensor, "n"]:
        if self.samples.device.type == "cpu" or self.held_out:
            return self.samples.draw(self.num_rays_per_batch, self.generator, self.held_out)
        return self.samples.draw_without_waiting(self.num_rays_per_batch, self.generator)
