"""sl-pattern: what it writes is complete, and bad flags are named."""

import re
import sys

import numpy as np
import pytest
from PIL import Image

from sl_nerfstudio.cli.pattern import main, margin_warning
from sl_nerfstudio.pattern.files import PRESETS, make_grid, read_layout
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import read_image


def _run(monkeypatch, *flags):
    monkeypatch.setattr(sys, "argv", ["sl-pattern", *map(str, flags)])
    main()


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_tell_places_apart_whatever_the_roll_of_the_camera(preset):
    grid = make_grid(preset)
    assert (grid.w, grid.h, grid.period) == PRESETS[preset] and grid.margins == (3, 2)


def test_a_folder_with_a_grid(monkeypatch, tmp_path, capsys):
    out = tmp_path / "müster"
    _run(monkeypatch, "--output", out, "--preset", "doe")
    grid = read_layout(out / "pattern.json")
    assert (grid.w, grid.h, grid.period) == PRESETS["doe"]
    image = read_image(out / "pattern.png")
    assert image.shape == (grid.h, grid.w)
    # the description alone gives the same picture
    assert np.abs(image / 255 - grid.render(4)).max() < 0.5 / 255 + 1e-6
    said = capsys.readouterr().out
    assert "differ in at least 3 of 9 symbols, in 2 where the camera may roll" in said and "warning" not in said


def test_too_many_nodes_are_warned_of_and_the_remedy_helps(monkeypatch, tmp_path, capsys):
    """Where (3, 2) cannot be had, the roll of the camera counts before the second misread symbol."""
    flags = ["--width", 355, "--height", 200]
    _run(monkeypatch, "--output", tmp_path / "a", *flags, "--period", 5)
    said = capsys.readouterr().out
    assert "differ in at least 2 of 9 symbols, in 2 where the camera may roll" in said
    assert "warning: misread symbols are mistaken" in said and "71 x 40 nodes are too many" in said
    period = re.search(r"--period (\d+) or more", said)[1]
    _run(monkeypatch, "--output", tmp_path / "b", *flags, "--period", period)
    said = capsys.readouterr().out
    assert "in at least 3 of 9 symbols, in 2 where" in said and "warning" not in said


def test_the_warning_names_the_preset_of_the_size():
    grid = GridPattern(w=1920, h=1080, period=20.0, codes=np.zeros((54, 96), dtype=np.int8))
    assert "--period 30 or more, as --preset 1920x1080 does" in margin_warning(grid)


def test_flags_override_the_preset(monkeypatch, tmp_path):
    out = tmp_path / "p"
    _run(
        monkeypatch, "--output", out, "--width", 320, "--height", 200, "--period", 16, "--line-width", 3, "--gap", 5,
        "--seed", 4, "--print-width", 80,
    )  # fmt: skip
    grid = read_layout(out / "pattern.json")
    assert (grid.w, grid.h, grid.period, grid.line_width, grid.gap, grid.seed) == (320, 200, 16, 3, 5, 4)
    with Image.open(out / "pattern.png") as image:
        assert image.info["dpi"][0] == pytest.approx(320 / 80 * 25.4, rel=1e-3)


def test_gray_code(monkeypatch, tmp_path, capsys):
    out = tmp_path / "g"
    _run(monkeypatch, "--output", out, "--kind", "gray-code", "--width", 32, "--height", 24, "--cell", 2)
    layout = read_layout(out / "pattern.json")
    assert layout == GrayCode(32, 24, 2)
    shown = [read_image(path) for path in sorted((out / "sequence").iterdir())]
    assert all(np.array_equal(a, b) for a, b in zip(shown, layout.sequence(), strict=True))
    assert "18 images" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--period", "0"], "--period 0: give 2 pixels or more"),
        (["--line-width", "25"], "a grid needs 0 < line_width < period"),
        (["--gap", "19"], "gap < period - line_width"),
        (["--width", "30"], "fewer than 3 x 3 nodes"),
        (["--width", "100000"], "too large: give at most 200 nodes a side"),
        (["--seed", "-1"], "--seed -1: seeds are at least 0"),
        (["--print-width", "0"], "--print-width 0: give a width in millimetres above 0"),
        (["--kind", "gray-code", "--gap", "3"], "--gap: has no meaning for --kind gray-code"),
        (["--cell", "3"], "--cell: has no meaning for --kind grid"),
        (["--square", "3 mm"], "flags are --preset, --width, --height, --period, --line-width, --gap, --seed"),
        (["--kind", "gray-code", "--cell", "0"], "at least 2 x 2 cells"),
    ],
)
def test_bad_flags(monkeypatch, tmp_path, capsys, flags, message):
    with pytest.raises(SystemExit) as stop:
        _run(monkeypatch, "--output", tmp_path / "x", *flags)
    assert stop.value.code == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_nothing_is_overwritten(monkeypatch, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(SystemExit):
        _run(monkeypatch, "--output", tmp_path)
    assert "is not empty" in capsys.readouterr().err and len(list(tmp_path.iterdir())) == 1
