"""A run whose scan got another known length, or other pictures without the pattern: nothing of it is trained again.

The scene in which a run is trained has no unit, and no pictures. So the surface and the poses stay as they are; the
factor to the scan's unit, and with it the uncertainty of all lengths, follow the length that is known now.
"""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy import ndarray

from sl_nerfstudio.dataparser.dataparser import LoadedScan, load_scan
from sl_nerfstudio.geometry.lie import inverse
from sl_nerfstudio.model.pose_refinement import at_known_length, scene_rig
from sl_nerfstudio.model.run_files import (
    PARTIAL,
    SCAN_KEY,
    as_tensor,
    checkpoint_name,
    read_checkpoint,
    write_checkpoint,
)
from sl_nerfstudio.runs.run import last_checkpoint, read_config
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.storage import write_atomic

_DECIMALS = 9  # of lengths in mean baselines: another unit changes no more than their rounding
_POSES, _TRANSFORM = "_model.device_poses.", "dataparser_transforms.json"


def training_key(scan: Scan) -> str:
    """SHA-256 (hexadecimal) of what a training takes from a scan; the same in every unit, and with any pictures."""
    whole = hashlib.sha256(repr(scan.projector).encode())
    of_one = scan.scaled(1 / (float(scan.poses.baseline.mean()) or 1.0))
    paths = [scan.pattern_path]
    for frame in of_one.frames:
        sigma = () if frame.pose_sigma is None else tuple(vars(frame.pose_sigma).values())
        numbers = np.concatenate([frame.T_world_camera.ravel(), frame.T_world_projector.ravel(), sigma])
        whole.update(f"{frame.name} {frame.camera!r} {_rounded(numbers).tolist()}".encode())
        coords = frame.coords_files
        if coords is not None and coords.are_images:  # an array says all by itself
            whole.update(f"{coords.units} {coords.pattern}".encode())
        paths += [path for path in (*frame.coords_paths, frame.mask_path, frame.pattern_path) if path is not None]
    for path in paths:
        whole.update(hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()


def _rounded(numbers: ndarray) -> ndarray:
    return np.round(numbers, _DECIMALS) + 0.0  # no negative zero


def follow_scan(path: Path, scan: Path, output: Path) -> Any:
    """Let the run with the config.yml at `path` belong to a scan with the same `training_key`; returns its settings.

    `output` is the folder that holds the run as nerfstudio's `--output-dir` does, so that both folders may have been
    moved. Nothing happens if all is as it was. If the process is killed, the next call completes what is missing.
    Raises UserError for a run or a scan that cannot be read, or if a file cannot be written.
    """
    config: Any = read_config(path)
    parser, data = config.pipeline.datamanager.dataparser, config.pipeline.datamanager
    loaded = load_scan(scan, parser.intrinsics_change)
    before = config.pipeline.scan_fingerprint, data.data, config.output_dir
    if before == (loaded.fingerprint, scan, output):
        return config
    config.data = data.data = scan
    config.output_dir = output
    if config.pipeline.scan_fingerprint != loaded.fingerprint:
        parser.length_factor = _follow(last_checkpoint(config, path), loaded, config, path.parent / PARTIAL)
        config.pipeline.scan_fingerprint = loaded.fingerprint
        S = load_scan(scan, parser.intrinsics_change, parser.length_factor).S_scene_world
        place = {"transform": (S.matrix()[:3] / S.scale).tolist(), "scale": S.scale}
        write_atomic(path.parent / _TRANSFORM, json.dumps(place, indent=4).encode())
    config.save_config()
    return config


def _follow(checkpoint: Path, loaded: LoadedScan, config: Any, partial: Path) -> float:
    """Give a checkpoint to the scan; returns the factor by which the scan's lengths hold at its poses."""
    read_checkpoint(checkpoint)  # says what is wrong with it
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    weights, model, factor = state["pipeline"], config.pipeline.model, 1.0
    camera, projector = (weights[f"{_POSES}base_{name}"] for name in ("camera", "projector"))
    adjusted = not torch.equal(camera, weights[f"{_POSES}start_camera"])
    joint = weights[f"{_POSES}joint_factor"]
    if adjusted and not bool(joint.isnan().any()):
        start = scene_rig(loaded.scan, loaded.S_scene_world)
        rig = replace(start, T_world_camera=camera, T_camera_projector=inverse(camera) @ projector)
        factor, weights[f"{_POSES}joint_factor"] = at_known_length(
            loaded.scan, loaded.S_scene_world, model.refine_poses, model.prior, rig, joint
        )
    weights[SCAN_KEY] = as_tensor(loaded.fingerprint)
    write_checkpoint(checkpoint.with_name(checkpoint_name(state["step"])), state, partial)
    return factor
