"""What sl-redecode brings: scans with missing cells and scans of realistic photographs, before and after.

    python -m benchmarks.redecode [--scenes head frog ...] [--missing 0.3 0.6 0.9] [--realistic 0.6] [--output FILE]

Each scan is trained on, decoded again with the result, and trained on once more: the real commands.
Coordinates are compared with exact ones, meshes with the true surface after rigid alignment: with all of it, and with
what the captures see of it, where each lit pixel counts. Rows that are in the
result file are not measured again, so an interrupted benchmark continues. A case takes two to three minutes of a core.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from benchmarks.common.measuring import Rows, kept_rows, parsed
from benchmarks.common.runs import evaluate, export, run, train
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.render import FrameGeometry, visible_centres
from sl_nerfstudio.synthesis.synthesise import make_setup, synthesise

WRONG_PX = 2.0
_NO_TRUTH = 1e3  # error of a coordinate where no light falls


@dataclass(frozen=True)
class Config:
    """Which scans are measured."""

    scenes: tuple[str, ...] = ("head", "frog")
    missing: tuple[float, ...] = (0.3, 0.6, 0.9)  # shares of missing cells in plain scans
    realistic: tuple[float, ...] = (0.6,)  # in scans of realistic photographs
    frames: int = 12
    resolution: int = 280
    iterations: int = 400  # steps of each training
    seed: int = 3  # of the scans
    output: Path = Path("benchmarks/results/redecode.json")


@dataclass(frozen=True)
class Surface:
    """Figures of one mesh after rigid alignment, and of the cameras; lengths in mm."""

    rmse: float
    median: float
    completeness_mean: float
    completeness_rmse: float
    f_score: float  # at 0.2 % of the object's size
    camera_mm: float
    camera_deg: float
    seen_mean: float | None = None  # distance of what lit pixels see from the mesh; None in rows of an earlier version
    seen_close: float | None = None  # share of it that is within 0.2 % of the object's size


@dataclass(frozen=True)
class Row:
    """One scan before and after it was decoded again; shares between 0 and 1, errors in pattern pixels."""

    scene: str
    appearance: str
    missing: float
    frames: int
    resolution: int
    iterations: int
    seed: int
    decoded_before: float
    decoded_after: float
    wrong_before: float  # of the decoded pixels
    wrong_after: float
    added_median: float
    added_p95: float
    added_wrong: float  # of the added and replaced pixels, more than WRONG_PX off, or where no light falls
    replaced: int
    removed: int
    removed_wrong: float  # share of the removed ones that were wrong
    accepted_elsewhere: float  # share that would be accepted at places that are certainly wrong
    before: Surface
    after: Surface


def measure(scene: str, appearance: str, missing: float, config: Config, folder: Path) -> Row:
    """Make a scan, train, decode again, train."""
    synth = SynthConfig(
        scene=scene, appearance="plain" if appearance == "plain" else "realistic", frames=config.frames,
        resolution=config.resolution, missing=missing, seed=config.seed,
    )  # fmt: skip
    first, second = folder / "scan", folder / "again"
    synthesise(synth, first)
    truth, p_world = _truth(synth)
    trained, before = _trained(first, folder / "a", p_world, config)
    run("sl-redecode", "--load-config", trained, "--output", second)
    _, after = _trained(second, folder / "b", p_world, config)
    record = json.loads((second / "redecoding.json").read_text())
    learnt = [f["accepted_elsewhere"] for f in record["frames"] if f["limits"]]
    old, new = _coordinates(first), _coordinates(second)
    error = [_errors(coords, truth) for coords in (old, new)]
    was, now = (np.isfinite(coords[..., 0]) for coords in (old, new))
    changed = now & ~(was & (old == new).all(-1))
    fresh, gone = error[1][changed], error[0][was & ~now]
    masked = sum(frame.read_mask().sum() for frame in read_scan(first).frames)
    return Row(
        scene, appearance, missing, config.frames, config.resolution, config.iterations, config.seed,
        decoded_before=float(was.sum() / masked),
        decoded_after=float(now.sum() / masked),
        wrong_before=_wrong(error[0][was]),
        wrong_after=_wrong(error[1][now]),
        added_median=float(np.median(fresh)) if len(fresh) else float("nan"),
        added_p95=float(np.percentile(fresh, 95)) if len(fresh) else float("nan"),
        added_wrong=_wrong(fresh),
        replaced=int((changed & was).sum()),
        removed=len(gone),
        removed_wrong=_wrong(gone),
        accepted_elsewhere=float(np.mean(learnt)) if learnt else 0.0,
        before=before,
        after=after,
    )  # fmt: skip


def _trained(scan: Path, out: Path, p_world: Float64[ndarray, "n 3"], config: Config) -> tuple[Path, Surface]:
    """Train, export and evaluate; `p_world` is what lit pixels see. Returns the run's config.yml, too."""
    trained = train(scan, out, "now", ("--max-num-iterations", config.iterations))
    mesh, poses = out / "mesh.ply", out / "refined"
    export(trained, mesh, poses, "--resolution", 256)
    found = evaluate(mesh, scan, poses, out / "e.json")
    accuracy, completeness = found["rigid"]["accuracy"], found["rigid"]["completeness"]
    f_distance, f_score = list(found["rigid"]["f_score"].items())[1]
    T_mesh_truth = np.linalg.inv(found["rigid"]["matrix"])
    distance = IndexedMesh(read_mesh(mesh)).closest(p_world @ T_mesh_truth[:3, :3].T + T_mesh_truth[:3, 3]).distance
    return trained, Surface(
        accuracy["rmse"], accuracy["median"], completeness["mean"], completeness["rmse"], f_score,
        found["camera"]["translation_rmse"], found["camera"]["rotation_rmse_deg"], float(distance.mean()),
        float((distance < float(f_distance)).mean()),
    )  # fmt: skip


def _coordinates(scan: Path) -> Float32[ndarray, "n h w 2"]:
    return np.stack([frame.read_coords() for frame in read_scan(scan).frames])


def _truth(config: SynthConfig) -> tuple[Float32[ndarray, "n h w 2"], Float64[ndarray, "k 3"]]:
    """Exact coordinates of all frames, NaN where no light falls; and what every fifth lit pixel sees."""
    setup = make_setup(config)
    poses = zip(setup.truth.T_world_camera, setup.truth.T_world_projector, strict=True)
    seen = [
        visible_centres(FrameGeometry(setup.caster, setup.devices, camera, projector)) for camera, projector in poses
    ]
    return np.stack([s.coords(setup.devices.camera) for s in seen]), np.concatenate(
        [s.p_world[s.lit][::5] for s in seen]
    )


def _errors(coords: Float32[ndarray, "n h w 2"], truth: Float32[ndarray, "n h w 2"]) -> Float32[ndarray, "n h w"]:
    error = np.abs(coords - truth).max(-1)
    return np.where(np.isfinite(truth[..., 0]), error, np.float32(_NO_TRUTH))


def _wrong(errors: Float32[ndarray, "k"]) -> float:
    return float((errors > WRONG_PX).mean()) if len(errors) else 0.0


def _row(before: dict[str, Any], after: dict[str, Any], **rest: Any) -> Row:
    return Row(**rest, before=Surface(**before), after=Surface(**after))


def main() -> None:
    """Run the benchmark."""
    config = parsed(Config, __doc__)
    rows = Rows(config.output, kept_rows(config.output, _row))
    size = {name: getattr(config, name) for name in ("frames", "resolution", "iterations", "seed")}
    kinds = [("plain", share) for share in config.missing] + [("realistic", share) for share in config.realistic]
    for scene in config.scenes:
        for appearance, missing in kinds:
            if not rows.have(scene=scene, appearance=appearance, missing=missing, **size):
                with TemporaryDirectory() as folder:
                    rows.add(measure(scene, appearance, missing, config, Path(folder)))


if __name__ == "__main__":
    main()
