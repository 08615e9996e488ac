"""Surface and pose error of whole runs, by the commands a user types, against the truth of synthetic scans.

    python -m benchmarks.accuracy [--scenes cone-and-cylinder head frog] [--seeds 1 2 3] [--iterations 1000]

For every scene and seed one noisy scan is made and trained four times: as `sl-neus` does it (`refined`), with
the starting poses kept (`unrefined`), with the true poses given (`oracle`: nobody can do much better with this
field), and with rigid frames only (`known-rig`). `--variants` names others: each part of the method left out
(`no-pattern`, `no-annealing`, `no-direct`, `no-warm-start`, `no-coarse-to-fine`), or poses trained by the rendering
losses instead of adjusted (`by-gradient`, `independent`). Prints a table; writes benchmarks/results/accuracy.json.
"""

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.machine import write_rows

FRAMES = {"cone-and-cylinder": 22, "head": 43, "frog": 57}
COMPARED = {
    "refined": (),
    "known-rig": ("--pipeline.model.refine-poses", "known-rig"),
    "unrefined": ("--pipeline.model.refine-poses", "off"),
    "oracle": ("--pipeline.model.refine-poses", "off"),
}
ABLATIONS = {
    "no-pattern": ("--pipeline.model.losses.pattern", "0"),
    "no-annealing": ("--pipeline.model.annealing.anneal-kappa", "False"),
    "by-gradient": ("--pipeline.model.adjust-poses", "False", "--pipeline.model.train-poses", "True"),
    "independent": (
        *("--pipeline.model.adjust-poses", "False", "--pipeline.model.train-poses", "True"),
        *("--pipeline.model.pose-parameters", "independent"),
    ),
    "no-direct": (
        *("--pipeline.model.losses.surface", "0", "--pipeline.model.losses.free-space", "0"),
        *("--pipeline.model.losses.coordinates", "1", "--pipeline.model.warm-start", "0"),
    ),
    "no-warm-start": ("--pipeline.model.warm-start", "0"),
    "no-coarse-to-fine": ("--pipeline.model.annealing.coarse-to-fine", "False"),
}
VARIANTS = {**COMPARED, **ABLATIONS}


@dataclass(frozen=True)
class Row:
    """One run; lengths in mm."""

    scene: str
    seed: int
    variant: str
    rigid_rmse: float
    rigid_median: float
    similarity_rmse: float
    completeness_rmse: float
    camera_translation_rmse: float
    camera_rotation_rmse_deg: float
    coordinate_px: float
    training_seconds: float


def run(*command: str) -> None:
    """A command of this environment; its output only if it fails."""
    program = Path(sys.executable).parent / command[0]
    done = subprocess.run([str(program), *command[1:]], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stdout}\n{done.stderr}")


def with_true_poses(scan: Path, to: Path) -> Path:
    """A copy of a scan whose starting poses are the true ones."""
    shutil.copytree(scan, to)
    truth = json.loads((scan / "ground_truth/transforms.json").read_text())["frames"]
    document = json.loads((scan / "transforms.json").read_text())
    for frame, true in zip(document["frames"], truth, strict=True):
        for key in ("transform_matrix", "projector_transform_matrix"):
            frame[key] = true[key]
    (to / "transforms.json").write_text(json.dumps(document, indent=1))
    return to


def train(scan: Path, folder: Path, variant: str, iterations: int, options: Sequence[str]) -> tuple[Path, float]:
    """Train one variant; its config file and the seconds the whole command took."""
    start = time.monotonic()
    fixed = ("--output-dir", str(folder), "--experiment-name", "run", "--timestamp", variant)
    run("ns-train", "sl-neus", "--data", str(scan), *fixed, "--max-num-iterations", str(iterations), *options)
    return folder / "run/sl-neus" / variant / "config.yml", time.monotonic() - start


def measure(scene: str, seed: int, iterations: int, folder: Path, variants: Sequence[str]) -> list[Row]:
    """All variants on one scan."""
    scan = folder / "scan"
    run("sl-synth", "--output", str(scan), "--scene", scene, "--frames", str(FRAMES[scene]), "--seed", str(seed))
    rows = []
    for variant in variants:
        data = with_true_poses(scan, folder / "true") if variant == "oracle" else scan
        config, seconds = train(data, folder, variant, iterations, VARIANTS[variant])
        mesh, poses, result = folder / f"{variant}.ply", folder / variant, folder / f"{variant}.json"
        run("sl-export", "--load-config", str(config), "--output", str(mesh), "--poses", str(poses))
        run("sl-eval", "--mesh", str(mesh), "--data", str(data), "--poses", str(poses / "transforms.json"),
            "--json", str(result))  # fmt: skip
        found = json.loads(result.read_text())
        rigid, similarity, camera = found["rigid"], found["similarity"], found["camera"]
        rows.append(
            Row(
                scene,
                seed,
                variant,
                rigid["accuracy"]["rmse"],
                rigid["accuracy"]["median"],
                similarity["accuracy"]["rmse"],
                rigid["completeness"]["rmse"],
                camera["translation_rmse"],
                camera["rotation_rmse_deg"],
                found["fit"]["coordinate_px_median"],
                seconds,
            )
        )
        print(row_text(rows[-1]), flush=True)
    return rows


def row_text(row: Row) -> str:
    """One line of the table."""
    return (
        f"{row.scene:18} {row.seed:4} {row.variant:17} rigid RMSE {row.rigid_rmse:.3f} median {row.rigid_median:.3f} "
        f"| similarity {row.similarity_rmse:.3f} | complete {row.completeness_rmse:.3f} "
        f"| camera {row.camera_translation_rmse:.3f} mm {row.camera_rotation_rmse_deg:.3f} deg "
        f"| {row.coordinate_px:.2f} px | {row.training_seconds:.0f} s"
    )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(FRAMES), choices=FRAMES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--variants", nargs="+", default=list(COMPARED), choices=VARIANTS)
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--folder", type=Path, default=Path("outputs/accuracy"), help="must not exist yet")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/accuracy.json"))
    options = parser.parse_args()
    options.folder.mkdir(parents=True)
    rows: list[Row] = []
    for seed in options.seeds:
        for scene in options.scenes:
            folder = options.folder / f"{scene}-{seed}"
            folder.mkdir()
            rows += measure(scene, seed, options.iterations, folder, options.variants)
            write_rows(options.output, rows)


if __name__ == "__main__":
    main()
