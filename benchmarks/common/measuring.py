"""What every benchmark does: read its flags, name the machine, print and write rows, and measure time and memory."""

import argparse
import json
import os
import platform
import resource
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import date
from pathlib import Path
from typing import Any, Generic, TypeVar, get_args, get_type_hints

T = TypeVar("T")
_RESET_PEAK = "5"  # proc(5), /proc/pid/clear_refs


def options(description: str | None, **defaults: Any) -> argparse.Namespace:
    """Flags of the command line, by their defaults.

    A sequence takes several values of its kind; a mapping several of its keys, by default all; False is a switch; a
    class is the kind of a value that may be missing.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in defaults.items():
        flag = f"--{name.replace('_', '-')}"
        if value is False:
            parser.add_argument(flag, action="store_true")
        elif isinstance(value, type):
            parser.add_argument(flag, type=value)
        elif isinstance(value, Mapping):
            parser.add_argument(flag, nargs="+", default=list(value), choices=value, help="default: all of them")
        elif isinstance(value, list | tuple):
            parser.add_argument(flag, nargs="*", default=value, help=f"default: {value}",
                                type=type(value[0]) if value else str)  # fmt: skip
        else:
            parser.add_argument(flag, default=value, type=type(value), help=f"default: {value}")
    return parser.parse_args()


def parsed(kind: type[T], description: str | None) -> T:
    """Settings of a dataclass from the command line."""
    hints = get_type_hints(kind)
    defaults = {
        name: next(iter(get_args(hints[name]))) if value is None else value for name, value in vars(kind()).items()
    }
    return kind(**vars(options(description, **defaults)))


def describe() -> dict[str, str | int]:
    """Processor, cores, Python, torch, date and commit."""
    import torch

    try:
        commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    except FileNotFoundError:
        commit = ""  # a machine without git
    return {
        "processor": _processor(), "cores": os.cpu_count() or 1, "python": platform.python_version(),
        "torch": torch.__version__, "date": date.today().isoformat(), "commit": commit,
    }  # fmt: skip


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.is_file() else ():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def write_rows(output: Path | None, rows: Sequence[Any], **settings: Any) -> None:
    """Write the rows of a benchmark (dataclasses) as JSON, with machine and settings; create the folder if needed."""
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        document = {"machine": describe(), **settings, "rows": [asdict(row) for row in rows]}
        output.write_text(json.dumps(document, indent=1) + "\n")


def kept_rows(output: Path, kind: Callable[..., T]) -> list[T]:
    """The rows of an earlier run."""
    return [kind(**row) for row in json.loads(output.read_text())["rows"]] if output.exists() else []


def shown(row: Any) -> str:
    """A line with the names and values of a row."""
    return "  ".join(f"{field.name} {_short(getattr(row, field.name))}" for field in fields(row))


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return f"({', '.join(map(_short, value))})"
    return str(value)


class Rows(list[T], Generic[T]):
    """Rows that are printed and written as they come."""

    def __init__(self, output: Path | None, kept: Sequence[T] = (), **settings: Any) -> None:
        """`kept` are those of an earlier run."""
        super().__init__(kept)
        self._output, self._settings = output, settings

    def have(self, **values: Any) -> bool:
        """Whether one of them has these values."""
        return any(all(getattr(row, name) == value for name, value in values.items()) for row in self)

    def add(self, *rows: T, line: Callable[[T], str] = shown) -> None:
        """Append them, print a line for each, and write all."""
        self.extend(rows)
        print("\n".join(map(line, rows)), flush=True)
        write_rows(self._output, self, **self._settings)


def markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *lines))


@dataclass(frozen=True)
class Part:
    """What a part of a process took."""

    seconds: float
    cpu_seconds: float  # of all threads
    peak_gb: float  # resident memory of the process during this part, libraries included


def measured(call: Callable[[], T]) -> tuple[T, Part]:
    """The result of a call, and what it took. Where the kernel cannot forget the peak, it is that since the start."""
    clear = Path(f"/proc/{os.getpid()}/clear_refs")
    if clear.exists():
        clear.write_text(_RESET_PEAK)
    wall, cpu = time.monotonic(), time.process_time()
    result = call()
    return result, Part(time.monotonic() - wall, time.process_time() - cpu, peak_gb())


def peak_gb() -> float:
    """Largest resident memory since the start, or since it was forgotten; `getrusage` would include the parent's."""
    status = Path("/proc/self/status")
    for line in status.read_text().splitlines() if status.exists() else ():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024**2
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
