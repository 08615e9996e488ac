"""Surface and pose errors of whole runs, with the commands a user types, against the truth of synthetic scans.

    python -m benchmarks.accuracy [--scenes cone-and-cylinder head frog] [--seeds 1 2 3] [--iterations 1000]

For every scene and seed, one noisy scan is made and trained four times: by `sl-neus` with its defaults (`refined`),
with the starting poses kept (`unrefined`), with the true poses given (`oracle`, about the best this field can do), and
with the relative poses kept (`known-rig`). `--variants` selects others: one part of the method left out (`no-pattern`,
`no-annealing`, `no-direct`, `no-warm-start`, `no-coarse-to-fine`), or poses refined by the rendering losses instead of
the bundle adjustment (`by-gradient`, `independent`), at the paper's rate for poses, 1e-3 instead of 1e-4. Prints a
table and writes benchmarks/results/accuracy.json.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.common.machine import write_rows
from benchmarks.common.whole_runs import Score, run, train_and_score, with_true_poses

FRAMES = {"cone-and-cylinder": 22, "head": 43, "frog": 57}
COMPARED = {
    "refined": (),
    "known-rig": ("--pipeline.model.refine-poses", "known-rig"),
    "unrefined": ("--pipeline.model.refine-poses", "off"),
    "oracle": ("--pipeline.model.refine-poses", "off"),
}
_PAPER_RATE = [f"--optimizers.{device}-opt.optimizer.lr=1e-3" for device in ("camera", "projector")]
ABLATIONS = {
    "no-pattern": ("--pipeline.model.losses.pattern", "0"),
    "no-annealing": ("--pipeline.model.annealing.kappa", "constant"),
    "by-gradient": ("--pipeline.model.pose-method", "render", *_PAPER_RATE),
    "independent": ("--pipeline.model.pose-method", "render-independently", *_PAPER_RATE),
    "no-direct": (
        *("--pipeline.model.losses.surface", "0", "--pipeline.model.losses.free-space", "0"),
        *("--pipeline.model.losses.coordinates", "1", "--pipeline.model.warm-start", "0"),
    ),
    "no-warm-start": ("--pipeline.model.warm-start", "0"),
    "no-coarse-to-fine": ("--pipeline.model.annealing.coarse-to-fine", "False"),
}
VARIANTS = {**COMPARED, **ABLATIONS}


@dataclass(frozen=True)
class Row(Score):
    """One run."""

    scene: str
    seed: int
    variant: str


def measure(scene: str, seed: int, method: str, iterations: int, folder: Path, variants: Sequence[str]) -> list[Row]:
    """Train and score all variants on one scan."""
    scan = folder / "scan"
    run("sl-synth", "--output", str(scan), "--scene", scene, "--frames", str(FRAMES[scene]), "--seed", str(seed))
    rows = []
    for variant in variants:
        data = with_true_poses(scan, folder / "true") if variant == "oracle" else scan
        options = ("--max-num-iterations", str(iterations), *VARIANTS[variant])
        score = train_and_score(data, folder, variant, options, method)
        print(f"{scene:18} {seed:4} {variant:17} {score.text()}", flush=True)
        rows.append(Row(**asdict(score), scene=scene, seed=seed, variant=variant))
    return rows


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(FRAMES), choices=FRAMES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--variants", nargs="+", default=list(COMPARED), choices=VARIANTS)
    parser.add_argument("--method", default="sl-neus", choices=("sl-neus", "sl-neus-paper"))
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
            rows += measure(scene, seed, options.method, options.iterations, folder, options.variants)
            write_rows(options.output, rows, method=options.method, iterations=options.iterations)


if __name__ == "__main__":
    main()
