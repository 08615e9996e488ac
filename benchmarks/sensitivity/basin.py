"""How far off the starting poses may be for the bundle adjustment to converge.

    python -m benchmarks.sensitivity.basin [--scene cone-and-cylinder] [--frames 22] [--seeds 1 2 3] [--output FILE]

For every seed, one noisy scan is made. Its starting poses are replaced by ones with growing registration errors (and
sl-synth's default calibration errors), and adjusted as `ns-train sl-neus` does before its first step. `over_1_deg`
counts frames that end more than one degree off.
"""

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.machine import write_rows
from benchmarks.common.scans import made_once
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.dataparser.dataparser import LoadedScan
from sl_nerfstudio.evaluation.reference import compare_poses
from sl_nerfstudio.model.pose_refinement import PriorConfig, adjust_scan
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import Setup, make_setup

LEVELS = (
    (0.0, 0.0),
    (0.25, 1.0),
    (0.5, 2.0),
    (1.0, 3.0),
    (2.0, 6.0),
    (3.0, 10.0),
    (5.0, 15.0),
    (7.0, 20.0),
    (10.0, 30.0),
)


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
    found = adjust_scan(
        from_errors(loaded.scan, setup),
        loaded.S_scene_world,
        loaded.samples,
        "free",
        PriorConfig(),
        AdjustmentSettings(),
    )
    seconds = time.monotonic() - begin
    end = compare_poses(found.rig.poses(loaded.S_scene_world.inverse()), setup.truth).camera
    before = compare_poses(setup.start, setup.truth).camera
    return Row(
        seed,
        *level,
        before.translation_rmse,
        before.rotation_rmse_deg,
        end.translation_rmse,
        end.rotation_rmse_deg,
        int((np.asarray(end.rotation_deg) > 1).sum()),
        found.adjusted,
        seconds,
    )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="cone-and-cylinder")
    parser.add_argument("--frames", type=int, default=22)
    parser.add_argument("--resolution", type=int, default=400)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--folder", type=Path, default=Path("outputs/basin"), help="folder of the scans, made once")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/basin.json"))
    options = parser.parse_args()
    rows: list[Row] = []
    for seed in options.seeds:
        config = SynthConfig(scene=options.scene, frames=options.frames, resolution=options.resolution, seed=seed)
        loaded = made_once(config, options.folder)
        for level in LEVELS:
            rows.append(measure(loaded, make_setup(replace(config, pose_error=level)), seed, level))
            print(text(rows[-1]), flush=True)
    write_rows(options.output, rows)


def text(r: Row) -> str:
    """One line of the table."""
    return (
        f"seed {r.seed}  frames off by {r.frame_deg:5.2f} deg {r.frame_mm:4.0f} mm | cameras {r.start_mm:6.2f} mm "
        f"{r.start_deg:6.3f} deg -> {r.end_mm:6.3f} mm {r.end_deg:6.3f} deg, {r.over_1_deg} over 1 deg"
        f"{'' if r.kept else ', starting poses kept'} | {r.seconds:.0f} s"
    )


if __name__ == "__main__":
    main()
