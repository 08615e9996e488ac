"""Text for people who read it in a terminal: lines of 80 columns, durations, commands to copy."""

import os
import shlex
import sys
import textwrap
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

WIDTH = 80
_NAME = 12  # columns of the name before a text


def paragraph(name: str, text: str) -> str:
    """`text` beside `name`, in lines of at most 80 columns; the lines of `text` stay lines of their own."""
    lines = [part for line in text.splitlines() for part in _wrapped(line, WIDTH - _NAME)]
    return "\n".join(f"{name if k == 0 else '':<{_NAME}}{line}" for k, line in enumerate(lines))


def _wrapped(line: str, width: int, hanging: str = "") -> list[str]:
    inset = " " * (len(line) - len(line.lstrip()))
    return textwrap.wrap(
        line.strip(), width, initial_indent=inset, subsequent_indent=inset + hanging,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def fitted(text: str) -> str:
    """`text` in lines of at most 80 columns; what does not fit continues four columns further to the right."""
    lines = ([line] if len(line) <= WIDTH else _wrapped(line, WIDTH, "    ") for line in text.splitlines())
    return "\n".join(part for parts in lines for part in parts)


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


# Progress of work that a person waits for: a bar on a terminal, else lines, and phases that say what they found.

T = TypeVar("T")

SHOW_AFTER_SECONDS = 2.0
PLAIN_SECONDS = 9.0  # between two lines of progress where there is no terminal: ten with what lies between phases
_RECENT_SECONDS = 30.0  # over which the speed is measured
_phase: "Phase | None" = None  # the one that runs: loops inside it are its progress


@dataclass
class Phase:
    """A part of a long command. While it runs it shows how far it is; at its end, it prints what it found."""

    name: str
    started: float = field(default_factory=time.monotonic)
    done: int = 0
    total: int | None = None
    note: str = ""
    result: str = ""
    lines: list[str] = field(default_factory=list)  # of `say`, printed when the bar is gone
    _recent: deque[tuple[float, int]] = field(default_factory=deque)

    def update(self, done: int, total: int | None, note: str = "") -> None:
        """Note how much of the work is done; the time left follows from the speed of the last half minute."""
        now = time.monotonic()
        if total != self.total or note != self.note or done < self.done:
            self._recent.clear()
        self.done, self.total, self.note = done, total, note
        self._recent.append((now, done))
        while now - self._recent[0][0] > _RECENT_SECONDS:
            self._recent.popleft()

    def say(self, result: str) -> None:
        """What was found: printed when the phase ends."""
        self.result = "\n".join(filter(None, [self.result, result]))

    @property
    def seconds_left(self) -> float | None:
        """Estimate; None before there is a speed."""
        if self.total is None or len(self._recent) < 2:
            return None
        (start, before), (now, done) = self._recent[0], self._recent[-1]
        return (self.total - done) * (now - start) / (done - before) if done > before else None

    def state(self) -> str:
        """Say how far the phase is; while nothing is counted, how long it has been running."""
        if not self.total:
            return ", ".join(filter(None, [self.note, f"{duration(time.monotonic() - self.started)} so far"]))
        left = self.seconds_left
        count = f"{self.done} of {self.total}"
        return ", ".join(filter(None, [count, self.note, "" if left is None else f"{duration(left)} left"]))


@contextmanager
def phase(name: str) -> Iterator[Phase]:
    """Show a part of a command while it runs: a bar on a terminal after two seconds, else a line every nine seconds.

    When it ends without an error, what was said and how long it took are printed on standard output. Loops of `track`
    inside it, and phases inside it, are shown as its progress.
    """
    global _phase
    outer = _phase
    if outer is not None:
        outer.update(0, None, name)
        yield outer
        outer.update(0, None)
        return
    _phase = found = Phase(name)
    try:
        with _shown(found):
            yield found
    finally:
        _phase = None
        for line in found.lines:
            print(line, flush=True)
    took = time.monotonic() - found.started
    if found.result:
        text = found.result + (f" ({duration(took)})" if "\n" not in found.result and took >= 1 else "")
        print(paragraph(name, text), flush=True)


def say(text: str) -> None:
    """Print a line of output, at once even if that is a file; where a bar is shown, when its phase ends."""
    if _phase is None or not sys.stderr.isatty():
        print(text, flush=True)
    else:
        _phase.lines.append(text)


@contextmanager
def _shown(found: Phase) -> Iterator[None]:
    """Show the state of a phase from a thread until the block ends."""
    ended = threading.Event()
    show = _show_bar if sys.stderr.isatty() else _print_lines
    thread = threading.Thread(target=show, args=(found, ended), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _print_lines(found: Phase, ended: threading.Event) -> None:
    while not ended.wait(PLAIN_SECONDS):
        print(paragraph(found.name, found.state()), file=sys.stderr, flush=True)


def _show_bar(found: Phase, ended: threading.Event) -> None:
    """Keep the last line of the terminal up to date; it is gone afterwards."""
    if ended.wait(SHOW_AFTER_SECONDS):
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    console.width = min(console.width, WIDTH)
    columns = (TextColumn("{task.description:<11}"), BarColumn(20), TextColumn("{task.fields[state]}"))
    with Progress(*columns, console=console, transient=True, auto_refresh=False, redirect_stdout=False) as bar:
        task = bar.add_task(found.name, state="")
        shown = False
        while not shown or not ended.wait(0.25):
            bar.update(task, total=found.total, completed=found.done, state=found.state(), refresh=True)
            shown = True


def track(iterable: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Yield the items of `iterable`; how many there were is shown as progress, inside a `phase` as that of the phase.

    `total` is the number of items, by default `len(iterable)` if that exists.
    """
    if total is None and hasattr(iterable, "__len__"):
        total = len(iterable)  # type: ignore[arg-type]
    with nullcontext(_phase) if _phase is not None else phase(description) as shown:
        before = shown.done, shown.total, shown.note
        note = "" if description == shown.name else description.lower()
        shown.update(0, total, note)  # the first item may take long
        for done, item in enumerate(iterable):
            shown.update(done, total, note)
            yield item
        shown.update(*before)
