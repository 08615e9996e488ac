"""sl-synth: flags, messages, exit status."""

import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.cli.synth import main
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.images import encode_png

_HELP = """
import sys
from sl_nerfstudio.cli.synth import main
sys.argv = ["sl-synth", "--help"]
try:
    main()
finally:
    slow = {"torch", "open3d", "numba", "scipy", "nerfstudio"} & set(sys.modules)
    print("imported", sorted(slow))
"""


def _run(monkeypatch, *flags):
    monkeypatch.setattr(sys, "argv", ["sl-synth", *map(str, flags)])
    main()


def test_a_small_scan(monkeypatch, tmp_path, capsys):
    out = tmp_path / "scän 1"
    _run(
        monkeypatch, "--output", out, "--frames", 2, "--resolution", 32, "--pose-error", 0, 0, "--units", "cm",
        "--autocalibration-error", 0, 0, 0, "--noise", 0, "--missing", 0, "--wrong", 0, "--projector-model", "DOE",
    )  # fmt: skip
    said = capsys.readouterr().out.replace(" \\\n     ", "")  # a long command continues on the next line
    assert said == f"wrote 2 frames to {out}\nnext:\n  ns-train sl-neus --data '{out}'\n"
    scan = read_scan(out)
    assert len(scan.frames) == 2 and scan.units == "cm" and scan.projector.model == "DOE"
    assert scan.frames[0].camera.w == 32


def test_captures_under_a_picture_are_not_sent_to_a_decoder_that_needs_codes(monkeypatch, tmp_path, capsys):
    (tmp_path / "white.png").write_bytes(encode_png(np.full((64, 64), 255, np.uint8)))
    flags = ("--frames", 2, "--resolution", 32, "--images-only", "--pattern")
    _run(monkeypatch, "--output", tmp_path / "plain", *flags, tmp_path / "white.png")
    said = " ".join(capsys.readouterr().out.split())
    assert "sl-process cannot decode these captures" in said and "next:" not in said
    assert not (tmp_path / "plain/pattern.json").exists()
    _run(monkeypatch, "--output", tmp_path / "coded", *flags[:-1])
    said = shlex.split(capsys.readouterr().out.partition("next:")[2].replace("\\\n", ""))
    assert said[0] == "sl-process" and all(Path(word).exists() for word in said[2:8:2]), said


def test_help_is_there_without_slow_imports():
    done = subprocess.run([sys.executable, "-c", _HELP], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.rstrip().endswith("imported []")
    flags = "output scene frames resolution pose-error autocalibration-error noise missing wrong seed units clean"
    for flag in [
        *flags.split(),
        "projector-model",
        "images-only",
        "appearance",
        "background",
        "world-turn",
        "path",
        "pattern",
    ]:
        assert f"--{flag}" in done.stdout, flag


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--frames", "1"], "error: --frames 1: a scan needs at least 2 frames"),
        (["--scene", "no.ply"], "error: --scene no.ply: there is no such file"),
        (["--pattern", "no.json"], "error: no.json: is missing"),
        (["--missing", "15"], "error: --missing 15.0: it is a fraction"),
    ],
)
def test_faults_of_the_user_end_with_one_line_and_status_1(monkeypatch, tmp_path, capsys, flags, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        _run(monkeypatch, "--output", "scan", *flags)
    assert stop.value.code == 1
    assert capsys.readouterr().err.startswith(message)
    assert not (tmp_path / "scan").exists()


def test_a_folder_in_use(monkeypatch, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit) as stop:
        _run(monkeypatch, "--output", tmp_path)
    assert stop.value.code == 1 and "is not empty" in capsys.readouterr().err
