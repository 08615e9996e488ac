"""Trainings that are stopped at any moment, two at once, and folders in which something is already."""

import functools
import os
import shlex
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.attacks.case import Case
from benchmarks.attacks.commands import Done, call, start
from benchmarks.attacks.expect import accepted, refused
from benchmarks.attacks.foreign_runs import CHECKPOINT, RUN

STEPS = 12
SMALL = (
    *("--max-num-iterations", str(STEPS), "--steps-per-save", "4", "--steps-per-eval-batch", "3"),
    *("--pipeline.datamanager.train-num-rays-per-batch", "64", "--pipeline.model.sdf.log2-table-size", "10"),
    *("--pipeline.model.sdf.max-resolution", "64", "--pipeline.model.sdf.hidden", "16"),
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
    "making the model": ("sl_nerfstudio.model.model", "make_pose_parameters", 0),
    "the adjustment": ("sl_nerfstudio.model.model", "adjust_scan", 0),
    "storing the adjusted poses": ("sl_nerfstudio.model.model", "measure_decoding", 0),
    "the first checkpoint": ("torch", "save", 0),
    "step 0": ("sl_nerfstudio.model.model", "level_weights_at", 0),
    "step 2": ("sl_nerfstudio.model.model", "random_points", 2),
    "an evaluation": ("sl_nerfstudio.model.model", "ray_outputs", 0),
    "a later evaluation": ("sl_nerfstudio.model.model", "ray_outputs", 2),
    "a checkpoint": ("torch", "save", 1),
    "replacing a checkpoint": ("sl_nerfstudio.model.training.loop", "checkpoints_in", 1),
    "step 7": ("sl_nerfstudio.model.model", "random_points", 7),
    "the last step": ("sl_nerfstudio.model.model", "random_points", STEPS - 1),
    "the last checkpoint": ("torch", "save", 3),
    "the last words": ("sl_nerfstudio.model.pipeline", "what_next", 0),
}  # fmt: skip


def cases() -> list[Case]:
    """All of them."""
    stopped = [
        Case("Interrupted training", f"{number.name} at {moment}", ("scan",), _stopped(moment, number))
        for moment in _MOMENTS
        for number in STATUS
    ]
    return [*stopped, *_folders(), *_two_at_once(), *_same_seed(), *_viewer()]


@contextmanager
def sending(moment: str, number: int) -> Iterator[None]:
    """Processes forked in the block send themselves the signal at that moment."""
    module_name, name, wanted = _MOMENTS[moment]
    module, parent, calls = import_module(module_name), os.getpid(), iter(range(10**9))
    before = getattr(module, name)

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


def _stopped(moment: str, number: signal.Signals) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        with sending(moment, number):
            done = call(folder, *TRAIN)
        if done.status != STATUS[number]:
            return f"exit status {done.status} after {number.name}: {done.stderr.strip()[-150:]}"
        if "Traceback" in done.text:
            return "printed a traceback"
        begun = (folder / FIRST / "config.yml").exists()
        line = next((line for line in done.stderr.splitlines() if line.startswith("to go on: ")), "")
        if number != signal.SIGKILL and begun and not line and moment != "writing config.yml":
            return "does not say how to go on"
        if begun:
            again = refused(call(folder, *TRAIN), "holds another run", "--load-config") or _readable(folder)
            if again:
                return again
            line = line or f"to go on: ns-train sl-neus --load-config {FIRST / 'config.yml'}"
        done = call(folder, *(shlex.split(line.removeprefix("to go on: ")) if begun else TRAIN))
        complete = "this run is complete" in done.stderr
        return ("" if complete else accepted(done)) or _differs(folder)

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


def _differs(folder: Path, run: Path = FIRST) -> str:
    """The fault if the run is not, bit for bit, the one that nobody interrupted."""
    found, wanted = last_weights(folder / run), _reference(folder.parent.parent / "fixtures/scan")
    if isinstance(wanted, str):
        return wanted
    if found is None:
        return "has no checkpoint"
    left = [path.name for path in (folder / run).iterdir() if path.name.endswith(".partial")]
    return f"left {left[0]}" if left else "" if _equal(found, wanted) else "differs from an uninterrupted training"


@functools.cache
def _reference(scan: Path) -> Any:
    """State of an uninterrupted training, once in each worker; a fault if it failed."""
    folder = scan.parent.parent / f"reference-{os.getpid()}"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(scan, folder / "scan")
    fault = accepted(call(folder, *TRAIN))
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


def content(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def own_config(folder: Path) -> str:
    """The fixture's config.yml with the paths of the case's own copy."""
    import yaml

    path = folder / RUN / "config.yml"
    config = yaml.load(path.read_text(), Loader=yaml.Loader)
    config.output_dir = folder / "run"
    config.data = config.pipeline.datamanager.data = folder / "scan"
    path.write_text(yaml.dump(config))
    return str(path)


_INTO_RUN = ("ns-train", "sl-neus", "--data", "scan", "--output-dir", "run", "--timestamp", "first")
_FURTHER = (*_INTO_RUN, "--load-dir", str(CHECKPOINT.parent), "--max-num-iterations", "2")


def _folders() -> list[Case]:
    group = "Folders of trainings"

    def kept(*command: str, words: tuple[str, ...]) -> Callable[[Path], str]:
        """Refused, and no file is changed or new."""

        def attack(folder: Path) -> str:
            before = content(folder)
            done = call(folder, *command)
            after = {name: data for name, data in content(folder).items() if not name.startswith(".std")}
            before = {name: data for name, data in before.items() if not name.startswith(".std")}
            return refused(done, *words) or ("" if after == before else "changed files although it refused")

        return attack

    def begun(name: str) -> Callable[[Path], str]:
        def attack(folder: Path) -> str:
            (folder / FIRST).mkdir(parents=True)
            (folder / FIRST / name).write_text("mine")
            return kept(*TRAIN, words=("--timestamp",))(folder)

        return attack

    def further(folder: Path) -> str:
        return accepted(call(folder, *_FURTHER)) or (
            "" if [p.name for p in (folder / CHECKPOINT).parent.iterdir()] == ["step-000000021.ckpt"] else "wrong files"
        )

    def complete(folder: Path) -> str:
        return refused(
            call(folder, "ns-train", "sl-neus", "--load-config", own_config(folder)), "complete", "--load-dir"
        )

    def branch(folder: Path) -> str:
        before = content(folder / RUN)
        done = call(folder, *_replaced(_FURTHER, "--timestamp", "second"), "--pipeline.model.losses.eikonal", "0.2")
        return accepted(done) or ("" if content(folder / RUN) == before else "changed the first run")

    both, other_loss = ("run", "scan"), ("--pipeline.model.losses.eikonal", "0.2")
    into = kept(*_INTO_RUN, words=("holds another run", "--load-dir", "--timestamp"))
    another = kept(*_FURTHER, *other_loss, words=("other settings", "--timestamp"))
    seed = kept(*_FURTHER, "--machine.seed", "7", words=("other settings",))
    found = [
        Case(group, "into a finished run", both, into),
        Case(group, "further with other settings", both, another),
        Case(group, "further with another seed", both, seed),
        Case(group, "further in the same folder", both, further),
        Case(group, "further in another folder, with other settings", both, branch),
        Case(group, "--load-config of a complete run", both, complete),
        Case(group, "into a folder with config.yml only", ("scan",), begun("config.yml")),
        Case(group, "into a folder with something else", ("scan",), begun("notes.txt")),
    ]
    for flag, value in (
        *(("--output-dir", place) for place in ("/proc/x", "/dev/null/x", "scan/transforms.json", "/sys/x")),
        *(("--load-dir", place) for place in ("missing", "scan", "scan/transforms.json", "/proc", "")),
        *(("--load-checkpoint", place) for place in ("missing.ckpt", "scan", "scan/transforms.json", "/dev/zero")),
        *(("--max-num-iterations", number) for number in ("0", "-1")),
        *(("--schedule-iterations", number) for number in ("0", "-5")),
        *(("--machine.seed", number) for number in ("-1", str(2**32))),
        *(("--pipeline.datamanager.train-num-rays-per-batch", number) for number in ("0", "-1")),
        *(("--timestamp", name) for name in ("../../../../escaped", "/tmp/escaped", "")),
        *(("--experiment-name", name) for name in ("../../escaped", "")),
    ):
        title = f"{flag} {value!r}"
        found.append(Case(group, title, ("scan",), kept(*_replaced(TRAIN, flag, value), words=())))
    return found


def _replaced(command: tuple[str, ...], flag: str, value: str) -> tuple[str, ...]:
    if flag not in command:
        return (*command, flag, value)
    place = command.index(flag)
    return (*command[: place + 1], value, *command[place + 2 :])


def _two_at_once() -> list[Case]:
    def held(*command: str) -> Callable[[Path], str]:
        def attack(folder: Path) -> str:
            from sl_nerfstudio.model.training.run_folder import RunFolder

            target = folder / (RUN if "run" in command else FIRST)
            taken = RunFolder(target)
            try:
                return refused(call(folder, *command), "another ns-train is writing", str(os.getpid()), "--timestamp")
            finally:
                taken.leave()

        return attack

    def at_once(folder: Path) -> str:
        processes = [start(folder, *TRAIN) for _ in range(3)]
        texts = [process.communicate()[1] for process in processes]
        if [process.returncode for process in processes].count(0) != 1:
            return f"exit statuses {[process.returncode for process in processes]}"
        known = ("another ns-train is writing", "holds another run")
        wrong = [t for p, t in zip(processes, texts, strict=True) if p.returncode and not any(k in t for k in known)]
        return f"said {wrong[0][-150:]!r}" if wrong else _differs(folder)

    group = "Two trainings at once"
    return [
        Case(group, "a new run in a folder that another process has", ("scan",), held(*TRAIN)),
        Case(group, "further in a folder that another process has", ("run", "scan"), held(*_FURTHER)),
        Case(group, "three started at the same time", ("scan",), at_once),
    ]


def _same_seed() -> list[Case]:
    def equal(folder: Path, busy: int) -> str:
        stop = [_busy() for _ in range(busy)]
        try:
            return accepted(call(folder, *TRAIN, seconds=300)) or _differs(folder)
        finally:
            for pid in stop:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)

    return [
        Case("Same seed, same training", f"beside {busy} busy processes", ("scan",),
             lambda folder, busy=busy: equal(folder, busy))
        for busy in (0, 1, 4)
    ]  # fmt: skip


def _busy() -> int:
    pid = os.fork()
    while not pid:
        sum(range(1000))
    return pid


def _viewer() -> list[Case]:
    def stopped(folder: Path, number: signal.Signals) -> str:
        port = str(20000 + os.getpid() % 20000)
        flags = ("--load-config", own_config(folder), "--viewer.websocket-host", "127.0.0.1")
        process = start(folder, "ns-viewer", *flags, "--viewer.websocket-port", port)
        end = time.monotonic() + 90
        while not _listening(int(port)) and process.poll() is None and time.monotonic() < end:
            time.sleep(0.1)
        time.sleep(1)
        address = _listening(int(port))
        process.send_signal(number)
        try:
            out, err = process.communicate(timeout=20)
        except Exception:
            process.kill()
            return "did not end"
        done = Done(process.returncode, out, err)
        if done.status != STATUS[number] or "Traceback" in done.text:
            return f"exit status {done.status}: {done.text.strip()[-150:]}"
        return "" if address == "0100007F" else f"listened on {address}"

    return [
        Case(
            "Viewer",
            f"ns-viewer, {number.name}",
            ("run", "scan"),
            lambda folder, number=number: stopped(folder, number),
        )
        for number in (signal.SIGINT, signal.SIGTERM)
    ]


def _listening(port: int) -> str:
    """The address, as the kernel writes it, on which somebody listens at a port; "" if nobody does."""
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        local, _, state = line.split()[1:4]
        if state == "0A" and int(local.split(":")[1], 16) == port:
            return local.split(":")[0]
    return ""
