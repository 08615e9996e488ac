"""Folders of trainings: something is there already, two at once, and the viewer that is open to others."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.attacks.case import Case, Fixture
from benchmarks.attacks.commands import Done, call, start
from benchmarks.attacks.expect import accepted, refused
from benchmarks.attacks.foreign_runs import CHECKPOINT, RUN
from benchmarks.attacks.interrupted_trainings import (
    FIRST,
    STATUS,
    TRAIN,
    differs,
    heed_interrupts,
    lay_out_small,
    train,
)


def cases() -> list[Case]:
    """All of them."""
    return [*_folders(), *_two_at_once(), *_viewer()]


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
        return accepted(train(folder, *_FURTHER)) or (
            "" if [p.name for p in (folder / CHECKPOINT).parent.iterdir()] == ["step-000000021.ckpt"] else "wrong files"
        )

    def complete(folder: Path) -> str:
        return refused(
            call(folder, "ns-train", "sl-neus", "--load-config", own_config(folder)), "complete", "--load-dir"
        )

    def branch(folder: Path) -> str:
        before = content(folder / RUN)
        done = train(folder, *_replaced(_FURTHER, "--timestamp", "second"), "--pipeline.model.losses.eikonal", "0.2")
        return accepted(done) or ("" if content(folder / RUN) == before else "changed the first run")

    both: tuple[Fixture, ...] = ("run", "scan")
    other_loss = ("--pipeline.model.losses.eikonal", "0.2")
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
            from sl_nerfstudio.model.run_files import RunFolder

            target = folder / (RUN if "run" in command else FIRST)
            taken = RunFolder(target)
            try:
                return refused(call(folder, *command), "another ns-train is writing", str(os.getpid()), "--timestamp")
            finally:
                taken.leave()

        return attack

    def at_once(folder: Path) -> str:
        lay_out_small(folder)
        processes = [start(folder, *TRAIN) for _ in range(3)]
        texts = [process.communicate()[1] for process in processes]
        if [process.returncode for process in processes].count(0) != 1:
            return f"exit statuses {[process.returncode for process in processes]}"
        known = ("another ns-train is writing", "holds another run")
        wrong = [t for p, t in zip(processes, texts, strict=True) if p.returncode and not any(k in t for k in known)]
        return f"said {wrong[0][-150:]!r}" if wrong else differs(folder)

    group = "Two trainings at once"
    return [
        Case(group, "a new run in a folder that another process has", ("scan",), held(*TRAIN)),
        Case(group, "further in a folder that another process has", ("run", "scan"), held(*_FURTHER)),
        Case(group, "three started at the same time", (), at_once),
    ]


def _viewer() -> list[Case]:
    def stopped(folder: Path, number: signal.Signals) -> str:
        heed_interrupts()
        port = str(20000 + os.getpid() % 20000)
        flags = ("--load-config", own_config(folder), "--viewer.websocket-host", "127.0.0.1")
        process = start(folder, "ns-viewer", *flags, "--viewer.websocket-port", port)
        end = time.monotonic() + 300
        while not _listening(int(port)) and process.poll() is None and time.monotonic() < end:
            time.sleep(0.1)
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
