"""Checks before training starts: faults are found before anything is written."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from pickle import UnpicklingError
from typing import Literal

import torch
from nerfstudio.engine.schedulers import SchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig

from sl_nerfstudio.dataparser.dataparser import SLDataParserConfig, load_scan, scan_root
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import IntrinsicsChange
from sl_nerfstudio.model.config import SLModelConfig
from sl_nerfstudio.model.intrinsics_refinement import refine_intrinsics
from sl_nerfstudio.model.messages import refined_intrinsics_message
from sl_nerfstudio.model.optimisers import DecaySchedulerConfig
from sl_nerfstudio.scan import require_valid


@dataclass
class SLTrainerConfig(TrainerConfig):
    """nerfstudio's settings of a run, checked before the run starts."""

    schedule_iterations: int | None = None
    """Number of steps over which learning rates decay and annealing takes place: by default --max-num-iterations, or
    for a resumed run the length of the run that it resumes."""

    def set_timestamp(self) -> None:
        """Check the run; nerfstudio calls this first, before it writes the run's folder.

        An error that the user can fix is printed without a traceback and ends the process with status 1.
        """
        try:
            self.prepare()
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(1) from None
        super().set_timestamp()

    def prepare(self) -> None:
        """Check scan, device and checkpoint; make paths absolute; set intrinsics and the length of the schedules.

        Raises UserError.
        """
        root = self._scan_root()
        if self.max_num_iterations < 1:
            raise UserError(f"--max-num-iterations {self.max_num_iterations}: at least 1 is needed")
        _require_device(self.machine.device_type)
        checkpoint = find_checkpoint(self.load_dir, self.load_step, self.load_checkpoint)
        begun = None if checkpoint is None else read_begun(checkpoint)
        require_valid(root)
        dataparser = self.pipeline.datamanager.dataparser  # type: ignore[attr-defined]
        model: SLModelConfig = self.pipeline.model  # type: ignore[assignment]
        dataparser.intrinsics_change = _intrinsics_change(root, dataparser.intrinsics_change, begun, model)
        load_scan(root, dataparser.intrinsics_change)  # cached; fails if no rays meet
        self.data = root
        self.pipeline.datamanager.data = root
        self.output_dir = self.output_dir.expanduser().absolute()
        if self.schedule_iterations is None:
            stated = None if begun is None else begun.schedule_iterations
            self.schedule_iterations = stated or self.max_num_iterations
        model.schedule_iterations = self.schedule_iterations
        self.optimizers = {
            name: {**group, "scheduler": _with_length(group["scheduler"], self.schedule_iterations)}
            for name, group in self.optimizers.items()
        }

    def _scan_root(self) -> Path:
        dataparser = self.pipeline.datamanager.dataparser  # type: ignore[attr-defined]
        if not isinstance(dataparser, SLDataParserConfig):
            raise UserError(
                f"{self.method_name} trains on scan folders only, which `sl-data` reads; "
                f"{type(dataparser).__name__.removesuffix('Config')} has no projector. Leave the dataparser out."
            )
        data = self.pipeline.datamanager.data or dataparser.data
        if data == Path():
            raise UserError(f"no scan given. Add --data FOLDER: ns-train {self.method_name} --data FOLDER")
        return scan_root(data)


def _intrinsics_change(
    root: Path, stated: IntrinsicsChange, begun: "BegunRun | None", model: SLModelConfig
) -> IntrinsicsChange:
    """The change of the intrinsics: that of the run it resumes, else the stated one, refined on request."""
    if begun is not None and begun.intrinsics_change is not None:
        if stated and stated != begun.intrinsics_change:
            raise UserError(
                f"sl-data --intrinsics-change {stated.values}: the checkpoint was trained with "
                f"{begun.intrinsics_change.values}\n    cause:  a run is resumed with other intrinsics\n"
                "    remedy: leave the option out; the run then continues with the same intrinsics as before"
            )
        return begun.intrinsics_change
    if not model.refine_intrinsics:
        return stated
    if not model.adjusts_poses:
        raise UserError(
            "--pipeline.model.refine-intrinsics: intrinsics are refined together with the poses, but the poses are not "
            f"adjusted\n    cause:  --pipeline.model.refine-poses {model.refine_poses}, "
            f"--pipeline.model.pose-method {model.pose_method}\n"
            "    remedy: leave out either these options or refine-intrinsics"
        )
    loaded = load_scan(root)
    found = refine_intrinsics(loaded, stated, model.refine_poses, model.prior, model.adjustment)
    cameras = [frame.camera for frame in loaded.scan.frames]
    print(refined_intrinsics_message(found, cameras, loaded.scan.projector), flush=True)
    return found.change


def _with_length(scheduler: SchedulerConfig | None, steps: int) -> SchedulerConfig | None:
    if isinstance(scheduler, DecaySchedulerConfig) and scheduler.max_steps is None:
        return replace(scheduler, max_steps=steps)
    return scheduler


def default_device() -> Literal["cpu", "cuda"]:
    """`cuda` where torch can use a GPU, else `cpu`."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def _require_device(device_type: str) -> None:
    available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if not available[device_type]:
        raise UserError(
            f"--machine.device-type {device_type}: torch {torch.__version__} finds no such device on this machine. "
            "Leave the option out to train on an available device."
        )


@dataclass(frozen=True)
class BegunRun:
    """What a checkpoint records about the run that wrote it; None where it records nothing."""

    schedule_iterations: int | None
    intrinsics_change: IntrinsicsChange | None


def find_checkpoint(load_dir: Path | None, load_step: int | None, load_checkpoint: Path | None) -> Path | None:
    """The checkpoint that nerfstudio will load, None for a new run. Raises UserError if it is missing."""
    if load_dir is not None:
        pattern = "step-*.ckpt" if load_step is None else f"step-{load_step:09d}.ckpt"
        found = sorted(load_dir.glob(pattern))
        if not found:
            raise UserError(
                f"--load-dir {load_dir}: no checkpoint {pattern} there. "
                "Give the folder nerfstudio_models/ of a run, which is next to its config.yml."
            )
        return found[-1]
    if load_checkpoint is not None and not load_checkpoint.is_file():
        raise UserError(f"--load-checkpoint {load_checkpoint}: no such file")
    return load_checkpoint


def read_begun(checkpoint: Path) -> BegunRun:
    """What a checkpoint records about the run that wrote it. Raises UserError if it is unreadable."""
    try:
        state = torch.load(checkpoint, map_location="cpu", mmap=True)
        schedulers, weights = state.get("schedulers", {}), state.get("pipeline", {})
    except (RuntimeError, OSError, ValueError, EOFError, UnpicklingError) as error:
        raise UserError(
            f"{checkpoint}: cannot be read as a checkpoint ({type(error).__name__}). "
            "It is probably incomplete. Choose an older one with --load-step, or train again."
        ) from error
    lengths = [rate["max_steps"] for s in schedulers.values() for rate in s.get("lr_lambdas", []) if rate]
    changes = [value for key, value in weights.items() if key.endswith("model.intrinsics_change")]
    change = IntrinsicsChange.of(changes[0].tolist()) if changes else None
    return BegunRun(max(lengths, default=None), change)
