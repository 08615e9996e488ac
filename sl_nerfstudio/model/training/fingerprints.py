"""With which settings a run was made: a hash that its config.yml and its checkpoints carry."""

import hashlib
import json
import math
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor

_WITHOUT_EFFECT = {"eval_num_rays_per_chunk", "prompt"}  # settings of the model that do not change its result


def settings_fingerprint(config: Any) -> str:
    """SHA-256 (hexadecimal) of the settings that determine the result of a run; `config` is an SLTrainerConfig."""
    return hashlib.sha256(json.dumps(decisive_settings(config), sort_keys=True).encode()).hexdigest()


def decisive_settings(config: Any) -> dict[str, Any]:
    """The settings that determine the result of a run, as JSON values: not where it is written, nor on which device.

    The number of steps is left out, too: training can go on.
    """
    model = {name: value for name, value in plain(config.pipeline.model).items() if name not in _WITHOUT_EFFECT}
    return {
        "method_name": config.method_name,
        "seed": config.machine.seed,
        "mixed_precision": config.mixed_precision,
        "schedule_iterations": config.schedule_iterations,
        "optimizers": plain(config.optimizers),
        "rays": config.pipeline.datamanager.train_num_rays_per_batch,
        "intrinsics_change": plain(config.pipeline.datamanager.dataparser.intrinsics_change),
        "model": model,
    }


def differences(before: Any, now: Any, name: str = "") -> list[str]:
    """Names of the settings, joined by dots, in which two results of `decisive_settings` differ."""
    if isinstance(before, dict) and isinstance(now, dict):
        keys = dict.fromkeys((*before, *now))
        parts = [differences(before.get(key), now.get(key), f"{name}.{key}" if name else key) for key in keys]
        return [line for part in parts for line in part]
    return [] if before == now else [f"{name} ({before} there, {now} here)"]


def plain(value: Any) -> Any:
    """Dataclasses, paths, types, numbers and containers as JSON values; numbers that are not finite become None."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value) if not f.name.startswith("_")}
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return value.__name__ if isinstance(value, type) else str(value)


def as_tensor(fingerprint: str | None) -> UInt8[Tensor, "32"]:
    """A fingerprint as a checkpoint stores it; zeros for None."""
    return torch.frombuffer(bytearray(bytes.fromhex(fingerprint or "00" * 32)), dtype=torch.uint8)


def as_text(fingerprint: Any) -> str:
    """The inverse of `as_tensor`; "" for anything that `as_tensor` does not return."""
    good = isinstance(fingerprint, Tensor) and fingerprint.shape == (32,) and fingerprint.dtype == torch.uint8
    return bytes(fingerprint.tolist()).hex() if good else ""
