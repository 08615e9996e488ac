"""Trainings that are stopped at any moment, and trainings that are repeated."""

import functools
import os
import shlex
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.attacks.case import Case
from benchmarks.attacks.commands import Done, call
from benchmarks.attacks.expect import accepted, refused

STEPS = 12
SMALL = (
    *("--max-num-iterations", str(STEPS), "--steps-per-save", "4", "--steps-per-eval-batch", "3"),
    *("--pipeline.datamanager.train-num-rays-per-batch", "64", "--pipeline.model.sdf.max-resolution", "16"),
)
TRAIN = ("ns-train", "sl-neus", "--data", "scan", "--output-dir", "out", "--timestamp", "first", *SMALL)
FIRST = Path("out/scan/sl-neus/first")
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -signal.SIGKILL}

# Where a signal arrives: just before this function's call of this number, from 0.
_MOMENTS: dict[str, tuple[str, str, int]] = {
    "the checks": ("sl_nerfstudio.model.trainer", "require_valid", 0),
    "reading the scan": ("sl_nerfstudio.model.trainer", "load_scan", 1),
    "taking the folder": ("sl_nerfstudio.model.trainer", "RunFolder", 0),
    "writing config.yml": ("sl_nerfstudio.model.trainer", "write_atomic", 0),
    "making the model": ("sl_nerfstudio.model.model", "PoseParameters", 0),
    "the adjustment": ("sl_nerfstudio.model.model", "adjust_scan", 0),
    "storing the adjusted poses": ("sl_nerfstudio.model.model", "measure_decoding", 0),
    "the first checkpoint": ("torch", "save", 0),
    "step 0": ("sl_nerfstudio.model.model", "level_weights_at", 0),
    "step 2": ("sl_nerfstudio.model.model", "random_points", 2),
    "an evaluation": ("sl_nerfstudio.model.model", "ray_outputs", 0),
    "a later evaluation": ("sl_nerfstudio.model.model", "ray_outputs", 2),
    "a checkpoint": ("torch", "save", 1),
    "replacing a checkpoint": ("sl_nerfstudio.model.loop", "checkpoints_in", 1),
    "step 7": ("sl_nerfstudio.model.model", "random_points", 7),
    "the last step": ("sl_nerfstudio.model.model", "random_points", STEPS - 1),
    "the last checkpoint": ("torch", "save", 3),
    "the last words": ("sl_nerfstudio.model.pipeline", "what_next", 0),
}  # fmt: skip


def cases() -> list[Case]:
    """All of them."""
    stopped = [
        Case("Interrupted training", f"{number.name} at {moment}", (), _stopped(moment, number))
        for place, moment in enumerate(_MOMENTS)
        for number in (signal.SIGKILL, signal.SIGTERM if place % 2 else signal.SIGINT)
    ]
    return [*stopped, *_same_seed()]


@contextmanager
def sending(moment: str, number: int) -> Iterator[None]:
    """Processes forked in the block send themselves the signal at that moment."""
    module_name, name, wanted = _MOMENTS[moment]
    module, parent, calls = import_module(module_name), os.getpid(), iter(range(10**9))
    before = getattr(module, name)
    heed_interrupts()

    @functools.wraps(before)
    def watched(*arguments: Any, **named: Any) -> Any:
        if os.getpid() != parent and next(calls) == wanted:
            os.kill(os.getpid(), number)
        return before(*arguments, **named)

    setattr(module, name, watched)
    try:
        yield
    finally:
        setattr(module, name, before)


def heed_interrupts() -> None:
    """Commands started from now on heed SIGINT, even if a script started this benchmark in the background."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _stopped(moment: str, number: signal.Signals) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        lay_out_small(folder)
        with sending(moment, number):
            done = train(folder, *TRAIN)
        if done.status != STATUS[number]:
            return f"exit status {done.status} after {number.name}: {done.stderr.strip()[-150:]}"
        if "Traceback" in done.text:
            return "printed a traceback"
        begun = (folder / FIRST / "config.yml").exists()
        line = next((line for line in done.stderr.splitlines() if line.startswith("to go on: ")), "")
        if number != signal.SIGKILL and begun and not line and moment != "writing config.yml":
            return "does not say how to go on"
        if begun:
            again = refused(train(folder, *TRAIN), "holds another run", "--load-config")
            again = again or (_readable(folder) if number == signal.SIGKILL else "")
            if again:
                return again
            line = line or f"to go on: ns-train sl-neus --load-config {FIRST / 'config.yml'}"
        done = train(folder, *(shlex.split(line.removeprefix("to go on: ")) if begun else TRAIN))
        complete = "this run is complete" in done.stderr
        return ("" if complete else accepted(done)) or differs(folder)

    return attack


def _readable(folder: Path) -> str:
    """The fault if the commands that read a run do anything but refuse or succeed."""
    for command in (("sl-check", str(FIRST)), ("sl-export", "--load-config", str(FIRST), "--output", "early.ply",
                                               "--resolution", "16", "--keep-unobserved")):  # fmt: skip
        done = call(folder, *command)
        fault = refused(done) if done.status else accepted(done)
        if fault:
            return f"{command[0]} of the interrupted run: {fault}"
    return ""


def differs(folder: Path, run: Path = FIRST) -> str:
    """The fault if the run is not, bit for bit, the one that nobody interrupted."""
    found, wanted = last_weights(folder / run), _reference(folder.parent.parent)
    if isinstance(wanted, str):
        return wanted
    if found is None:
        return "has no checkpoint"
    left = [path.name for path in (folder / run).iterdir() if path.name.endswith(".partial")]
    return f"left {left[0]}" if left else "" if _equal(found, wanted) else "differs from an uninterrupted training"


def train(folder: Path, *command: str) -> Done:
    """Run the command; a training takes some seconds, on a busy machine some minutes."""
    return call(folder, *command, seconds=400)


def lay_out_small(folder: Path) -> None:
    """A scan that is smaller than the fixture: it is trained on in every case."""
    _reference(folder.parent.parent)
    shutil.copytree(_own_folder(folder.parent.parent) / "scan", folder / "scan")


def _own_folder(root: Path) -> Path:
    return root / f"reference-{os.getpid()}"


@functools.cache
def _reference(root: Path) -> Any:
    """State of an uninterrupted training, once in each worker; a fault if it failed."""
    folder = _own_folder(root)
    folder.mkdir(parents=True)
    small = ("--frames", "4", "--resolution", "80", "--seed", "3")
    fault = accepted(train(folder, "sl-synth", "--output", "scan", *small)) or accepted(train(folder, *TRAIN))
    return fault or last_weights(folder / FIRST)


def last_weights(run: Path) -> Any:
    """The state in the last checkpoint of a run; None if it has none."""
    import torch

    found = sorted((run / "nerfstudio_models").glob("step-*.ckpt"))
    return torch.load(found[-1]) if found else None


def _equal(one: Any, other: Any) -> bool:
    import torch

    if isinstance(one, torch.Tensor):
        return bool(torch.equal(one.nan_to_num(), other.nan_to_num()))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_equal(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(_equal, one, other))
    return one == other


def _same_seed() -> list[Case]:
    def equal(folder: Path, busy: int) -> str:
        lay_out_small(folder)
        stop = [_busy() for _ in range(busy)]
        try:
            return accepted(train(folder, *TRAIN)) or differs(folder)
        finally:
            for pid in stop:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)

    return [
        Case("Same seed, same training", f"beside {busy} busy processes", (),
             lambda folder, busy=busy: equal(folder, busy))
        for busy in (0, 1, 4)
    ]  # fmt: skip


def _busy() -> int:
    pid = os.fork()
    while not pid:
        sum(range(1000))
    return pid
