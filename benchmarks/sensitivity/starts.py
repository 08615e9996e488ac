"""Poor and good starting poses on weak and nearly symmetric geometry: where do they end, and what is stated of that?

    python -m benchmarks.sensitivity.starts [--scenes ...] [--levels 0.5 2 5] [--seeds 1] [--output FILE]

Small scans (10 frames of 200 x 200) with noise of which neighbouring pixels share a part and with intrinsics that are
wrong within their stated uncertainty start from poses off by some degrees (and three times as many millimetres), once
with their true uncertainty stated and once with the usual one. Only the bundle adjustment runs. Errors are those of the
cameras after alignment with the truth: median and largest. `ratio` is the median stated 1 sigma over the median error.
A camera counts as `farther` if it ends farther from the truth than it started by more than 3 sigma.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.common.measuring import Rows, options
from benchmarks.coverage import NOISES, by_camera, exact_scan, make_case
from sl_nerfstudio.bundle_adjustment.adjust import adjust
from sl_nerfstudio.bundle_adjustment.parameters import (
    UNKNOWNS,
    USUAL_FRAME_ROTATION_DEG,
    PosePrior,
    baseline_scale,
    gauge_projection,
    restore,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.geometry.lie import inverse, log_se3
from sl_nerfstudio.model.pose_refinement import FRAME_TRANSLATION, RELATIVE_ROTATION_DEG, RELATIVE_TRANSLATION

SCENES = ["cone-and-cylinder", "staircase", "vase", "bottle", "medal", "relief", "chair"]
FRAMES, RESOLUTION = 10, 200
_SIGMAS = 3.0  # stated ones, by which a camera must be farther from the truth than its starting pose to count


@dataclass(frozen=True)
class Row:
    """One adjustment; errors and sigmas of rotations in degrees, of positions in millimetres."""

    scene: str
    seed: int
    off_deg: float
    stated: bool
    start_deg: tuple[float, float]
    end_deg: tuple[float, float]
    end_mm: tuple[float, float]
    sigma_deg: float
    sigma_mm: float
    ratio_deg: float
    ratio_mm: float
    farther: int
    modes: int
    cpu_seconds: float


def usual(start: Rig) -> PosePrior:
    """What is assumed of starting poses whose uncertainty is not stated."""
    one = torch.ones(start.frames, dtype=torch.float64)
    frame, relative = np.radians((USUAL_FRAME_ROTATION_DEG, RELATIVE_ROTATION_DEG))
    return PosePrior(FRAME_TRANSLATION * one, frame * one, RELATIVE_TRANSLATION * start.baseline, relative * one)


def errors(rig: Rig, truth: Rig, unit: float) -> tuple[Rig, Float[Tensor, "2 frames"]]:
    """The rig aligned with the truth, and how far its cameras are off: degrees and `unit` times scene units."""
    rig = restore(truth, rig, baseline_scale(truth, rig, None))
    turn = log_se3(rig.T_world_camera @ inverse(truth.T_world_camera))[:, 3:].norm(dim=1)
    apart = (rig.T_world_camera - truth.T_world_camera)[:, :3, 3].norm(dim=1)
    return rig, torch.stack([torch.rad2deg(turn), unit * apart])


def measure(scene: str, seed: int, off_deg: float, stated: bool) -> Row:
    """Adjust one scan from one set of starting poses."""
    case = make_case(exact_scan(scene, seed, FRAMES, RESOLUTION, (off_deg, 3 * off_deg)), NOISES["usual"], seed)
    prior = case.prior if stated else replace(usual(case.start), intrinsics=case.prior.intrinsics)
    begin = time.process_time()
    found = adjust(case.start, case.maps, prior, "free", AdjustmentSettings())
    seconds, unit = time.process_time() - begin, 1 / case.exact.S_scene_world.scale
    _, before = errors(case.start, case.truth, unit)
    rig, after = errors(found.rig, case.truth, unit)
    columns = by_camera(rig) @ gauge_projection(rig) @ found.factor[:-UNKNOWNS]
    moments = columns.square().sum(1).reshape(-1, 2, 3).sum(2).sqrt()
    sigma = torch.stack([torch.rad2deg(moments[:, 1]), unit * moments[:, 0]])
    ratio = sigma.median(1).values / after.median(1).values
    return Row(
        scene, seed, off_deg, stated, _spread(before[0]), _spread(after[0]), _spread(after[1]),
        *sigma.median(1).values.tolist(), *ratio.tolist(),
        farther=int((after[0] > before[0] + _SIGMAS * sigma[0]).sum()), modes=len(found.modes), cpu_seconds=seconds,
    )  # fmt: skip


def _spread(values: Float[Tensor, "n"]) -> tuple[float, float]:
    return float(values.median()), float(values.max())


def main() -> None:
    """Run the benchmark; results are written after every scan."""
    given = options(
        __doc__, scenes=SCENES, levels=[0.5, 2.0, 5.0], seeds=[1], output=Path("benchmarks/results/starts.json")
    )
    rows: Rows[Row] = Rows(given.output)
    for seed in given.seeds:
        for scene in given.scenes:
            for level in given.levels:
                rows.add(*(measure(scene, seed, level, stated) for stated in (True, False)))


if __name__ == "__main__":
    main()
