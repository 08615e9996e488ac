import io
import sys
from collections.abc import Iterator

import pytest

from sl_nerfstudio import progress
from sl_nerfstudio.progress import track


class Terminal(io.StringIO):
    """A stream that rich treats as a terminal."""

    def isatty(self) -> bool:
        return True


def use_terminal(monkeypatch: pytest.MonkeyPatch, show_after: float = -1.0) -> Terminal:
    """From now on stderr is a terminal (in a fixture, pytest would restore its own stream)."""
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(progress, "SHOW_AFTER_SECONDS", show_after)
    return stream


def test_quiet_without_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(progress, "SHOW_AFTER_SECONDS", -1.0)
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
    assert progress._shown is False


def test_leaving_a_loop_early_releases_the_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    use_terminal(monkeypatch)
    for item in track(range(10), "Working"):
        if item == 4:
            break
    assert progress._shown is False
