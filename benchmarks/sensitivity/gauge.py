"""Scale and position of a scan under each rule for the gauge, and as the bundle adjustment leaves them.

    python -m benchmarks.sensitivity.gauge [--scenes cone-and-cylinder head frog] [--seeds 1 2 3] [--output FILE]

The residuals do not change under a similarity of the whole scene, so only prior knowledge can fix it. Compared are the
result as the last step leaves it, and the result aligned with the starting poses at the scale of one known baseline,
of all baselines, or of all lengths (`bundle_adjustment/gauge.py`).
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.accuracy import FRAMES
from benchmarks.common.machine import write_rows
from benchmarks.common.scans import made_once
from sl_nerfstudio.bundle_adjustment.adjust import adjust
from sl_nerfstudio.bundle_adjustment.parameters import agreeing_scale, baseline_scale, restore
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.dataparser.dataparser import LoadedScan
from sl_nerfstudio.evaluation.reference import compare_poses
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.model.pose_refinement import (
    PriorConfig,
    maps_and_held_out,
    pose_prior,
    scene_rig,
)
from sl_nerfstudio.scan import read_ground_truth
from sl_nerfstudio.synthesis.config import SynthConfig


@dataclass(frozen=True)
class Row:
    """One rule on one scan."""

    scene: str
    seed: int
    rule: str
    scale_percent: float  # how much too large all lengths are
    shift_mm: float  # of the object's centre, from its true position
    turn_deg: float  # rotation of the whole scene


def rules(loaded: LoadedScan) -> dict[str, Rig]:
    """The starting rig, and the adjusted one under each rule."""
    scan, S = loaded.scan, loaded.S_scene_world
    start, prior = scene_rig(scan, S), pose_prior(scan, S, PriorConfig())
    maps, _ = maps_and_held_out(scan, loaded.samples)
    rig = adjust(start, maps, prior, "free", AdjustmentSettings()).rig
    frame = None if scan.scale.baseline_of is None else scan.index_of(scan.scale.baseline_of)
    return {
        "starting poses": start,
        "left alone": rig,
        "one known baseline": restore(start, rig, baseline_scale(start, rig, frame)),
        "mean of the baselines": restore(start, rig, baseline_scale(start, rig, None)),
        "all lengths": restore(start, rig, agreeing_scale(start, rig, prior)),
    }


def measure(loaded: LoadedScan, scene: str, seed: int) -> list[Row]:
    """All rules on one scan."""
    truth = read_ground_truth(loaded.scan)
    assert truth.poses is not None
    S = loaded.S_scene_world.inverse()
    rows = []
    for rule, rig in rules(loaded).items():
        poses = DevicePoses(rig.T_world_camera.numpy(), rig.T_world_projector.numpy()).mapped(S)
        found = compare_poses(poses, truth.poses)
        turn = np.degrees(np.arccos(np.clip((np.trace(found.S_truth_estimate.R) - 1) / 2, -1, 1)))
        shift = float(np.linalg.norm(found.S_truth_estimate.points(S.t[None])[0] - S.t))
        rows.append(Row(scene, seed, rule, 100 * found.scale_error, shift, float(turn)))
    return rows


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(FRAMES), choices=FRAMES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--folder", type=Path, default=Path("outputs/gauge"), help="folder of the scans, made once")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/gauge.json"))
    options = parser.parse_args()
    rows: list[Row] = []
    for scene in options.scenes:
        for seed in options.seeds:
            loaded = made_once(SynthConfig(scene=scene, frames=FRAMES[scene], seed=seed), options.folder)
            for row in measure(loaded, scene, seed):
                rows.append(row)
                moved = f"centre {row.shift_mm:6.2f} mm  turned {row.turn_deg:5.2f} deg"
                print(f"{scene:18} {seed:3} {row.rule:22} lengths {row.scale_percent:+7.3f} %  {moved}", flush=True)
            write_rows(options.output, rows)


if __name__ == "__main__":
    main()
