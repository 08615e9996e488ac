"""Commands called in this process, and what they say: one file a command, with a section for each thing that is said.

SL_RENEW_SNAPSHOTS=1 writes what the commands say now; `git diff tests/cli/snapshots` then shows what changed.
"""

import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import pytest

from sl_nerfstudio import console

FOLDER = Path(__file__).with_name("snapshots")


@dataclass(frozen=True)
class Ended:
    """How a command ended, and what it printed."""

    status: int
    out: str
    err: str

    @property
    def words(self) -> str:
        """The output without line breaks, which depend on the length of paths."""
        return " ".join(self.out.replace(" \\\n", " ").split())


def call(main: Callable[[], None], command: str, *flags: object) -> Ended:
    """Run a command's `main` with flags."""
    out, err, status = StringIO(), StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", [command, *map(str, flags)])
        patch.setattr(console, "PLAIN_SECONDS", 1e9)  # whether lines of progress appear depends on the machine
        try:
            main()
        except SystemExit as stop:
            status = int(stop.code or 0)
    return Ended(status, out.getvalue(), err.getvalue())


def succeed(main: Callable[[], None], command: str, *flags: object) -> Ended:
    """Run a command that must succeed."""
    ended = call(main, command, *flags)
    assert ended.status == 0, ended.err
    return ended


def masked(text: str) -> str:
    """The text without its numbers and the current folder."""
    return re.sub(r"\d[\d,.]*(e[-+]?\d+)?", "#", text.replace(str(Path.cwd()), "HERE"))


def expect(command: str, section: str, text: str) -> None:
    """Compare what a command says with its snapshot, or renew it."""
    path = FOLDER / f"{command}.txt"
    parts = re.split(r"^=== (.*)\n", path.read_text() if path.exists() else "", flags=re.MULTILINE)[1:]
    kept = dict(zip(parts[::2], parts[1::2], strict=True))
    text = text.replace(str(Path.cwd()), "HERE")
    text = "\n".join(line.rstrip() for line in text.strip("\n").splitlines()) + "\n"
    if os.environ.get("SL_RENEW_SNAPSHOTS"):
        kept[section] = text
        FOLDER.mkdir(exist_ok=True)
        path.write_text("".join(f"=== {name}\n{said}" for name, said in sorted(kept.items())))
    # Where lines break, and commands with a backslash, depends on the numbers and paths in them.
    said, known = ([word for word in some.split() if word != "\\"] for some in (text, kept.get(section, "")))
    same = said == known
    assert same, f"{command} says something else: SL_RENEW_SNAPSHOTS=1 renews {path.name}\n{text}"


def expect_refusals(main: Callable[[], None], command: str, usual: Sequence[object], *cases: Sequence[object]) -> None:
    """Each case must end with status 1 and one message; `usual` flags come before those of a case."""
    said = []
    for flags in cases:
        ended = call(main, command, *usual, *flags)
        assert ended.status == 1 and ended.err.startswith("error: "), (flags, ended)
        said.append(f"$ {' '.join(map(str, flags))}\n{ended.err}")
    expect(command, "refused", "".join(said))
