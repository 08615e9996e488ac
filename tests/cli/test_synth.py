"""sl-synth: scans, captures of photographs alone, and what it refuses."""

import shlex
from pathlib import Path

import numpy as np

from sl_nerfstudio.cli.synth import main
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.images import encode_png

from .snapshots import expect, expect_refusals, succeed

SMALL = ("--frames", 2, "--resolution", 32)


def test_scans_and_captures_are_written_and_the_next_command_is_one_that_can_work(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    exact = ("--pose-error", 0, 0, "--autocalibration-error", 0, 0, 0, "--noise", 0, "--missing", 0, "--wrong", 0)
    flags = ("--units", "cm", "--projector-model", "DOE")
    said = [succeed(main, "sl-synth", "--output", "scän 1", *SMALL, *exact, *flags).out]
    scan = read_scan(tmp_path / "scän 1")
    assert len(scan.frames) == 2 and scan.units == "cm" and scan.projector.model == "DOE"
    assert scan.frames[0].camera.w == 32
    Path("white.png").write_bytes(encode_png(np.full((64, 64), 255, np.uint8)))
    said.append(succeed(main, "sl-synth", "--output", "plain", *SMALL, "--images-only", "--pattern", "white.png").out)
    assert "next:" not in said[1] and not Path("plain/pattern.json").exists()  # no decoder could read it
    said.append(succeed(main, "sl-synth", "--output", "coded", *SMALL, "--images-only").out)
    words = shlex.split(said[2].partition("next:")[2].replace("\\\n", ""))
    assert words[0] == "sl-process" and all(Path(word).exists() for word in words[2:8:2])
    said.append(succeed(main, "sl-synth", "--output", "board", *SMALL, "--scene", "chessboard", "--frames", 3).out)
    words = shlex.split(said[3].partition("next:")[2].replace("\\\n", ""))
    assert words[0] == "sl-calibrate" and all(
        Path(words[words.index(f) + 1]).exists() for f in ("--images", "--pattern")
    )
    expect("sl-synth", "run", "".join(said))


def test_flags_that_cannot_be_are_named_and_nothing_is_written(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    Path("mine/file").touch()
    expect_refusals(
        main, "sl-synth", ["--output", "mine"],
        ["--output", "scan", "--frames", 1], ["--output", "scan", "--scene", "no.ply"],
        ["--output", "scan", "--pattern", "no.json"], ["--output", "scan", "--missing", 15], SMALL,
    )  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
