"""SIGINT and SIGTERM: a command ends without a traceback, and with the status that shells expect."""

import hashlib
import json
import math
import os
import re
import shlex
import signal
import sys
import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from jaxtyping import UInt8
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.geometry.devices import IntrinsicsChange
from sl_nerfstudio.storage import open_alone, write_all

# What nerfstudio prints by itself, left out: settings are in config.yml, and phases say what happens.


def quiet_nerfstudio(quiet: bool) -> None:
    """Whether this process prints nothing through nerfstudio's console from now on; errors do not go through it."""
    CONSOLE.quiet = quiet


# With which settings a run was made: a hash that its config.yml and its checkpoints carry.

_WITHOUT_EFFECT = {"eval_num_rays_per_chunk", "prompt"}  # settings of the model that do not change its result
POSE_OPTIMIZERS = ("camera_optimizer", "projector_optimizer")
"""Settings of the model that earlier runs lack: left out, they say what those runs did."""


def settings_fingerprint(config: Any) -> str:
    """SHA-256 (hexadecimal) of the settings that determine the result of a run; `config` is an SLTrainerConfig."""
    return hashlib.sha256(json.dumps(decisive_settings(config), sort_keys=True).encode()).hexdigest()


def decisive_settings(config: Any) -> dict[str, Any]:
    """The settings that determine the result of a run, as JSON values: not where it is written, nor on which device.

    The number of steps is left out, too: training can go on.
    """
    model = {name: value for name, value in plain(config.pipeline.model).items() if name not in _WITHOUT_EFFECT}
    for name in POSE_OPTIMIZERS:
        if model[name] == {"mode": None}:
            del model[name]
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


# Checkpoints: found by name, read without running code from them, checked, and replaced as a whole.

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


# The folder of a run: one process at a time writes to it, and nothing that is there is overwritten.

LOCK, PARTIAL = ".lock", ".checkpoint.partial"
CONFIG = "config.yml"


def take_folder(path: Path) -> int:
    """Make the folder, and have it for this process until it closes the file returned, or ends, however it ends.

    Raises UserError if another process has it, or if it cannot be written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        lock, locked = open_alone(path / LOCK)
        os.ftruncate(lock, 0)
        write_all(lock, str(os.getpid()).encode())
    except BlockingIOError as error:
        raise UserError(
            f"{path}: another ns-train is writing there (process {_number_in(path / LOCK)})\n"
            "    cause:  two trainings were started with the same --output-dir, --experiment-name and --timestamp\n"
            "    remedy: wait until it has ended, or choose another --timestamp"
        ) from error
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror})\n"
            "    cause:  missing permissions, a read-only disk, or a file where a folder is needed\n"
            "    remedy: choose another place with --output-dir"
        ) from error
    if not locked:
        print(f"note: {path} is on a disk that knows no locks; start no second run there", file=sys.stderr)
    with suppress(OSError):
        (path / PARTIAL).unlink()  # left by a process that was killed while it wrote
    return lock


def _number_in(lock: Path) -> str:
    with suppress(OSError):
        return lock.read_bytes()[:20].decode("ascii", "replace") or "unknown"
    return "unknown"


def require_unused(folder: Path, models: Path, method: str) -> None:
    """Raise UserError if another run was begun in `folder`; `models` is where its checkpoints are."""
    try:
        found = sorted(path.name for path in folder.iterdir() if path.name not in (LOCK, PARTIAL))
    except FileNotFoundError:
        return
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be read ({error.strerror})\n    remedy: choose another --timestamp"
        ) from error
    if not found:
        return
    if CONFIG not in found:
        raise UserError(
            f"{folder}: is not empty (it holds {found[0]})\n    cause:  the folder is used for something else\n"
            "    remedy: choose another --timestamp, --experiment-name or --output-dir"
        )
    saved = checkpoints_in(models)
    state = f"its last checkpoint is {saved[-1].name}" if saved else "it has no checkpoint yet"
    remedies = [f"to finish that run if it was interrupted: {go_on_command(method, folder)}"]
    if saved:
        remedies.append(f"to train it further: add --load-dir {shlex.quote(str(models))}")
    raise UserError(
        f"{folder}: holds another run ({state}), and nothing was changed\n"
        "    cause:  --output-dir, --experiment-name and --timestamp name the folder of an earlier run\n"
        "    remedy: choose another name with --timestamp; " + "\n            ".join(["or", *remedies])
    )


Watch = Callable[[Any], None]
_part_of: list[tuple[str, Watch | None]] = []


@contextmanager
def part_of(command: str, watch: Watch | None = None) -> Iterator[None]:
    """Trainings in the block are a part of `command`, which goes on with them, and itself says what is next.

    `watch` gets their model after each step.
    """
    _part_of.append((command, watch))
    try:
        yield
    finally:
        _part_of.pop()


def whole_command() -> str:
    """The command of which trainings of this process are a part; "" if of none."""
    return _part_of[-1][0] if _part_of else ""


def watch_step(model: Any) -> None:
    """Show the model to who watches this training, if anybody does."""
    if _part_of and (watch := _part_of[-1][1]):
        watch(model)


def go_on_command(method: str, folder: Path) -> str:
    """The command that continues a run up to the length that it was started with."""
    return whole_command() or f"ns-train {method} --load-config {shlex.quote(str(folder / CONFIG))}"


_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(SystemExit):
    """The process was asked to stop; the status is 128 + the signal's number (130 or 143)."""


class Interruption:
    """Turns the first signal into `Interrupted`, and ends the process at once on the second.

    Between `hold` and `release` the first signal waits, because half a training step cannot be continued.
    """

    def __init__(self) -> None:
        self._previous: dict[int, object] = {}
        self._received: int | None = None
        self._raised = False
        self._held = False
        self._patient = False

    def install(self, patient: bool = False) -> None:
        """Handle the signals from now on. A signal that the process was started to ignore remains ignored.

        A `patient` process also survives the second signal: it may come from the process that started it.
        """
        if self._previous or threading.current_thread() is not threading.main_thread():
            return
        self._received, self._raised, self._held, self._patient = None, False, False, patient
        for number in _SIGNALS:
            before = signal.getsignal(number)
            if before is not signal.SIG_IGN:
                self._previous[number] = before
                signal.signal(number, self._handle)

    def remove(self) -> None:
        """Restore what handled the signals before."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._previous.clear()
        self._held = False

    def hold(self) -> None:
        """Let a signal wait for `release`."""
        self._held = True

    def release(self) -> None:
        """Raise `Interrupted` if a signal has been waiting."""
        self._held = False
        self._raise_received()

    @property
    def received(self) -> int:
        """Number of the first signal; 0 if there was none."""
        return self._received or 0

    def receive(self, number: int) -> None:
        """Count a signal that another process of this training received."""
        self._received = number or self._received

    @contextmanager
    def held(self) -> Iterator[None]:
        """Let a signal wait for the end of the block, or of the block around it."""
        before, self._held = self._held, True
        try:
            yield
        finally:
            self._held = before
        if not before:
            self._raise_received()

    def _raise_received(self) -> None:
        if self._received is not None and not self._raised:
            self._raised = True
            raise Interrupted(128 + self._received)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._received is not None:
            if self._patient:
                return
            os._exit(128 + number)
        self._received = number
        said = b"terminated\n" if number == signal.SIGTERM else b"interrupted\n"
        os.write(2, said)  # print is not allowed here
        if not self._held:
            self._raise_received()


INTERRUPTION = Interruption()
"""Of this process: signal handlers belong to the whole process, too."""
