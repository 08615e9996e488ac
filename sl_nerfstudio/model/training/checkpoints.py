"""Checkpoints: found by name, read without running code from them, checked, and replaced as a whole."""

import re
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.geometry.devices import IntrinsicsChange
from sl_nerfstudio.model.training.fingerprints import as_text

_NAME = re.compile(r"step-(\d{9,18})\.ckpt")
SCAN_KEY, SETTINGS_KEY = "scan_fingerprint", "settings_fingerprint"  # among the weights
SCHEDULE_KEY = "schedule_iterations"  # beside nerfstudio's own parts
_PARTS = ("step", "pipeline", "optimizers", "schedulers", "scalers", SCHEDULE_KEY)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that was read and has the expected parts."""

    path: Path
    step: int  # the last step that is in it; -1: poses are adjusted, training has not begun
    weights: dict[str, Tensor]  # of the pipeline
    schedule_iterations: int  # steps over which learning rates decay and annealing takes place

    @property
    def intrinsics_change(self) -> IntrinsicsChange | None:
        """How the intrinsics of the scan were changed for the run; None where the checkpoint does not say."""
        changes = [value for key, value in self.weights.items() if key.endswith("_model.intrinsics_change")]
        return IntrinsicsChange.of(changes[0].tolist()) if changes else None

    @property
    def scan(self) -> str:
        """Fingerprint of the scan it was trained on, "" where it has none."""
        return as_text(self.weights.get(SCAN_KEY))

    @property
    def settings(self) -> str:
        """Fingerprint of the settings it was trained with, "" where it has none."""
        return as_text(self.weights.get(SETTINGS_KEY))


def checkpoint_name(step: int) -> str:
    """File name of the checkpoint after a step; that of the adjusted poses (-1) has number 0."""
    return f"step-{max(step, 0):09d}.ckpt"


def checkpoints_in(folder: Path) -> list[Path]:
    """All files with the name of a checkpoint, the last step at the end; other files are left alone."""
    try:
        found = [(int(match[1]), path) for path in folder.iterdir() if (match := _NAME.fullmatch(path.name))]
    except OSError:
        return []
    return [path for _, path in sorted(found)]


def find_checkpoint(load_dir: Path | None, load_step: int | None, load_checkpoint: Path | None) -> Path | None:
    """The checkpoint that the flags of the same names choose, None for a new run. Raises UserError if it is missing."""
    if load_dir is not None:
        found = checkpoints_in(load_dir)
        wanted = "step-*.ckpt" if load_step is None else checkpoint_name(load_step)
        if load_step is not None:
            found = [path for path in found if path.name == wanted]
        if not found:
            raise UserError(
                f"--load-dir {load_dir}: no checkpoint {wanted} there. "
                "Give the folder nerfstudio_models/ of a run, which is next to its config.yml."
            )
        return found[-1]
    if load_checkpoint is not None and not load_checkpoint.is_file():
        raise UserError(f"--load-checkpoint {load_checkpoint}: no such file")
    return load_checkpoint


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint and check its parts. Raises UserError if it is damaged or something else.

    Only tensors and plain values are read from it, so that a file from elsewhere cannot run code.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()  # torch itself does not look at the checksums
        state: Any = None if damaged else torch.load(path, map_location="cpu", mmap=True, weights_only=True)
    except Exception as error:  # a damaged file makes torch raise nearly anything
        raise _unreadable(path, f"({type(error).__name__})") from error
    if damaged:
        raise _unreadable(path, "(a checksum is wrong)")
    problem = _problem(state)
    if problem:
        raise _unreadable(path, f"({problem})")
    return Checkpoint(path, state["step"], state["pipeline"], state[SCHEDULE_KEY])


def _unreadable(path: Path, why: str) -> UserError:
    return UserError(
        f"{path}: cannot be read as a checkpoint {why}\n"
        "    cause:  it is truncated or damaged, for example by a full disk, or another kind of file\n"
        "    remedy: remove it, so that an earlier one is used, or train again"
    )


def _problem(state: Any) -> str:
    """What a checkpoint of ns-train has and this does not; "" if it has all."""
    if not isinstance(state, dict):
        return f"it holds a {type(state).__name__}, not the state of a training"
    missing = [key for key in _PARTS if key not in state]
    if missing:
        return f"it lacks {missing[0]}"
    if type(state["step"]) is not int or not -1 <= state["step"] < 10**9:
        return "its step is no number"
    if type(state[SCHEDULE_KEY]) is not int or state[SCHEDULE_KEY] < 1:
        return "the length of its schedule is no number"
    weights = state["pipeline"]
    if not _is_mapping_of(weights, Tensor) or not all(isinstance(key, str) for key in weights):
        return "its pipeline is not made of weights"
    if not all(_is_mapping_of(state[key], Mapping) for key in ("optimizers", "schedulers")):
        return "its optimizers or schedulers are not those of a training"
    if not all(_is_schedule(scheduler) for scheduler in state["schedulers"].values()):
        return "its schedulers are not those of this package"
    return ""


def _is_mapping_of(value: Any, kind: type) -> bool:
    return isinstance(value, Mapping) and all(isinstance(item, kind) for item in value.values())


def _is_schedule(scheduler: Mapping) -> bool:
    rates = scheduler.get("lr_lambdas")
    if not isinstance(rates, list):
        return False
    return all(rate is None or (isinstance(rate, dict) and type(rate.get("max_steps")) is int) for rate in rates)


def write_checkpoint(path: Path, state: dict[str, Any], partial: Path) -> None:
    """Write to `partial`, then rename it to `path`: a checkpoint is complete or not there.

    `partial` lies outside the folder of the checkpoints, because nerfstudio takes every file there for one.
    Raises UserError if that fails, for example on a full disk; checkpoints that are there remain.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(state, partial)
        partial.replace(path)
    except (OSError, RuntimeError) as error:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        reason = first_line(error)
        raise UserError(
            f"{path}: cannot be written ({reason})\n"
            "    cause:  the disk is full, or the folder is read-only or was removed\n"
            "    remedy: free some space; the checkpoints written before are unchanged"
        ) from error
