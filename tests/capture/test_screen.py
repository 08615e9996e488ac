"""sl-pattern --show: what the display shows is the pattern, pixel for pixel."""

import sys

import numpy as np
import pytest
from PIL import Image

from sl_nerfstudio.cli.pattern import main
from sl_nerfstudio.pattern.files import MOST_NODES, longer_period, read_layout
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.scan.images import read_image
from tests.capture.conftest import middle

DISPLAY = (1024, 768)  # of SDL's dummy driver
SMALL = ["--width", 160, "--height", 120]
GRAY = ["--kind", "gray-code", "--width", 64, "--height", 32, "--cell", 8]


@pytest.fixture
def show(keyboard, command, tmp_path):
    return lambda *flags: command(main, "--output", tmp_path / "p", *flags)


def fails(capsys, call, message):
    with pytest.raises(SystemExit) as stop:
        call()
    said = capsys.readouterr().err
    assert stop.value.code == 1 and message in said and "remedy:" in said
    return said


def test_without_a_size_the_pattern_gets_that_of_the_display(show, keyboard, tmp_path):
    show("--show", 0, "--period", 64)
    layout = read_layout(tmp_path / "p" / "pattern.json")
    assert (layout.w, layout.h, layout.period) == (*DISPLAY, 64)
    (screen,) = keyboard.different()
    assert np.array_equal(screen, np.repeat(read_image(tmp_path / "p" / "pattern.png")[..., None], 3, -1))


@pytest.mark.parametrize("size", [(1024, 768), (1280, 720), (1920, 1080), (3840, 2160), (854, 480), (100, 1000)])
def test_without_a_period_there_are_as_many_nodes_as_the_codes_allow(size):
    period = longer_period(*size)
    assert (size[0] // period) * (size[1] // period) <= MOST_NODES < size[0] * size[1] / (period - 1) ** 2


def test_smaller_patterns_are_shown_in_the_middle_and_not_scaled(show, keyboard, tmp_path, capsys):
    show("--show", 0, *SMALL)
    (screen,) = keyboard.different()
    image = read_image(tmp_path / "p" / "pattern.png")
    assert np.array_equal(middle(screen, 160, 120)[..., 1], image)
    assert screen.sum() == 3 * image.astype(int).sum()  # black around it
    assert "Pixel (0, 0) of the pattern is pixel (432, 324) of the display" in capsys.readouterr().out


def test_a_written_pattern_is_shown_again(show, keyboard, tmp_path, capsys):
    show(*SMALL)
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "p").iterdir()}
    show("--show", 0)  # whatever it is
    show("--show", 0, *SMALL)  # this very pattern
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "p").iterdir()} == files
    assert len(keyboard.different()) == 1
    fails(capsys, lambda: show("--show", 0, *SMALL, "--seed", 3), "is not the one of these flags")
    fails(capsys, lambda: show("--show", 0, *GRAY), "holds a coded grid of 160 x 120 pixels that is not")
    fails(capsys, lambda: show(*SMALL), "is not empty")


def test_keys_lead_through_a_sequence(show, keyboard, capsys):
    keyboard.press("SPACE", "RIGHT", "a", "LEFT", "LEFT", "LEFT", *["RETURN"] * 12)
    show("--show", 0, *GRAY)
    patterns = list(GrayCode(64, 32, 8).sequence())
    indices = [0, 1, 2, 1, *range(12), 0]  # after the last comes the first
    for screen, index in zip(keyboard.different(), indices, strict=True):
        assert np.array_equal(middle(screen, 64, 32)[..., 0], patterns[index])
    assert "  02  x bit 2\n" in capsys.readouterr().out


def test_with_a_timer_every_image_is_shown_once(show, keyboard, capsys):
    keyboard.press(*[""] * 500)
    show("--show", 0, "--every", "0.001", *GRAY)
    shown = [middle(screen, 64, 32)[..., 0] for screen in keyboard.different()]
    assert len(shown) == 12 and all(map(np.array_equal, shown, GrayCode(64, 32, 8).sequence()))
    assert max(keyboard.waits) == 1  # milliseconds


def test_a_pattern_larger_than_the_display_is_refused_before_it_is_written(show, tmp_path, capsys):
    said = fails(capsys, lambda: show("--show", 0, "--preset", "1280x720"), "the pattern has 1280 x 720 pixels")
    assert "the display 1024 x 768" in said and "a pattern is never scaled" in said and not (tmp_path / "p").exists()


def test_flags_that_do_not_fit(show, capsys):
    for flags, message in (
        (["--every", "1", *GRAY], "--every 1: give seconds above 0, together with --show"),
        (["--every", "0", "--show", "0"], "--every 0: give seconds above 0"),
        (["--show", "0", "--kind", "chessboard", "--print-width", "180"], "--show: has no meaning for --kind chess"),
        (["--show", "0", "--every", "2", *SMALL], "--every 2: a coded grid is one image; leave it out"),
    ):
        with pytest.raises(SystemExit):
            show(*flags)
        assert message in capsys.readouterr().err


def test_what_keeps_a_pattern_from_being_shown_is_said(show, monkeypatch, capsys, tmp_path):
    for number in (1, -1):
        message = f"--show {number}: there is no display of this number; displays are 0 (1024 x 768)"
        fails(capsys, lambda number=number: show("--show", number), message)
    assert not (tmp_path / "p").exists()
    show(*SMALL)
    Image.new("L", (160, 121)).save(tmp_path / "p" / "pattern.png")
    fails(capsys, lambda: show("--show", 0), "is no grey image of 160 x 120 pixels, as pattern.json says")
    monkeypatch.setenv("SDL_VIDEODRIVER", "")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    sys.modules["pygame"].display.quit()
    fails(capsys, lambda: show("--show", 0), "there is no display to show anything on")
    monkeypatch.setitem(sys.modules, "pygame", None)
    fails(capsys, lambda: show("--show", 0), "pip install 'sl-nerfstudio[show]'")
