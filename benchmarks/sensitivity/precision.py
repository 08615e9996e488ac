"""What fewer digits in a GPU's matrix products do to the surface: TF32 and bfloat16, emulated on the CPU.

python -m benchmarks.sensitivity.precision [--steps 250] [--output FILE]

The factors of every float32 product (`mm`, `addmm`, `bmm`) are rounded as the GPU's units round them, to 11 bits (TF32)
or 8 (bfloat16); sums stay float32. All else of the training is the same, random numbers included. The field is smaller
than usual, because it runs in plain torch. `mixed` is torch's autocast to bfloat16, as of `--mixed-precision True`: the
field computes in its parameters' precision all the same.
"""

import tempfile
import warnings
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.common.machine import write_rows
from benchmarks.common.scans import made_once
from benchmarks.common.training import Training, data_of, model_of, settings
from benchmarks.gpu import rmse
from sl_nerfstudio.synthesis.config import SynthConfig

_PRODUCTS = {torch.ops.aten.mm.default, torch.ops.aten.addmm.default, torch.ops.aten.bmm.default}
_TF32_DROPS = 13  # of the 24 bits of a float32


@dataclass(frozen=True)
class Config:
    """Trainings that differ in nothing but the digits of their products."""

    steps: int = 250
    """Steps of each training."""
    seeds: tuple[int, ...] = (0, 1)
    """Each training is repeated with these."""
    frames: int = 8
    """Frames of the scan, which is made in outputs/bench unless it is there."""
    resolution: int = 200
    """Width and height of its images."""
    rays: int = 256
    """Pixels of a step."""
    mesh_resolution: int = 128
    """Cells along the scene's box of the surface."""
    output: Path | None = None
    """Where to write the figures as JSON."""


@dataclass(frozen=True)
class Row:
    """One training: distance of its surface from the truth, mm."""

    products: str
    seed: int
    rmse_mm: float
    median_mm: float


class RoundedFactors(TorchDispatchMode):
    """Rounds the factors of float32 products."""

    def __init__(self, bits_dropped: int) -> None:
        super().__init__()
        self._dropped = bits_dropped

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """The operation, with rounded factors if it is a product."""
        if func in _PRODUCTS:
            first = len(args) - 2  # what is added to a product is not rounded
            args = (*args[:first], *(rounded(x, self._dropped) for x in args[first:]))
        return func(*args, **(kwargs or {}))


def rounded(x: Tensor, dropped: int) -> Tensor:
    """float32 numbers without their last bits, to the nearest, ties to even; others as they are."""
    if x.dtype != torch.float32:
        return x
    bits = x.contiguous().view(torch.int32)
    odd = (bits >> dropped) & 1
    return ((bits + (1 << (dropped - 1)) - 1 + odd) >> dropped << dropped).view(torch.float32)


def train(config: Config, scan: Path, products: str, seed: int) -> Row:
    """One training."""
    modes: dict[str, AbstractContextManager[Any]] = {
        "float32": nullcontext(),
        "TF32": RoundedFactors(_TF32_DROPS),
        "bfloat16": RoundedFactors(16),
        "mixed": torch.autocast("cpu", dtype=torch.bfloat16),
    }
    run = settings("sl-neus", scan, Path(tempfile.mkdtemp()), "cpu", config.steps)
    model, data = model_of(run), data_of(run)
    model.refine_poses = "off"
    model.sdf.backend, model.sdf.max_resolution, model.sdf.levels, model.sdf.hidden = "torch", 128, 3, 64
    model.sampling.render_rays, model.sampling.eikonal_points = 64, 256
    data.train_num_rays_per_batch = config.rays
    torch.manual_seed(seed)
    with modes[products]:
        training = Training(run)
        for _ in range(config.steps):
            training.step()
    found = rmse(config.mesh_resolution, training)
    return Row(products, seed, found["rmse_mm"], found["median_mm"])


def main(config: Config) -> list[Row]:
    """Train, print, write."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    synth = SynthConfig(frames=config.frames, resolution=config.resolution, supersampling=1, clean=True)
    scan = made_once(synth, Path("outputs/bench/precision")).scan.root
    rows = []
    for seed in config.seeds:
        for products in ("float32", "TF32", "bfloat16", "mixed"):
            rows.append(train(config, scan, products, seed))
            print(rows[-1], flush=True)
    if config.output is not None:
        write_rows(config.output, rows, steps=config.steps)
    return rows


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
