"""Text for people who read it in a terminal: lines of 80 columns, durations, commands to copy."""

import os
import shlex
import textwrap
from collections.abc import Sequence
from pathlib import Path

WIDTH = 80
_NAME = 12  # columns of the name before a text


def paragraph(name: str, text: str) -> str:
    """`text` beside `name`, in lines of at most 80 columns; the lines of `text` stay lines of their own."""
    lines = [part for line in text.splitlines() for part in _wrapped(line)]
    return "\n".join(f"{name if k == 0 else '':<{_NAME}}{line}" for k, line in enumerate(lines))


def _wrapped(line: str) -> list[str]:
    inset = len(line) - len(line.lstrip())
    return textwrap.wrap(
        line.strip(), WIDTH - _NAME, initial_indent=" " * inset, subsequent_indent=" " * inset,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def fitted(text: str) -> str:
    """`text` in lines of at most 80 columns; what does not fit continues four columns further to the right."""
    return "\n".join(line if len(line) <= WIDTH else _continued(line) for line in text.splitlines())


def _continued(line: str) -> str:
    inset = " " * (len(line) - len(line.lstrip()))
    return textwrap.fill(
        line.strip(), WIDTH, initial_indent=inset, subsequent_indent=f"{inset}    ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def duration(seconds: float) -> str:
    """A duration as a person says it: `8 s`, `2 min 5 s`, `1 h 20 min`."""
    whole = max(round(seconds), 0)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def figure(value: float) -> str:
    """A number to three digits, without an exponent for usual sizes."""
    return f"{float(f'{value:.3g}'):,.0f}" if 1000 <= abs(value) < 1e9 else f"{value:.3g}"


def unit_word(units: str) -> str:
    """The unit of a scan after a number."""
    return "units" if units == "arbitrary" else units


def command(*words: object, indent: str = "  ") -> str:
    """A command to copy, quoted for a shell; one that is longer than 80 columns continues at its flags."""
    quoted = [shlex.quote(str(word)) for word in words]
    line = indent + " ".join(quoted)
    if len(line) <= WIDTH:
        return line
    parts: list[str] = []
    for word in quoted:
        if parts and not word.startswith("-"):
            parts[-1] += f" {word}"
        else:
            parts.append(word)
    lines, rest = [indent + parts[0]], parts[1:]
    for part in rest:
        if len(lines[-1]) + 1 + len(part) + 2 <= WIDTH:
            lines[-1] += f" {part}"
        else:
            lines.append(f"{indent}    {part}")
    return " \\\n".join(lines)


def short_path(path: Path) -> Path:
    """The path from the current folder if it is inside it, else as it is."""
    absolute = Path(os.path.abspath(path))
    here = Path.cwd()
    return absolute.relative_to(here) if absolute.is_relative_to(here) and absolute != here else path


def next_steps(commands: Sequence[str]) -> str:
    """The commands to continue with, each from `command`."""
    return "\n".join(["next:", *commands])
