"""A finished training run, loaded for export on the GPU if there is one, else on the CPU."""

import json
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.joint_covariance.covariance import JointCovariance
from sl_nerfstudio.bundle_adjustment.self_calibration import SelfCalibration
from sl_nerfstudio.errors import UserError, last_line
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.late_compiler import compiler_on_demand, shapes_without_symbols
from sl_nerfstudio.model.training.checkpoints import checkpoints_in, read_checkpoint
from sl_nerfstudio.model.training.fingerprints import settings_fingerprint
from sl_nerfstudio.scan import Scan

_SAME_SCENE = 1e-3  # scene units: far above the rounding of float32, far below what is visible


@runtime_checkable
class TrainedModel(Protocol):
    """What an export needs from a model; poses are in the scan's world and unit, the field is in the scene frame."""

    scan: Scan
    S_scene_world: Similarity

    @property
    def cell(self) -> float:
        """Length of the field's finest cells, in the scan's unit."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the field is evaluated."""
        ...

    def sdf(self, p_scene: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distance in scene units."""
        ...

    def poses(self) -> DevicePoses:
        """Poses of cameras and projectors."""
        ...

    def pose_sigma(self) -> Float[ndarray, "frames 4"] | None:
        """One sigma of each frame's poses, in the order of PoseSigma's fields; None if it was not estimated."""
        ...

    def joint_covariance(self) -> JointCovariance | None:
        """Covariance of all poses and the intrinsics in the scan's world and unit; None if it was not estimated."""
        ...

    def unplaced(self) -> list[bool]:
        """Of each frame, whether it does not agree with the others."""
        ...

    def self_calibration(self) -> SelfCalibration | None:
        """How well the intrinsics agree with the captures; None where poses were not adjusted."""
        ...

    def history(self) -> dict[str, list[float]]:
        """Convergence curves, with the steps under `step`."""
        ...


@dataclass(frozen=True)
class TrainedRun:
    """A model with the settings it was trained under."""

    model: TrainedModel
    config: Any  # nerfstudio's TrainerConfig
    step: int


def load_run(config_path: Path, data: Path | None = None) -> TrainedRun:
    """Load the last checkpoint of the run that `config_path` (config.yml) describes.

    nerfstudio's own `eval_setup` fails with assertions or tracebacks if files were moved or truncated. Here a run whose
    folder was moved is found next to its config.yml, and `data` gives the scan folder if that was moved.
    Raises UserError for anything missing, broken or made by another method.
    """
    with warnings.catch_warnings(), compiler_on_demand():
        warnings.simplefilter("ignore", FutureWarning)  # nerfstudio's own, at its import
        from sl_nerfstudio.dataparser.dataparser import load_scan
        from sl_nerfstudio.model.pipeline import SLPipeline, require_together
        from sl_nerfstudio.runs.config_file import read_config

    path = config_file(config_path)
    config: Any = read_config(path)
    checkpoint = read_checkpoint(last_checkpoint(config, path))
    if checkpoint.step < 0:
        raise UserError(
            f"{checkpoint.path}: holds adjusted poses, but no surface yet\n"
            "    cause:  the training was interrupted before its first step\n"
            f"    remedy: go on: ns-train {config.method_name} --load-config {path}"
        )
    require_settings(path, config)
    root = _scan_folder(config, data)
    config.pipeline.datamanager.data = root
    device = "cuda" if torch.cuda.is_available() else "cpu"
    loaded = load_scan(root, config.pipeline.datamanager.dataparser.intrinsics_change)
    require_together(config.pipeline, checkpoint.weights, root, loaded.fingerprint)
    with shapes_without_symbols():
        pipeline: Any = SLPipeline(config.pipeline, device, test_mode="inference")
    _require_same_keys(checkpoint.path, checkpoint.weights, pipeline.state_dict())
    try:
        pipeline.load_pipeline(checkpoint.weights, checkpoint.step)
    except RuntimeError as error:
        raise UserError(
            f"{checkpoint.path}: does not fit the settings in {path} ({last_line(error)})\n"
            "    cause:  another version of this package was used\n"
            "    remedy: use the version that trained it, or train again"
        ) from error
    pipeline.eval()
    _require_same_scene(path.absolute().parent / "dataparser_transforms.json", pipeline.model.S_scene_world)
    return TrainedRun(pipeline.model, config, checkpoint.step)


def config_file(path: Path) -> Path:
    """The config.yml of a run, given it or its folder."""
    return path / "config.yml" if path.is_dir() else path


def require_settings(path: Path, config: Any) -> None:
    """Raise UserError if settings in config.yml that decide the result were edited after the run began."""
    if settings_fingerprint(config) != config.pipeline.settings_fingerprint:
        raise UserError(
            f"{path}: its settings are not those that the run was started with\n"
            "    cause:  the file was edited, or written by another version of this package\n"
            "    remedy: put back the original file, or train again with the settings that you want"
        )


def last_checkpoint(config: Any, path: Path) -> Path:
    """The last checkpoint next to config.yml, or where the settings put it if there is none. Raises UserError."""
    folders = [path.absolute().parent / config.relative_model_dir, config.get_checkpoint_dir()]
    for folder in folders:
        found = checkpoints_in(folder)
        if found:
            return found[-1]
    raise UserError(
        f"{folders[0]}: no checkpoint step-*.ckpt\n"
        "    cause:  the training was interrupted before its first checkpoint, or its folder was moved\n"
        "    remedy: train again, or put nerfstudio_models/ back next to config.yml"
    )


def _scan_folder(config: Any, data: Path | None) -> Path:
    from sl_nerfstudio.dataparser.dataparser import scan_root

    stated = data or config.pipeline.datamanager.data or config.pipeline.datamanager.dataparser.data
    root = scan_root(stated)
    if not (root / "transforms.json").is_file():
        cause = "the path is mistyped" if data else "the scan was moved, renamed or deleted after the training"
        raise UserError(
            f"{root}: has no transforms.json, so it is not the scan that the run was trained on\n"
            f"    cause:  {cause}\n    remedy: give its folder: --data FOLDER"
        )
    return root


def _require_same_keys(path: Path, stored: Iterable[str], wanted: Iterable[str]) -> None:
    """Raise UserError if weights are missing: nerfstudio would silently keep their initial values."""
    missing = {_plain(key) for key in wanted} - {_plain(key) for key in stored}
    if missing:
        raise UserError(
            f"{path}: lacks {len(missing)} of the model's weights, such as {min(missing)}\n"
            "    cause:  it was written by another version of this package, or with other settings\n"
            "    remedy: use the version that trained it, or train again"
        )


def _require_same_scene(path: Path, S_scene_world: Similarity) -> None:
    """Raise UserError if the scan now gives another scene frame than the one nerfstudio stored in training."""
    try:
        stated = json.loads(path.read_text(encoding="utf-8"))
        trained = stated["scale"] * np.array(stated["transform"], dtype=np.float64)
    except (OSError, ValueError, KeyError, TypeError):
        return  # without that file there is nothing to compare with
    corners = S_scene_world.inverse().points(np.array(list(product((-1.0, 1.0), repeat=3))))
    moved = corners @ trained[:, :3].T + trained[:, 3] - S_scene_world.points(corners)
    if np.abs(moved).max() > _SAME_SCENE:
        raise UserError(
            f"{path}: the scan has another place in the scene than in the training "
            f"(off by {np.abs(moved).max():.2g} of the scene's radius)\n"
            "    cause:  the file was edited, or another version of this package made the run\n"
            "    remedy: put back the file, use the version that trained it, or train again"
        )


def _plain(key: str) -> str:
    return key.replace("module.", "")  # added by training on several GPUs
