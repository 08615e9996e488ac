"""Whole runs with the commands a user types, scored against the truth of synthetic scans."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


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

    def text(self) -> str:
        """The figures as the end of a table row."""
        return (
            f"rigid RMSE {self.rigid_rmse:.3f} median {self.rigid_median:.3f} | similarity {self.similarity_rmse:.3f} "
            f"| complete {self.completeness_rmse:.3f} | camera {self.camera_translation_rmse:.3f} mm "
            f"{self.camera_rotation_rmse_deg:.3f} deg | {self.coordinate_px:.2f} px | {self.training_seconds:.0f} s"
        )


def run(*command: str) -> None:
    """Run a command of this environment, showing its output only if it fails."""
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


def train_and_score(data: Path, folder: Path, name: str, options: Sequence[str], method: str = "sl-neus") -> Score:
    """Train on a scan with truth, export, evaluate; `name` distinguishes the runs in `folder`."""
    begin = time.monotonic()
    fixed = ("--output-dir", str(folder), "--experiment-name", "run", "--timestamp", name)
    run("ns-train", method, "--data", str(data), *fixed, *options)
    seconds = time.monotonic() - begin
    config = folder / "run" / method / name / "config.yml"
    mesh, poses, result = folder / f"{name}.ply", folder / name, folder / f"{name}.json"
    run("sl-export", "--load-config", str(config), "--output", str(mesh), "--poses", str(poses))
    run("sl-eval", "--mesh", str(mesh), "--data", str(data), "--poses", str(poses / "transforms.json"),
        "--json", str(result))  # fmt: skip
    found = json.loads(result.read_text())
    rigid, similarity, camera = found["rigid"], found["similarity"], found["camera"]
    return Score(
        rigid["accuracy"]["rmse"],
        rigid["accuracy"]["median"],
        similarity["accuracy"]["rmse"],
        rigid["completeness"]["rmse"],
        camera["translation_rmse"],
        camera["rotation_rmse_deg"],
        found["fit"]["coordinate_px_median"],
        seconds,
    )
