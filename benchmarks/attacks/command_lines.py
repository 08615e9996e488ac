"""Flags that no command should take as they are: unknown ones, missing ones, values out of range."""

from pathlib import Path

from benchmarks.attacks.case import Case
from benchmarks.attacks.commands import Done, call

_COMMANDS = ("sl-check", "sl-eval", "sl-export", "sl-pattern", "sl-process", "sl-synth")
_WRONG_VALUES = (
    ("sl-synth", "--frames", ("0", "1", "-3", "two", "1e400", "nan")),
    ("sl-synth", "--resolution", ("0", "-1", "15", "big")),
    ("sl-synth", "--scene", ("", "dragon", "missing.ply", "/proc/self/mem", "..")),
    ("sl-synth", "--missing", ("-0.1", "1", "15", "nan", "inf")),
    ("sl-synth", "--noise", ("-1", "nan", "inf")),
    ("sl-synth", "--units", ("", "inch", "MM")),
    ("sl-export", "--resolution", ("-1", "0", "1", "many")),
    ("sl-process", "--jobs", ("-1", "many", "1.5")),
)


def cases() -> list[Case]:
    """Every command with each fault."""
    found = [_case(f"{name} without arguments", name) for name in _COMMANDS if name != "sl-pattern"]
    found += [_case(f"{name} with an unknown flag", name, "--no-such-flag", "1") for name in _COMMANDS]
    for name, flag, values in _WRONG_VALUES:
        found += [_case(f"{name} {flag} {value!r}", name, *_rest(name, flag), flag, value) for value in values]
    return found


def _rest(name: str, flag: str) -> list[str]:
    """The other flags that the command needs."""
    needed = {
        "sl-synth": ["--output", "new", "--frames", "2", "--resolution", "16"],
        "sl-export": ["--load-config", "missing/config.yml", "--output", "mesh.ply"],
        "sl-process": ["--images", "captures/images", "--pattern", "captures/pattern.json",
                       "--intrinsics", "captures/intrinsics.json", "--output", "new"],
    }[name]  # fmt: skip
    place = needed.index(flag) if flag in needed else None
    return needed if place is None else needed[:place] + needed[place + 2 :]


def _case(title: str, name: str, *arguments: str) -> Case:
    def attack(folder: Path) -> str:
        before = {path.name for path in folder.iterdir()}
        done = call(folder, name, *arguments)
        left = {path.name for path in folder.iterdir() if not path.name.startswith(".std")} - before
        return _refused_command_line(done) or (f"left {sorted(left)[0]} behind" if left else "")

    return Case("Command lines", title, ("captures",) if name == "sl-process" else (), attack)


def _refused_command_line(done: Done) -> str:
    """The parser of flags ends with status 2, the commands with 1."""
    if "Traceback (most recent call last)" in done.text:
        return f"traceback: {done.text.strip().splitlines()[-1][:150]}"
    if done.status not in (1, 2):
        return f"status {done.status}"
    return "" if done.text.strip() else "no message"
