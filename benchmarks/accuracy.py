"""Surface and pose errors of whole runs, with the commands a user types, against the truth of synthetic scans.

    python -m benchmarks.accuracy [--scenes cone-and-cylinder head frog] [--seeds 1 2 3] [--iterations 1000]

For every scene and seed, one noisy scan is made and trained four times: by `sl-neus` with its defaults (`refined`),
with the starting poses kept (`unrefined`), with the true poses given (`oracle`, about the best this field can do), and
with the relative poses kept (`known-rig`). `--variants` selects others: one part of the method left out (`no-pattern`,
`no-annealing`, where the sharpness stays as it starts, `no-direct`, `no-warm-start`, `no-coarse-to-fine`), or poses
refined by the rendering losses instead of the bundle adjustment (`by-gradient`, `independent`), at the paper's rate for
poses, 1e-3 instead of 1e-4. Prints a table and writes benchmarks/results/accuracy.json.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.common.measuring import Rows, options
from benchmarks.common.runs import Score, run, train_and_score, with_true_poses

FRAMES = {"cone-and-cylinder": 22, "head": 43, "frog": 57}  # of the paper's objects, or stand-ins for them; of others:
_FRAMES = 22
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


def scored(scan: Path, folder: Path, method: str, steps: int, variants: Sequence[str]) -> Iterator[tuple[str, Score]]:
    """Train and score all variants on one scan with truth."""
    for variant in variants:
        data = with_true_poses(scan, folder / "true") if variant == "oracle" else scan
        yield (
            variant,
            train_and_score(data, folder, variant, ("--max-num-iterations", str(steps), *VARIANTS[variant]), method),
        )


def main() -> None:
    """Run the benchmark in a folder that must not exist yet."""
    given = options(
        __doc__, scenes=list(FRAMES), seeds=[1, 2, 3], variants=list(COMPARED), method="sl-neus", iterations=1000,
        folder=Path("outputs/accuracy"), output=Path("benchmarks/results/accuracy.json"),
    )  # fmt: skip
    given.folder.mkdir(parents=True)
    rows: Rows[Row] = Rows(given.output, method=given.method, iterations=given.iterations)
    for seed in given.seeds:
        for scene in given.scenes:
            folder = given.folder / f"{scene}-{seed}"
            folder.mkdir()
            scan = folder / "scan"
            run("sl-synth", "--output", scan, "--scene", scene, "--frames", FRAMES.get(scene, _FRAMES), "--seed", seed)
            for variant, score in scored(scan, folder, given.method, given.iterations, given.variants):
                rows.add(Row(**asdict(score), scene=scene, seed=seed, variant=variant))


if __name__ == "__main__":
    main()
