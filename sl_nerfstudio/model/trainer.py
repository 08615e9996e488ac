"""What `ns-train` is asked for, and what is checked before it starts: faults are found before anything is written."""

import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
import tyro
import yaml
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine.schedulers import SchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig

from sl_nerfstudio.console import paragraph, phase, short_path
from sl_nerfstudio.dataparser.dataparser import SLDataParserConfig, load_scan, require_same_scan, scan_root
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import IntrinsicsChange
from sl_nerfstudio.model import loop
from sl_nerfstudio.model.loop import SLTrainer
from sl_nerfstudio.model.messages import refine_intrinsics, refined_intrinsics_message
from sl_nerfstudio.model.model import SLModelConfig
from sl_nerfstudio.model.optimisers import POSE_GROUPS, DecaySchedulerConfig, default_optimizers
from sl_nerfstudio.model.pipeline import SLPipelineConfig
from sl_nerfstudio.model.run_files import (
    CONFIG,
    INTERRUPTION,
    Checkpoint,
    checkpoints_in,
    find_checkpoint,
    go_on_command,
    quiet_nerfstudio,
    read_checkpoint,
    require_unused,
    settings_fingerprint,
    take_folder,
)
from sl_nerfstudio.parallel import gpu_fault, gpu_found
from sl_nerfstudio.scan import require_valid
from sl_nerfstudio.storage import write_atomic

_TAKEN: dict[Path, int] = {}
"""The folders that this process writes to, with their locks: not part of a configuration, which is a file there."""


@dataclass
class SLTrainerConfig(TrainerConfig):
    """nerfstudio's settings of a run, checked before the run starts."""

    _target: type = field(default_factory=lambda: SLTrainer)
    schedule_iterations: int | None = None
    """Number of steps over which learning rates decay and annealing takes place: by default --max-num-iterations, or
    for a resumed run the length of the run that it resumes."""
    cuda_graph: bool = True
    """On a GPU, record the operations of a step once and repeat them with one launch; off: launch each by itself."""
    tf32: bool = False
    """Let a GPU's matrix products round their factors to 11 bits (TF32), which is faster; see docs/gpu.md."""
    verbose: bool = False
    """Also print all settings and nerfstudio's own messages and table."""
    last_step: tyro.conf.Suppress[int | None] = None
    """Number of the run's last step, set when the run begins; --load-config continues up to it."""

    def __post_init__(self) -> None:
        """Silence nerfstudio once a command line was read: it prints before it calls `set_timestamp`."""
        if self.data is not None or self.load_config is not None:
            quiet_nerfstudio(not self.verbose)

    def set_timestamp(self) -> None:
        """Prepare the run: nerfstudio calls this first, before it writes anything, and has no other place for it."""
        super().set_timestamp()
        self.prepare_run()

    def prepare_run(self) -> None:
        """Check everything that can be wrong, complete the settings, and take the run's folder.

        An error that the user can fix is printed without a traceback and ends the process with status 1.
        """
        self.logging.local_writer.enable |= self.verbose
        quiet_nerfstudio(not self.verbose)
        if self.machine.num_devices * self.machine.num_machines == 1:
            INTERRUPTION.install()
        try:
            self.begin()
        except UserError as error:
            INTERRUPTION.remove()
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(1) from None

    def begin(self) -> None:
        """Check everything, complete the settings, and take the run's folder. Raises UserError."""
        self._take_folder(self._continue() if self.last_step is not None else self.prepare())

    def prepare(self) -> Checkpoint | None:
        """Check scan, device and checkpoint; make paths absolute; set intrinsics and the length of the schedules.

        Returns the checkpoint that is resumed. Raises UserError.
        """
        root = self._scan_root()
        self._require_flags()
        _require_devices(self.machine)
        if self.machine.device_type == "cpu":
            loop.start()
        checkpoint = find_checkpoint(self.load_dir, self.load_step, self.load_checkpoint)
        begun = None if checkpoint is None else read_checkpoint(checkpoint.absolute())
        with phase("check") as check:
            require_valid(root)
            frames = len(load_scan(root).scan.frames)
            resumed = "" if begun is None else f"; goes on after step {begun.step} of {short_path(begun.path)}"
            check.say(f"{short_path(root)}: {frames} frames, no faults{resumed}")
        pipeline: SLPipelineConfig = self.pipeline  # type: ignore[assignment]
        pipeline.scan_fingerprint = load_scan(root).fingerprint
        if begun is not None:
            require_same_scan(root, pipeline.scan_fingerprint, begun.scan, str(begun.path))
        dataparser = pipeline.datamanager.dataparser  # type: ignore[attr-defined]
        model: SLModelConfig = pipeline.model  # type: ignore[assignment]
        if self.last_step is None or begun is not None:  # else config.yml holds what was found
            dataparser.intrinsics_change = _intrinsics_change(root, dataparser.intrinsics_change, begun, model)
        load_scan(root, dataparser.intrinsics_change, dataparser.length_factor)  # cached; fails if no rays meet
        self.data = root
        pipeline.datamanager.data = root
        self.output_dir = self.output_dir.expanduser().absolute()
        self.load_dir, self.load_step, self.load_checkpoint = None, None, None if begun is None else begun.path
        if self.schedule_iterations is None:
            stated = None if begun is None else begun.schedule_iterations
            self.schedule_iterations = stated or self.max_num_iterations
        model.schedule_iterations = self.schedule_iterations
        self.optimizers = {
            name: {**group, "scheduler": _with_length(group["scheduler"], self.schedule_iterations)}
            for name, group in self.optimizers.items()
        }
        pipeline.settings_fingerprint = settings_fingerprint(self)
        return begun

    def _require_flags(self) -> None:
        """Raise UserError for numbers and names that no training can have."""
        rays, seed = self.pipeline.datamanager.train_num_rays_per_batch, self.machine.seed  # type: ignore[attr-defined]
        for flag, value in (
            ("--max-num-iterations", self.max_num_iterations),
            ("--schedule-iterations", self.schedule_iterations),
            ("--pipeline.datamanager.train-num-rays-per-batch", rays),
        ):
            if value is not None and value < 1:
                raise UserError(f"{flag} {value}: at least 1 is needed")
        if not 0 <= seed < 2**32:
            raise UserError(f"--machine.seed {seed}: give a number from 0 to {2**32 - 1}")
        _require_pose_flags(self.pipeline.model, self._changed_pose_groups())  # type: ignore[arg-type]
        for flag, name in (("--timestamp", self.timestamp), ("--experiment-name", self.experiment_name)):
            if name is not None and (not name.strip() or Path(name).is_absolute() or ".." in Path(name).parts):
                raise UserError(f"{flag} {name!r}: is not the name of a folder inside --output-dir")

    def _changed_pose_groups(self) -> list[str]:
        """Optimisers of poses that are not the method's own; none in a config.yml, which was checked before."""
        if self.last_step is not None:
            return []
        usual, own = default_optimizers(self.method_name or ""), self.optimizers
        return [name for name in POSE_GROUPS if name in own and own[name]["optimizer"] != usual[name]["optimizer"]]

    def print_to_terminal(self) -> None:
        """Print all settings on request; config.yml in the run's folder holds them in any case."""
        if self.verbose:
            super().print_to_terminal()

    def save_config(self) -> None:
        """Write config.yml, complete or not at all."""
        write_atomic(self.get_base_dir() / CONFIG, yaml.dump(self).encode())

    def leave_folder(self) -> None:
        """Let other processes have the run's folder."""
        lock = _TAKEN.pop(self.get_base_dir(), None)
        if lock is not None:
            os.close(lock)

    def _continue(self) -> Checkpoint | None:
        """For the config.yml of an earlier run: go on where its last checkpoint is, up to the run's last step."""
        assert self.last_step is not None
        root = self._scan_root()
        if not (root / "transforms.json").is_file():
            self.data = Path("FOLDER")
            last = [int(path.stem.removeprefix("step-")) for path in checkpoints_in(self.get_checkpoint_dir())[-1:]]
            left = self.last_step - (last[0] if last else -1)
            raise UserError(
                f"{root}: has no transforms.json, so the scan that this run was trained on is not there\n"
                "    cause:  the scan was moved, renamed or deleted after the training, and --load-config takes all "
                f"settings from config.yml\n    remedy: with its folder: {self._further_command(left)}"
            )
        if checkpoints_in(self.get_checkpoint_dir()):
            self.load_dir, self.load_step, self.load_checkpoint = self.get_checkpoint_dir(), None, None
        begun = self.prepare()
        done = -1 if begun is None else begun.step
        if done >= self.last_step:
            raise UserError(
                f"{self.get_base_dir()}: this run is complete, at step {done}\n"
                "    cause:  --load-config continues a run up to the length that it was started with\n"
                f"    remedy: to train it further: {self._further_command()}"
            )
        self.max_num_iterations = self.last_step - done
        return begun

    def _further_command(self, iterations: int = 500) -> str:
        assert self.method_name is not None and self.data is not None and self.experiment_name is not None
        words = ["ns-train", self.method_name, "--data", self.data, "--load-dir", self.get_checkpoint_dir()]
        words += ["--output-dir", self.output_dir, "--experiment-name", self.experiment_name]
        words += ["--timestamp", self.timestamp, "--max-num-iterations", iterations]
        return shlex.join(map(str, words))

    def _take_folder(self, begun: Checkpoint | None) -> None:
        """Have the run's folder for this process alone, if nothing is there that would be overwritten."""
        folder, models, method = self.get_base_dir(), self.get_checkpoint_dir(), self.method_name
        assert method is not None
        same = begun is not None and begun.path.parent.resolve() == models.resolve()
        continued = self.last_step is not None

        def require() -> None:
            if begun is not None and same:
                _require_continuation(begun, self.pipeline, folder, method)  # type: ignore[arg-type]
            elif not continued:
                require_unused(folder, models, method)

        require()
        lock = take_folder(folder)
        try:
            require()  # again: another process may have written meanwhile
        except UserError:
            os.close(lock)
            raise
        _TAKEN[folder] = lock
        self.last_step = self.max_num_iterations + (-1 if begun is None else begun.step)

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


def _require_pose_flags(model: SLModelConfig, changed: Sequence[str]) -> None:
    """Raise UserError for settings of poses that no step moves; `changed`: groups of optimisers that were set."""
    optimizers, flags = (model.camera_optimizer, model.projector_optimizer), []
    for device, optimizer, free in zip(("camera", "projector"), optimizers, model.free_to_render, strict=True):
        if optimizer.mode is not None and not free:
            flags.append(f"--pipeline.model.{device}-optimizer.mode {optimizer.mode}")
    for group, moves in zip(POSE_GROUPS, model.moved_by_rendering, strict=True):
        if group in changed and not moves:
            flags.append(f"--optimizers.{group.replace('_', '-')}")
    if not flags:
        return
    settings = [f"pose-method {model.pose_method}", f"refine-poses {model.refine_poses}"]
    for device, optimizer in zip(("camera", "projector"), optimizers, strict=True):
        settings += [f"{device}-optimizer.mode off"] if optimizer.mode == "off" else []
    raise UserError(
        f"{', '.join(flags)}: no step of the training would move these poses\n"
        f"    cause:  {', '.join(f'--pipeline.model.{setting}' for setting in settings)}; poses are adjusted before "
        "the first step, or stay as they are, unless the rendering losses may move them\n"
        "    remedy: leave these flags out; --pipeline.model.refine-poses off keeps all poses; "
        "--pipeline.model.pose-method render-independently lets rendering move them, as in sl-neus-paper"
    )


def _intrinsics_change(
    root: Path, stated: IntrinsicsChange, begun: Checkpoint | None, model: SLModelConfig
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
    cameras = [frame.camera for frame in loaded.scan.frames]
    with phase("intrinsics") as shown:
        found = refine_intrinsics(loaded, stated, model.refine_poses, model.prior, model.adjustment)
        shown.say(refined_intrinsics_message(found, cameras, loaded.scan.projector))
    return found.change


def _with_length(scheduler: SchedulerConfig | None, steps: int) -> SchedulerConfig | None:
    if isinstance(scheduler, DecaySchedulerConfig) and scheduler.max_steps is None:
        return replace(scheduler, max_steps=steps)
    return scheduler


_FIRST = ("data", "output_dir", "experiment_name", "timestamp", "max_num_iterations", "load_dir", "load_config",
          "schedule_iterations", "verbose", "cuda_graph", "tf32", "pipeline")  # fmt: skip
_fields = SLTrainerConfig.__dataclass_fields__
# --help shows fields in their order: those that users of this method set come before the rest of nerfstudio's
SLTrainerConfig.__dataclass_fields__ = {name: _fields[name] for name in (*_FIRST, *_fields)}


def default_device() -> Literal["cpu", "cuda"]:
    """`cuda` where torch can use a GPU, else `cpu`."""
    return "cuda" if gpu_found()[0] else "cpu"


def _require_devices(machine: MachineConfig) -> None:
    """Raise UserError unless this machine has the devices that are asked for."""
    kind, count = machine.device_type, machine.num_devices
    if kind == "mps":
        raise UserError(
            "--machine.device-type mps: Apple's GPUs do not compute in float64, which the poses need. "
            "Leave the option out to train on the CPU."
        )
    available = {"cpu": 1, "cuda": torch.cuda.device_count()}[kind]
    if not available:
        raise UserError(
            f"--machine.device-type {kind}: torch {torch.__version__} finds no such device on this machine. "
            "Leave the option out to train on an available device."
        )
    _, ignored = gpu_found()
    if kind == "cpu" and ignored:
        print(paragraph("gpu", f"The GPU is not used: {ignored}."), flush=True)
    if kind == "cuda" and count == 1 and gpu_fault():
        raise UserError(
            f"--machine.device-type {kind}: the GPU cannot be used: {gpu_fault()}\n"
            "    cause:  its driver is too old, torch has no kernels for it, or other programs use its memory\n"
            "    remedy: give --machine.device-type cpu; python -m sl_nerfstudio says what was found"
        )
    if kind == "cpu" and count * machine.num_machines != 1:
        raise UserError(
            f"--machine.num-devices {count}: several processes are for several GPUs. "
            "Leave the option out: on the CPU one process uses all cores."
        )
    if not 1 <= count <= available:
        raise UserError(
            f"--machine.num-devices {count}: this machine has {available} devices of type {kind}; give 1 to that many"
        )


def _require_continuation(begun: Checkpoint, pipeline: SLPipelineConfig, folder: Path, method: str) -> None:
    """Raise UserError unless a run goes on in its own folder from its last checkpoint, with its own settings."""
    last = checkpoints_in(begun.path.parent)[-1]
    if last.name != begun.path.name:
        raise UserError(
            f"{begun.path}: {last.name} is there, too\n"
            "    cause:  a run is resumed in its own folder, but not from its last checkpoint\n"
            "    remedy: choose another --timestamp for the run that branches off"
        )
    if begun.settings != pipeline.settings_fingerprint:
        raise UserError(
            f"{folder}: holds a run with other settings, and nothing was changed\n"
            "    cause:  a run goes on in its own folder only with the settings that it was started with, except for "
            "--max-num-iterations\n"
            "    remedy: repeat the flags of that run, or choose another --timestamp; "
            f"if it was interrupted: {go_on_command(method, folder)}"
        )
