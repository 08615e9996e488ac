"""The commands a user types, and what they make scored against the truth of synthetic scans."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sl_nerfstudio.dataparser.dataparser import LoadedScan
    from sl_nerfstudio.synthesis.config import SynthConfig


@dataclass(frozen=True)
class Score:
    """Errors of one run; lengths in mm."""

    rigid_rmse: float
    rigid_median: float
    similarity_rmse: float
    completeness_rmse: float
    camera_translation_rmse: float
    camera_rotation_rmse_deg: float
    coordinate_px: float
    training_seconds: float  # of the whole command: start-up, bundle adjustment, training


def run(*command: object) -> None:
    """Run a command of this environment, showing its output only if it fails."""
    words = [str(Path(sys.executable).parent / str(command[0])), *map(str, command[1:])]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}")


def made_once(config: "SynthConfig", parent: Path) -> "LoadedScan":
    """The scan of `config`, from its folder below `parent`; it is made if it does not exist.

    Raises UserError if an interrupted run has left an incomplete scan there.
    """
    from sl_nerfstudio.dataparser.dataparser import load_scan
    from sl_nerfstudio.synthesis.synthesise import synthesise

    folder = parent / f"{config.scene}-{config.frames}-{config.resolution}-{config.seed}"
    if not (folder / "transforms.json").exists():
        synthesise(config, folder)
    return load_scan(folder)


def scan_to_train_on(given: Path | None) -> Path:
    """The scan that is given, or a small one, made once."""
    from sl_nerfstudio.synthesis.config import SynthConfig

    return given or made_once(SynthConfig(frames=4, resolution=96), Path("outputs/bench")).scan.root


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


def process(captures: Path, output: Path, work: Path, jobs: int, *more: str) -> str:
    """Run sl-process on captures of the project; return what it says if it makes no scan, else ""."""
    files = {"images": "images", "pattern": "pattern.json", "intrinsics": "intrinsics.json"}
    flags = [word for flag, name in files.items() for word in (f"--{flag}", str(captures / name))]
    flags += ["--output", str(output), "--work", str(work), "--jobs", str(jobs), *more]
    command = [sys.executable, "-m", "sl_nerfstudio.cli.process", *flags]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else done.stderr.strip() or f"exit status {done.returncode}"


def train(data: Path, folder: Path, name: str, options: Sequence[object] = (), method: str = "sl-neus") -> Path:
    """Train on a scan; `name` distinguishes the runs in `folder`. Return the run's config.yml."""
    run("ns-train", method, "--data", data, "--output-dir", folder, "--experiment-name", "run", "--timestamp", name,
        *options)  # fmt: skip
    return folder / "run" / method / name / "config.yml"


def export(config: Path, mesh: Path, poses: Path, *more: object) -> None:
    """Export the surface and the poses of a run."""
    run("sl-export", "--load-config", config, "--output", mesh, "--poses", poses, *more)


def evaluate(mesh: Path, data: Path, poses: Path, result: Path, *more: object) -> dict[str, Any]:
    """The figures of sl-eval, which are written to `result`."""
    run("sl-eval", "--mesh", mesh, "--data", data, "--poses", poses / "transforms.json", "--json", result, *more)
    return json.loads(result.read_text())


def train_and_score(data: Path, folder: Path, name: str, options: Sequence[str], method: str = "sl-neus") -> Score:
    """Train on a scan with truth, export, evaluate."""
    begin = time.monotonic()
    config = train(data, folder, name, options, method)
    seconds = time.monotonic() - begin
    mesh, poses = folder / f"{name}.ply", folder / name
    export(config, mesh, poses)
    found = evaluate(mesh, data, poses, folder / f"{name}.json")
    rigid, similarity, camera = found["rigid"], found["similarity"], found["camera"]
    return Score(
        rigid["accuracy"]["rmse"], rigid["accuracy"]["median"], similarity["accuracy"]["rmse"],
        rigid["completeness"]["rmse"], camera["translation_rmse"], camera["rotation_rmse_deg"],
        found["fit"]["coordinate_px_median"], seconds,
    )  # fmt: skip
