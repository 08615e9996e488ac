"""How far off the starting poses may be for the bundle adjustment to converge.

    python -m benchmarks.sensitivity.basin [--scene cone-and-cylinder] [--frames 22] [--seeds 1 2 3] [--output FILE]

For every seed, one noisy scan is made. Its starting poses are replaced by ones with growing registration errors (and
sl-synth's default calibration errors), and adjusted as `ns-train sl-neus` does before its first step. `over_1_deg`
counts frames that end more than one degree off.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.measuring import Rows, options
from benchmarks.common.runs import made_once
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.dataparser.dataparser import LoadedScan
from sl_nerfstudio.evaluation.reference import compare_poses
from sl_nerfstudio.model.pose_refinement import PriorConfig, adjust_scan
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import Setup, make_setup

LEVELS = ((0.0, 0.0), (0.25, 1.0), (0.5, 2.0), (1.0, 3.0), (2.0, 6.0), (3.0, 10.0), (5.0, 15.0), (7.0, 20.0),
          (10.0, 30.0))  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One adjustment; RMS errors of the cameras after one similarity, in mm and degrees."""

    seed: int
    frame_deg: float
    frame_mm: float
    start_mm: float
    start_deg: float
    end_mm: float
    end_deg: float
    over_1_deg: int
    kept: bool
    seconds: float


def from_errors(scan: Scan, setup: Setup) -> Scan:
    """The scan with the starting poses of `setup`."""
    poses = zip(scan.frames, setup.start.T_world_camera, setup.start.T_world_projector, strict=True)
    frames = (replace(f, T_world_camera=c, T_world_projector=p, pose_sigma=setup.sigma) for f, c, p in poses)
    return replace(scan, frames=tuple(frames))


def measure(loaded: LoadedScan, setup: Setup, seed: int, level: tuple[float, float]) -> Row:
    """Adjust one set of starting poses."""
    begin = time.monotonic()
    scan = from_errors(loaded.scan, setup)
    found = adjust_scan(scan, loaded.S_scene_world, loaded.samples, "free", PriorConfig(), AdjustmentSettings())
    seconds = time.monotonic() - begin
    end = compare_poses(found.rig.poses(loaded.S_scene_world.inverse()), setup.truth).camera
    before = compare_poses(setup.start, setup.truth).camera
    return Row(
        seed, *level, before.translation_rmse, before.rotation_rmse_deg, end.translation_rmse, end.rotation_rmse_deg,
        int((np.asarray(end.rotation_deg) > 1).sum()), found.adjusted, seconds,
    )  # fmt: skip


def main() -> None:
    """Run the benchmark; the scans are made once."""
    given = options(
        __doc__, scene="cone-and-cylinder", frames=22, resolution=400, seeds=[1, 2, 3], folder=Path("outputs/basin"),
        output=Path("benchmarks/results/basin.json"),
    )  # fmt: skip
    rows: Rows[Row] = Rows(given.output)
    for seed in given.seeds:
        config = SynthConfig(scene=given.scene, frames=given.frames, resolution=given.resolution, seed=seed)
        loaded = made_once(config, given.folder)
        for level in LEVELS:
            rows.add(measure(loaded, make_setup(replace(config, pose_error=level)), seed, level))


if __name__ == "__main__":
    main()
