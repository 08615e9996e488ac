"""How well first-order steps find the poses if the surface is known: the true one, fixed.

    python -m benchmarks.pose_conditioning [--scenes cone-and-cylinder head frog] [--seeds 1 2] [--steps 10000]

The scans are those of `benchmarks.accuracy`, with their noise and their rough starting poses. Rays are cast at the true
mesh; the residual is the projector coordinate that is predicted where they hit it, minus the decoded one. 2024 random
pixels a step, mean L1 loss, Adam at the paper's rate of 1e-3, under several readings of what the paper leaves open:
increments (camera and projector independently; the frame about the object and the projector relative to its camera;
these, whitened by the frame's Gauss-Newton matrix at the start) and decay (exponential, as in `sl-neus-paper`; cosine).
Gauss-Newton for comparison. Results are written after each run, and runs whose results are there are not repeated.
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.accuracy import FRAMES
from benchmarks.common.machine import write_rows
from benchmarks.common.scans import made_once
from benchmarks.pose_conditioning.problem import Poses, Problem
from benchmarks.pose_conditioning.steps import AdamChoice, adam, gauss_newton, normal_matrices
from sl_nerfstudio.evaluation.reference import compare_poses
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.scan import read_ground_truth
from sl_nerfstudio.synthesis.config import SynthConfig

RAYS = 2024
CHOICES = {
    "independent, exponential": AdamChoice("independent", "exponential"),
    "independent, cosine": AdamChoice("independent", "cosine"),
    "rig, exponential": AdamChoice("rig", "exponential"),
    "rig, cosine": AdamChoice("rig", "cosine"),
    "whitened, exponential": AdamChoice("whitened", "exponential"),
    "whitened, cosine": AdamChoice("whitened", "cosine"),
}
GAUSS_NEWTON = "Gauss-Newton"
_ITERATIONS, _PIXELS = 40, 3000  # of Gauss-Newton, and of the matrices, a frame


@dataclass(frozen=True)
class Row:
    """One run; RMS errors of the cameras after one similarity, in mm and degrees."""

    scene: str
    seed: int
    way: str
    steps: int
    start_mm: float
    start_deg: float
    end_mm: float
    end_deg: float
    least_root: float  # smallest square root of an eigenvalue of a frame's matrix: pixels per scene unit or radian
    largest_root: float
    seconds: float

    @property
    def key(self) -> tuple[str, int, str, int]:
        """What it was measured on."""
        return self.scene, self.seed, self.way, self.steps


def measure(problem: Problem, S: Similarity, poses: tuple[DevicePoses, DevicePoses], key: tuple, seed: int) -> Row:
    """One way from the starting poses (the second are the true ones)."""
    start, true = poses
    scene, number, way, steps = key
    first, begin = _in_scene(start, S), time.monotonic()
    if way == GAUSS_NEWTON:
        found = gauss_newton(problem, first, steps, _PIXELS, seed)
    else:
        found = adam(problem, first, CHOICES[way], steps, RAYS, seed)
    seconds = time.monotonic() - begin
    independent = way.startswith("independent")
    roots = torch.linalg.eigvalsh(normal_matrices(problem, _in_scene(true, S), independent, _PIXELS, seed)).sqrt()
    before = compare_poses(start, true).camera
    after = compare_poses(DevicePoses(found.camera.numpy(), found.projector.numpy()).mapped(S.inverse()), true).camera
    return Row(
        scene, number, way, steps, before.translation_rmse, before.rotation_rmse_deg, after.translation_rmse,
        after.rotation_rmse_deg, float(roots.min()), float(roots.max()), seconds,
    )  # fmt: skip


def _in_scene(poses: DevicePoses, S: Similarity) -> Poses:
    scene = poses.mapped(S)
    return Poses(torch.from_numpy(scene.T_world_camera), torch.from_numpy(scene.T_world_projector))


def read_rows(output: Path) -> list[Row]:
    """The rows of an earlier run."""
    return [Row(**row) for row in json.loads(output.read_text())["rows"]] if output.exists() else []


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(FRAMES), choices=FRAMES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--ways", nargs="+", default=[GAUSS_NEWTON, *CHOICES], choices=[GAUSS_NEWTON, *CHOICES])
    parser.add_argument("--steps", type=int, default=10_000, help="of Adam")
    parser.add_argument("--folder", type=Path, default=Path("outputs/pose_conditioning"), help="folder of the scans")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/pose_conditioning.json"))
    options = parser.parse_args()
    rows = read_rows(options.output)
    for seed in options.seeds:
        for scene in options.scenes:
            keys = [(scene, seed, w, _ITERATIONS if w == GAUSS_NEWTON else options.steps) for w in options.ways]
            wanted = [key for key in keys if key not in {row.key for row in rows}]
            if not wanted:
                continue
            loaded = made_once(SynthConfig(scene=scene, frames=FRAMES[scene], seed=seed), options.folder)
            truth = read_ground_truth(loaded.scan)
            assert truth.mesh_path is not None and truth.poses is not None
            problem = Problem(loaded, read_mesh(truth.mesh_path))
            for key in wanted:
                rows.append(measure(problem, loaded.S_scene_world, (loaded.scan.poses, truth.poses), key, seed))
                write_rows(options.output, rows, rays=RAYS)
                print(text(rows[-1]), flush=True)


def text(r: Row) -> str:
    """One line of the table."""
    return (
        f"{r.scene:18} {r.seed} {r.way:25} {r.steps:6} steps | cameras {r.start_mm:5.2f} mm {r.start_deg:5.3f} deg "
        f"-> {r.end_mm:6.3f} mm {r.end_deg:6.4f} deg | roots {r.least_root:.2g} to {r.largest_root:.0f} "
        f"| {r.seconds:.0f} s"
    )


if __name__ == "__main__":
    main()
