"""Does the stated uncertainty of poses and lengths cover the errors?

    python -m benchmarks.coverage [--scenes ...] [--seeds 1 2 3] [--noises low usual high] [--output FILE]

Small scans of all scenes of sl-synth (8 frames of 240 x 240) start from rough poses, with intrinsics that are wrong
within their stated uncertainty, and with noise of which neighbouring pixels share a part. Only the bundle adjustment
runs. 68 % of the errors should be within 1 sigma, 95 % within 2. One scan of each scene is adjusted from the true
poses, too: how far apart do both end, in units of sigma? Results are written after every scan; a scan whose result is
there is not repeated.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.common.machine import write_rows
from benchmarks.coverage.cases import NOISES, ExactScan, exact_scan, make_case
from benchmarks.coverage.errors import errors_of
from sl_nerfstudio.bundle_adjustment.adjust import Adjustment, adjust
from sl_nerfstudio.bundle_adjustment.parameters import gauge_projection, restore
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.geometry.lie import inverse, log_se3
from sl_nerfstudio.synthesis.scenes import BUILT_IN

TWO_STARTS = (1, "usual")  # seed and noise of the scans that are also adjusted from their true poses
QUANTITIES = ("relative", "camera", "length")


@dataclass(frozen=True)
class Row:
    """One scan. Shares: within 1 sigma, within 2 sigma, RMS of error over sigma."""

    scene: str
    seed: int
    noise: str
    relative: list[float]
    camera: list[float]
    length: list[float]
    camera_mm: float
    camera_deg: float
    baseline_percent: float
    baseline_sigma_percent: float
    apart: float | None  # results of rough and true starts, RMS over all pose parameters, in sigma
    seconds: float

    @property
    def key(self) -> tuple[str, int, str]:
        """What it was measured on."""
        return self.scene, self.seed, self.noise


def measure(exact: ExactScan, scene: str, seed: int, noise: str) -> Row:
    """Adjust from rough starting poses; the first scan with usual noise also from the true ones."""
    case, begin = make_case(exact, NOISES[noise], seed), time.monotonic()
    found = adjust(case.start, case.maps, case.prior, "free", AdjustmentSettings())
    seconds, other = time.monotonic() - begin, None
    if (seed, noise) == TWO_STARTS:
        near = make_case(exact, NOISES[noise], seed, exact.truth)
        other = apart(found, adjust(near.start, near.maps, near.prior, "free", AdjustmentSettings()))
    errors = errors_of(case, found)
    shares = {name: list(values) for name, values in errors.shares().items()}
    return Row(
        scene, seed, noise, **shares,
        camera_mm=errors.camera_mm, camera_deg=errors.camera_deg, baseline_percent=errors.baseline_percent,
        baseline_sigma_percent=errors.baseline_sigma_percent, apart=other, seconds=seconds,
    )  # fmt: skip


def apart(a: Adjustment, b: Adjustment) -> float:
    """RMS difference of two results in units of the first one's sigma, after one common similarity."""
    scale = float(torch.exp(torch.log(a.rig.baseline / b.rig.baseline).mean()))
    rig = restore(a.rig, b.rig, scale)
    P = gauge_projection(a.rig)
    sigma = (P @ a.covariance @ P.T).diagonal().clamp_min(1e-30).sqrt()
    pairs = (
        (rig.T_world_camera, a.rig.T_world_camera),
        (rig.T_camera_projector, a.rig.T_camera_projector),
    )
    steps = [log_se3(theirs @ inverse(mine)).reshape(-1) for theirs, mine in pairs]
    return float((torch.cat(steps) / sigma).pow(2).mean().sqrt())


def summary(rows: list[Row]) -> str:
    """A Markdown table: shares within 1 and 2 sigma, per scene and over all."""
    lines = ["| scene | scans | relative poses | camera poses | lengths | starts apart |", "|---|---|---|---|---|---|"]
    for scene in [*dict.fromkeys(r.scene for r in rows), None]:
        mine = [r for r in rows if scene in (None, r.scene)]
        cells = []
        for name in QUANTITIES:
            one, two, ratio = np.array([getattr(r, name) for r in mine]).T
            cells.append(f"{100 * one.mean():.0f} %, {100 * two.mean():.0f} % ({np.sqrt((ratio**2).mean()):.2f})")
        starts = [r.apart for r in mine if r.apart is not None]
        median = f"{np.median(starts):.2f}" if starts else ""
        lines.append(f"| {scene or 'all'} | {len(mine)} | {' | '.join(cells)} | {median} |")
    return "\n".join(lines)


def read_rows(output: Path) -> list[Row]:
    """The rows of an earlier run."""
    return [Row(**row) for row in json.loads(output.read_text())["rows"]] if output.exists() else []


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(BUILT_IN), choices=BUILT_IN)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--noises", nargs="+", default=list(NOISES), choices=NOISES)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/coverage.json"))
    options = parser.parse_args()
    rows = read_rows(options.output)
    for seed in options.seeds:
        for scene in options.scenes:
            wanted = [n for n in options.noises if (scene, seed, n) not in {r.key for r in rows}]
            exact = exact_scan(scene, seed) if wanted else None
            for noise in wanted:
                assert exact is not None
                rows.append(measure(exact, scene, seed, noise))
                write_rows(options.output, rows)
                print(asdict(rows[-1]), flush=True)
    print(summary(rows))


if __name__ == "__main__":
    main()
