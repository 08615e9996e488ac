"""Time of the joint adjustment and of its parts, its memory, and its accuracy, against the number of frames.

    python -m benchmarks.adjustment_speed [--frames 22 60 150] [--resolution 400] [--threads N] [--output FILE]

Scans of sl-synth with its usual noise and starting poses, each adjusted in a separate process as `ns-train sl-neus`
does before its first step. Machine code is compiled by a first adjustment of two frames that does not count. Speed must
not cost accuracy: errors of poses, and errors over their stated sigma (about 1), are part of each row.
"""

import argparse
import cProfile
import json
import pstats
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch

from benchmarks.common.machine import write_rows
from benchmarks.common.scans import made_once
from sl_nerfstudio.bundle_adjustment.adjust import Adjustment, adjust, cross_validate
from sl_nerfstudio.bundle_adjustment.parameters import baseline_scale, gauge_projection, restore
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.dataparser.dataparser import LoadedScan
from sl_nerfstudio.evaluation.reference import compare_poses
from sl_nerfstudio.geometry.lie import inverse, log_se3
from sl_nerfstudio.model.pose_refinement import (
    PriorConfig,
    maps_and_held_out,
    pose_prior,
    scene_rig,
)
from sl_nerfstudio.parallel import cores
from sl_nerfstudio.scan import read_ground_truth
from sl_nerfstudio.synthesis.config import SynthConfig

T = TypeVar("T")

PARTS = {
    "maps": "maps_and_held_out",
    "visibility": "observe",
    "linearisation": "linearise",
    "residuals": "residuals_of",
    "normal equations": "normal_equations",
    "steps": "lm_step",
    "relocalisation": "relocalise",
    "unplaced frames": "unplaced_frames",
    "covariance": "pose_covariance",
    "cross-validation": "cross_validate",
}
"""Functions whose time is reported; some call others: parts do not add up."""


@dataclass(frozen=True)
class Row:
    """One adjustment."""

    frames: int
    threads: int
    seconds: float
    cpu_seconds: float  # of all threads
    peak_gb: float  # resident memory of the whole process, scan and libraries included
    before_gb: float  # the same before the adjustment
    iterations: int
    camera_mm: float  # RMS errors of the cameras after one similarity
    camera_deg: float
    camera_ratio: float  # RMS of error over stated sigma
    relative_ratio: float
    parts: dict[str, float]  # seconds


def profiled(function: Callable[[], T]) -> tuple[T, dict[str, float]]:
    """What a function returns, and the time of its parts."""
    profile = cProfile.Profile()
    result = profile.runcall(function)
    found = {name: times[3] for (_, _, name), times in pstats.Stats(profile).stats.items()}  # type: ignore[attr-defined]
    return result, {part: round(found.get(name, 0.0), 3) for part, name in PARTS.items()}


def adjusted(loaded: LoadedScan) -> Adjustment:
    """As for a training run, with the cross-validation that decides about the result."""
    settings, S = AdjustmentSettings(), loaded.S_scene_world
    maps, held_out = maps_and_held_out(loaded.scan, loaded.samples)
    start = scene_rig(loaded.scan, S)
    found = adjust(start, maps, pose_prior(loaded.scan, S, PriorConfig()), "free", settings)
    cross_validate(start, found.rig, held_out, maps, found.noise_px)
    return found


def ratios(loaded: LoadedScan, found: Adjustment) -> tuple[float, float]:
    """RMS of errors of (delta, rho) in units of their sigma, in the gauge of the mean baseline."""
    poses, S = read_ground_truth(loaded.scan).poses, loaded.S_scene_world
    assert poses is not None
    truth = Rig.of([frame.camera for frame in loaded.scan.frames], loaded.scan.projector, poses, S)
    rig = restore(truth, found.rig, baseline_scale(truth, found.rig, None))
    P = gauge_projection(rig)
    variance = ((P @ found.covariance) * P).sum(1).clamp_min(1e-30).reshape(2, -1, 6)
    pairs = ((rig.T_world_camera, truth.T_world_camera), (rig.T_camera_projector, truth.T_camera_projector))
    errors = torch.stack([log_se3(a @ inverse(b)) for a, b in pairs])
    camera, relative = (errors.square() / variance).mean((1, 2)).sqrt().tolist()
    return camera, relative


def first_frames(loaded: LoadedScan, count: int) -> LoadedScan:
    """A scan that ends after some frames."""
    return replace(
        loaded,
        scan=replace(loaded.scan, frames=loaded.scan.frames[:count]),
        samples=loaded.samples.first_frames(count),
    )


def measure_here(config: SynthConfig, folder: Path, threads: int) -> Row:
    """Adjust a scan in this process."""
    torch.set_num_threads(threads)
    loaded = made_once(config, folder)
    adjusted(first_frames(loaded, 2))
    before = _peak_gb()
    cpu, begin = time.process_time(), time.monotonic()
    found, parts = profiled(lambda: adjusted(loaded))
    seconds, cpu = time.monotonic() - begin, time.process_time() - cpu
    peak, truth = _peak_gb(), read_ground_truth(loaded.scan).poses
    assert truth is not None
    errors = compare_poses(found.rig.poses(loaded.S_scene_world.inverse()), truth).camera
    return Row(
        config.frames, threads, seconds, cpu, peak, before, found.iterations,
        errors.translation_rmse, errors.rotation_rmse_deg, *ratios(loaded, found), parts,
    )  # fmt: skip


def _peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2


def measure(arguments: Sequence[str]) -> Row:
    """The same in a fresh process, so that its peak memory is measured alone."""
    command = [sys.executable, "-m", "benchmarks.adjustment_speed", "--here", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    return Row(**json.loads(done.stdout.strip().splitlines()[-1]))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", nargs="+", type=int, default=[22, 60, 150])
    parser.add_argument("--resolution", type=int, default=400)
    parser.add_argument("--threads", type=int, default=cores())
    parser.add_argument("--folder", type=Path, default=Path("outputs/adjustment_speed"), help="of the scans, made once")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/adjustment_speed.json"))
    parser.add_argument("--here", action="store_true", help="only the first number of frames, in this process")
    options = parser.parse_args()
    if options.here:
        config = SynthConfig(scene="frog", frames=options.frames[0], resolution=options.resolution, seed=1)
        print(json.dumps(measure_here(config, options.folder, options.threads).__dict__))
        return
    rows = []
    for frames in options.frames:
        flags = {"frames": frames, "resolution": options.resolution, "threads": options.threads}
        words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
        rows.append(measure([*words, "--folder", str(options.folder)]))
        write_rows(options.output, rows)
        print(rows[-1], flush=True)


if __name__ == "__main__":
    main()
