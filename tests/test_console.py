"""Text for a terminal: lines, commands to copy, progress."""

import io
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio import console
from sl_nerfstudio.console import (
    WIDTH,
    Phase,
    command,
    duration,
    fitted,
    next_steps,
    paragraph,
    phase,
    short_path,
    track,
)

PLAIN = st.text(st.characters(exclude_characters="\n\\", exclude_categories=["Cs"]), max_size=30)
WORDS = st.lists(st.one_of(st.sampled_from(["--data", "--poses", "-v"]), PLAIN), max_size=12)


@hypothesis.settings(max_examples=20)
@given(WORDS)
def test_a_command_can_be_copied_however_long_it_is(words):
    assert shlex.split(command("sl-eval", *words).replace("\\\n", "")) == ["sl-eval", *words]


def test_a_long_command_continues_at_its_flags():
    folder = "a/folder/with/a/name/that/is/rather/long"
    text = command("sl-eval", "--mesh", "mesh.ply", "--data", folder, "--poses", f"{folder}/transforms.json")
    assert text.splitlines() == [
        f"  sl-eval --mesh mesh.ply --data {folder} \\",
        f"      --poses {folder}/transforms.json",
    ]
    assert next_steps([text]).startswith("next:\n  sl-eval --mesh")


@given(st.text(alphabet="ab c\n", max_size=400))
def test_paragraphs_fit_a_terminal_and_keep_every_word(text):
    lines = paragraph("adjust", text).splitlines()
    assert all(len(line) <= WIDTH or len(line.split()) <= 2 for line in lines)
    assert " ".join(lines).split()[1:] == text.split() or not text.strip()


def test_lines_and_insets_of_a_text_stay():
    text = paragraph("adjust", "Poses adjusted.\n    cause:  " + "word " * 20)
    assert text.splitlines()[0] == "adjust      Poses adjusted."
    assert all(line.startswith(" " * 16) for line in text.splitlines()[1:])


@given(st.lists(st.tuples(st.sampled_from([0, 2, 4]), st.text(alphabet="ab ", max_size=200)), max_size=5))
def test_long_lines_continue_further_to_the_right_and_keep_every_word(lines):
    text = "\n".join(" " * inset + f"x{words}".rstrip() for inset, words in lines)
    out = fitted(text).splitlines()
    assert " ".join(out).split() == text.split()
    assert all(len(line) <= WIDTH or len(line.split()) == 1 for line in out)
    starts = [line for line in out if line.strip().startswith("x")]
    assert [len(line) - len(line.lstrip()) for line in starts] == [inset for inset, _ in lines]
    assert all(line.startswith("    ") for line in out if line not in starts)
    assert all(line in out for line in text.splitlines() if len(line) <= WIDTH)


@pytest.mark.parametrize(
    "seconds, said",
    [(-3.0, "0 s"), (0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 0 s"), (3599.0, "59 min 59 s"), (1e6, "277 h 46 min")],
)
def test_durations_are_never_given_in_days(seconds, said):
    assert duration(seconds) == said


def test_paths_in_the_current_folder_are_short(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert short_path(tmp_path / "scan") == Path("scan")
    assert short_path(tmp_path) == tmp_path and short_path(Path("/elsewhere")) == Path("/elsewhere")


class Terminal(io.StringIO):
    """A stream that rich treats as a terminal."""

    def isatty(self) -> bool:
        return True


def use_terminal(monkeypatch: pytest.MonkeyPatch, show_after: float = -1.0) -> Terminal:
    """From now on stderr is a terminal (in a fixture, pytest would restore its own stream)."""
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(console, "SHOW_AFTER_SECONDS", show_after)
    return stream


@pytest.mark.parametrize("show_after", [None, 1e9], ids=["no terminal", "short work"])
def test_no_bar_is_shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], show_after) -> None:
    terminal = None if show_after is None else use_terminal(monkeypatch, show_after)
    monkeypatch.setattr(console, "SHOW_AFTER_SECONDS", -1.0 if show_after is None else show_after)
    assert list(track(iter(range(5)), "Working")) == [0, 1, 2, 3, 4]
    assert capsys.readouterr() == ("", "") and (terminal is None or terminal.getvalue() == "")


def test_one_bar_at_a_time_for_long_work_and_errors_pass_through(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = use_terminal(monkeypatch)
    pairs = [(i, j) for i in track(range(3), "Outer") for j in track(range(3), "Inner")]
    assert pairs == [(i, j) for i in range(3) for j in range(3)]
    assert console._phase is None

    def failing() -> Iterator[int]:
        yield 1
        yield 2
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(track(failing(), "Failing", total=4))
    for item in track(range(10), "Left early"):
        if item == 4:
            break
    assert console._phase is None
    with pytest.raises(ZeroDivisionError), phase("check") as shown:
        shown.say("no faults")
        raise ZeroDivisionError
    assert "no faults" not in terminal.getvalue() and console._phase is None


def wait_for(said: str, stream: Terminal) -> None:
    until = time.monotonic() + 20
    while said not in stream.getvalue() and time.monotonic() < until:
        time.sleep(0.01)


def test_a_phase_or_a_loop_alone_prints_lines_where_there_is_no_terminal(monkeypatch, capsys):
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    monkeypatch.setattr(console, "PLAIN_SECONDS", 0.01)
    with phase("train") as shown:
        shown.update(3, 100, "coordinates to 0.5 px")
        wait_for("3 of 100", log)
        for _ in track(range(7), "Reading frames"):
            wait_for("reading frames", log)
        shown.say("100 steps")
    lines = log.getvalue().splitlines()
    assert "train       3 of 100, coordinates to 0.5 px" in lines
    assert any(line.startswith("train       0 of 7, reading frames") for line in lines)
    assert capsys.readouterr().out == "train       100 steps\n"
    for k in track(range(4), "rendering"):
        wait_for(f"rendering   {k} of 4", log)
    assert "rendering   3 of 4" in log.getvalue()


def test_loops_and_phases_in_a_phase_are_its_progress_and_leave_it_as_it_was(monkeypatch, capsys):
    monkeypatch.setattr(console, "PLAIN_SECONDS", 1e9)
    with phase("register") as shown:
        for _ in track(range(3), "rounds"):
            for _ in track(range(5), "Pairs"):
                assert (shown.total, shown.note) == (5, "pairs")
            assert (shown.total, shown.note) == (3, "rounds")
        with phase("adjust"):
            assert (shown.total, shown.note) == (None, "adjust")
        assert (shown.total, shown.note) == (None, "")
        console.say("at once")
        assert capsys.readouterr().out == "at once\n"
        monkeypatch.setattr(sys, "stderr", Terminal())
        console.say("4 of 4 frames")
        assert capsys.readouterr().out == ""  # the bar has the last line
    assert capsys.readouterr().out == "4 of 4 frames\n"


def test_a_phase_shows_a_bar_on_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    terminal = use_terminal(monkeypatch)
    with phase("adjust") as shown:
        shown.update(1, 4)
        shown.update(2, 4)
        wait_for("2 of 4", terminal)
    assert "adjust" in terminal.getvalue() and "\n\n" not in terminal.getvalue()
    assert capsys.readouterr().out == ""  # nothing was said


def test_the_time_left_follows_from_the_latest_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    shown = Phase("train", started=0.0)
    assert shown.seconds_left is None and shown.state() == "0 s so far"
    now[0] = 25.0  # what came before the first step does not count
    for step in range(101):
        shown.update(step, 1000)
        now[0] += 0.5
    assert shown.seconds_left == pytest.approx(450)
    for step in range(101, 301):
        shown.update(step, 1000)
        now[0] += 2.0
    assert shown.seconds_left == pytest.approx(1400) and shown.state() == "300 of 1000, 23 min 20 s left"
    shown.update(0, 20)  # another loop
    assert shown.seconds_left is None
