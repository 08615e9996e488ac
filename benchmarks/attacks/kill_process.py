"""sl-process killed, terminated and interrupted: the next run goes on, with the same bytes; no worker lives on."""

import hashlib
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import sl_nerfstudio
from benchmarks.attacks.case import Case
from benchmarks.attacks.commands import call, start
from benchmarks.attacks.dying import dying
from benchmarks.attacks.expect import accepted, refused
from benchmarks.attacks.kills import contents
from benchmarks.attacks.output_folders import PROCESS
from sl_nerfstudio.storage import LOCK, locked

GROUP = "Killed sl-process"
_COMMAND = (*PROCESS, "new", "--work", "work")
_SECONDS = 600.0
_CHANGES = 90  # of the disk, from the registration to the end
_ALIVE_SECONDS = 10.0
_STATUS = {signal.SIGINT: (130, "interrupted\n"), signal.SIGTERM: (143, "terminated\n")}


def cases() -> list[Case]:
    """At seeded moments of every stage, and with several workers."""
    rng = random.Random(GROUP)
    found = [_case("one process and four give the same bytes", _jobs)]
    for stage, count, changes in (("decoding", 3, 40), ("registration", 6, 30), ("writing", 8, _CHANGES)):
        for moment in sorted(rng.sample(range(3, changes), count)):
            found.append(_case(f"{stage}: SIGKILL at change {moment} of the disk", _killed(stage, moment)))
    for number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT):
        for k in range(3):
            found.append(_case(f"{number.name} with two workers, moment {k + 1}", _with_workers(number, rng.random())))
    for k in range(8):
        found.append(_case(f"a byte of every kept file flipped, {k + 1}", _flipped(k)))
    return found


def _case(title: str, attack: Callable[[Path], str]) -> Case:
    return Case(GROUP, title, ("captures",), attack)


def _code() -> str:
    """Digest of the sources of the package: a run by other code is no reference."""
    sources = sorted(Path(sl_nerfstudio.__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]


def prepared(folder: Path) -> Path:
    """Scan and work folder of a run that nothing stopped, made once by the same code beside the fixtures."""
    root = folder.parents[1] / "fixtures" / f"processed-{_code()}"
    while not (root / "complete").exists():
        try:
            with locked(root):
                if not (root / "complete").exists():
                    _prepare(folder, root)
        except Exception as error:
            if "is in use" not in str(error):
                raise
            time.sleep(1)
    return root


def _prepare(folder: Path, root: Path) -> None:
    for name in ("scan", "work"):
        shutil.rmtree(root / name, ignore_errors=True)
    fault = accepted(call(folder, *_COMMAND, seconds=_SECONDS))
    if fault:
        raise RuntimeError(f"the uninterrupted run failed: {fault}")
    shutil.move(folder / "new", root / "scan")
    shutil.move(folder / "work", root / "work")
    (root / "complete").touch()


def _resumed(folder: Path, *words: str) -> str:
    """The fault if the next run does not end with the scan of an uninterrupted one, or leaves something hidden."""
    fault = accepted(call(folder, *_COMMAND, seconds=_SECONDS), *words)
    if fault:
        return fault
    if contents(folder / "new") != contents(prepared(folder) / "scan"):
        return "the scan differs from that of an uninterrupted run"
    hidden = [path for name in ("new", "work") for path in (folder / name).rglob(".*")]
    return f"left {hidden[0].name}" if hidden else ""


def _killed(stage: str, moment: int) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        work = prepared(folder) / "work"
        if stage != "decoding":
            shutil.copytree(work, folder / "work")
        if stage == "registration":
            for path in (folder / "work" / "stages").iterdir():
                if not path.name.startswith("calibration"):
                    path.unlink()
        with dying(moment):
            done = call(folder, *_COMMAND, seconds=_SECONDS)
        if done.status == 0:
            return "" if contents(folder / "new") == contents(prepared(folder) / "scan") else "another scan"
        if done.status != -signal.SIGKILL:
            return f"the killed command ended with status {done.status}"
        return _resumed(folder)

    return attack


def _flipped(seed: int) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        shutil.copytree(prepared(folder) / "work", folder / "work")
        rng = random.Random(seed)
        for path in sorted((folder / "work").rglob("*")):
            if path.is_file() and not path.name.startswith("frame"):  # decoding all frames again takes long
                text = bytearray(path.read_bytes())
                text[rng.randrange(len(text))] ^= 1 << rng.randrange(8)
                path.write_bytes(text)
        return _resumed(folder)

    return attack


def _jobs(folder: Path) -> str:
    one = prepared(folder) / "scan"
    done = call(folder, *("4" if word == "1" else word for word in _COMMAND), seconds=_SECONDS)
    same = contents(folder / "new") == contents(one)
    return accepted(done) or ("" if same else "another scan than with --jobs 1")


def _with_workers(number: signal.Signals, moment: float) -> Callable[[Path], str]:
    def attack(folder: Path) -> str:
        prepared(folder)
        command = ["2" if word == "1" else word for word in _COMMAND]
        process = start(folder, *command)
        assert process.stdout is not None
        process.stdout.readline()  # the workers are started after the first line
        _wait_for_workers(process, 2)
        time.sleep(8 * moment)
        second = refused(call(folder, *_COMMAND), "is in use by", "sl-process", str(process.pid))
        if number == signal.SIGINT:
            os.killpg(process.pid, number)  # as the terminal does
        else:
            process.send_signal(number)
        said = _end(process)
        if second:
            return f"a second run beside it: {second}"
        if number in _STATUS and (process.returncode, said) != _STATUS[number]:
            return f"status {process.returncode}, said {said[:150]!r}"
        if _alive(process.pid):
            return f"{len(_alive(process.pid))} processes live on after {_ALIVE_SECONDS:.0f} s"
        if number != signal.SIGKILL and ((folder / "new").exists() or (folder / "work" / LOCK).exists()):
            return "left a half-made scan or a lock"
        return _resumed(folder)

    return attack


def _end(process: "subprocess.Popen[str]") -> str:
    """What it printed to stderr; waits until it and its workers have ended, at most some seconds."""
    try:
        said = process.communicate(timeout=_SECONDS)[1]
    except subprocess.TimeoutExpired:
        return "(did not end)"
    end = time.monotonic() + _ALIVE_SECONDS
    while _alive(process.pid) and time.monotonic() < end:
        time.sleep(0.1)
    return said


def _wait_for_workers(process: "subprocess.Popen[str]", count: int) -> None:
    end = time.monotonic() + 60
    while len(_alive(process.pid)) < count + 1 and process.poll() is None and time.monotonic() < end:
        time.sleep(0.1)


def _alive(session: int) -> list[int]:
    """Processes of a session, without those that have ended."""
    found = []
    for path in Path("/proc").iterdir():
        if path.name.isdecimal():
            try:
                state, _, _, number = (path / "stat").read_text().rsplit(")", 1)[1].split()[:4]
            except (OSError, ValueError):
                continue
            if int(number) == session and state != "Z":
                found.append(int(path.name))
    return found
