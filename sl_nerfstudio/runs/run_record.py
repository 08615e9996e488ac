"""What a person needs to repeat a run: settings, versions, convergence; as plain JSON values."""

import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch

from sl_nerfstudio.bundle_adjustment.self_calibration import SelfCalibration
from sl_nerfstudio.geometry.devices import IntrinsicsChange
from sl_nerfstudio.model.settings import RECOMMENDED_STEPS
from sl_nerfstudio.model.training.fingerprints import plain
from sl_nerfstudio.runs.trained_run import TrainedRun

_PACKAGES = ("sl-nerfstudio", "nerfstudio", "torch", "numpy", "scipy", "numba", "open3d")
_SETTINGS = ("method_name", "max_num_iterations", "schedule_iterations", "mixed_precision", "machine", "optimizers")


def training_record(run: TrainedRun) -> dict[str, Any]:
    """`settings` (nested), `versions` (of the export, by package), `curves` (lists by name, NaN as None), `intrinsics`.

    The last says how intrinsics were changed, and how well they agree with the captures.
    """
    return {
        "settings": {"step": run.step, **run_settings(run.config)},
        "versions": {
            **package_versions(),
            "torch": torch.__version__,
            "python": platform.python_version(),
            "device": _device(run.model.device),
        },
        "curves": {name: plain(values) for name, values in run.model.history().items()},
        "intrinsics": {
            "change": plain(run.model.scan.intrinsics_change),
            "self_calibration": _self_calibration(run.model.self_calibration()),
        },
    }


def _self_calibration(found: SelfCalibration | None) -> dict[str, Any] | None:
    """Which change of the intrinsics would agree better with the captures, with its uncertainty."""
    if found is None:
        return None
    return {
        "change": plain(IntrinsicsChange.of(found.change.tolist())),
        "sigma": plain(IntrinsicsChange.of(found.sigma.tolist())),
        "chi_square": found.chi_square,
        "contradicts": found.contradicts(),
    }


def run_settings(config: Any) -> dict[str, Any]:
    """The settings that determine the result of a run, from nerfstudio's trainer configuration."""
    chosen = {name: plain(getattr(config, name)) for name in _SETTINGS if hasattr(config, name)}
    return {
        **chosen,
        "recommended_steps": RECOMMENDED_STEPS.get(config.method_name),
        "data": str(config.pipeline.datamanager.data),
        "rays": config.pipeline.datamanager.train_num_rays_per_batch,
        "intrinsics_change": plain(config.pipeline.datamanager.dataparser.intrinsics_change),
        "model": plain(config.pipeline.model),
    }


def package_versions() -> dict[str, str]:
    """Versions of the packages that do the computation."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def _device(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"{device.type} ({platform.machine()})"
