import io
import sys
import time
from collections.abc import Iterator

import pytest

from sl_nerfstudio import console
from sl_nerfstudio.console import Phase, phase, track


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


def test_quiet_without_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(console, "SHOW_AFTER_SECONDS", -1.0)
    assert list(track(range(5), "Working")) == [0, 1, 2, 3, 4]
    assert capsys.readouterr() == ("", "")


def test_quiet_for_short_work(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = use_terminal(monkeypatch, show_after=1e9)
    assert list(track(iter(range(5)), "Working")) == [0, 1, 2, 3, 4]
    assert terminal.getvalue() == ""


def test_a_bar_for_long_work(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = use_terminal(monkeypatch)
    assert list(track(["a", "b", "c"], "Working")) == ["a", "b", "c"]
    assert "Working" in terminal.getvalue()
    assert "/3" in terminal.getvalue()


def test_one_bar_at_a_time_and_errors_pass_through(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = use_terminal(monkeypatch)
    pairs = [(i, j) for i in track(range(3), "Outer") for j in track(range(3), "Inner")]
    assert pairs == [(i, j) for i in range(3) for j in range(3)]
    assert "Outer" in terminal.getvalue()

    def failing() -> Iterator[int]:
        yield 1
        yield 2
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(track(failing(), "Failing", total=4))
    assert console._shown is False


def test_leaving_a_loop_early_releases_the_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    use_terminal(monkeypatch)
    for item in track(range(10), "Working"):
        if item == 4:
            break
    assert console._shown is False


def wait_for(said: str, stream: Terminal) -> None:
    until = time.monotonic() + 20
    while said not in stream.getvalue() and time.monotonic() < until:
        time.sleep(0.01)


def test_a_phase_prints_lines_where_there_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_a_phase_shows_a_bar_on_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    terminal = use_terminal(monkeypatch)
    with phase("adjust") as shown:
        shown.update(1, 4)
        shown.update(2, 4)
        wait_for("2 of 4", terminal)
    assert "adjust" in terminal.getvalue() and "\n\n" not in terminal.getvalue()
    assert "adjust      done" in capsys.readouterr().out + terminal.getvalue()


def test_a_phase_that_fails_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ZeroDivisionError), phase("check") as shown:
        shown.say("no faults")
        raise ZeroDivisionError
    assert capsys.readouterr() == ("", "")
    assert console._phase is None


def test_the_time_left_follows_from_the_latest_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    shown = Phase("train", started=0.0)
    assert shown.seconds_left is None and shown.state() == ""
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
