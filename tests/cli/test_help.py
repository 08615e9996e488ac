"""The help of every command: its words and its shape, and that it needs neither slow imports nor a network."""

import dataclasses
import importlib
import os
import re
import subprocess
import sys

import pytest

from sl_nerfstudio.cli.arguments import flags_of, help_text
from tests.test_package import SCRIPTS

from .snapshots import call, expect

# Runs a command's `main` with --help and says which slow modules that loaded. Sockets raise.
HELP = """
import importlib, socket, sys
def refuse(*a, **k): raise RuntimeError("a help text reached for the network")
socket.socket.connect = socket.getaddrinfo = refuse
module, function = sys.argv[1].split(":")
sys.argv = sys.argv[2:]
try:
    getattr(importlib.import_module(module), function)()
except SystemExit as stop:
    heavy = ("torch", "open3d", "nerfstudio", "numba", "scipy", "skimage", "trimesh", "matplotlib", "cv2")
    print(f"exit {stop.code}, loaded {[name for name in heavy if name in sys.modules]}")
"""


def run_alone(script, *flags):
    environment = {**os.environ, "COLUMNS": "80", "NO_COLOR": "1"}
    command = [sys.executable, "-c", HELP, SCRIPTS[script], script, *map(str, flags)]
    return subprocess.run(command, capture_output=True, text=True, env=environment)


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_explains_every_flag_and_needs_no_heavy_import_and_no_network(script):
    result = run_alone(script, "--help")
    *text, end = result.stdout.splitlines()
    assert end == "exit 0, loaded []", result.stderr
    expect(script, "help", "\n".join(text))
    entries = re.split(r"^  (?=-|[A-Z]{2,} )", "\n".join(text), flags=re.MULTILINE)[1:]
    assert len(entries) > 1
    for entry in entries:
        flag, *rest = re.split(r"\s{2,}|\n", entry, maxsplit=1)
        assert re.search(r"\w+ \w+", re.sub(r"\(default[^)]*\)", "", " ".join(rest))), f"{flag} is not explained"


def configuration(script):
    """The dataclass of a command's flags, and the groups of its help."""
    module = importlib.import_module(SCRIPTS[script].partition(":")[0])
    kinds = ("Config", "Arguments")
    (kind,) = [
        found
        for name, found in vars(module).items()
        if dataclasses.is_dataclass(found) and name.endswith(kinds) and found.__name__ != "SynthConfig"
    ]
    return kind, getattr(module, "_HELP_GROUPS", getattr(module, "_GROUPS", {}))


@pytest.mark.parametrize("script", SCRIPTS)
@pytest.mark.parametrize("columns", [50, 80, 119, 300])
def test_help_is_as_wide_as_the_terminal_with_required_flags_first_and_each_flag_once(script, columns):
    kind, groups = configuration(script)
    text, flags = help_text(kind, script, groups, columns), list(flags_of(kind))
    assert columns - 20 < max(map(len, text.splitlines())) <= columns or columns > 120
    assert max(map(len, text.splitlines())) <= 120
    assert "None" not in text and all(flag.text.count("default:") <= 1 for flag in flags)
    for flag in flags:
        name = flag.words.partition(" ")[0]
        assert len(re.findall(rf"^  {re.escape(name)}\b(?!-)", text, flags=re.MULTILINE)) == 1, name
    order = [re.search(rf"^  {re.escape(f.words.partition(' ')[0])}\b(?!-)", text, re.MULTILINE).start() for f in flags]
    first = [place for place, flag in zip(order, flags, strict=True) if not flag.required]
    assert max(place for place, flag in zip(order, flags, strict=True) if flag.required) < min(first, default=10**6)
    grouped = [name for names in groups.values() for name in names]
    assert len(set(grouped)) == len(grouped)


MISTYPED = {
    "sl-process": "--images captrues --pattern nowhere.json --output o",
    "sl-check": "captrues",
    "sl-export": "--load-config nowhere/config.yml --output m.ply",
    "sl-eval": "--mesh nowhere.ply --data captrues",
    "sl-calibrate": "--images captrues --pattern nowhere.json --output i.json",
    "sl-redecode": "--load-config nowhere/config.yml --output o",
    "sl-capture": "--camera nowhere.mp4 --output o",
    "sl-synth": "--scene nowhere.stl --output o",
}


@pytest.mark.parametrize("script", MISTYPED)
def test_paths_that_lead_nowhere_are_all_named_before_slow_imports(script, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "captures").mkdir()
    words = MISTYPED[script].split()
    wrong = [word for word in words if word.startswith(("captrues", "nowhere"))]
    result = run_alone(script, *words)
    assert result.stdout.strip() == "exit 1, loaded []", result.stderr
    assert all(f" {path}: there is no such file or folder" in result.stderr for path in wrong)
    assert result.stderr.startswith("error: ") and result.stderr.count("remedy: give ") == len(wrong)
    assert ("captures is there" in result.stderr) == ("captrues" in wrong)
    assert [path.name for path in tmp_path.iterdir()] == ["captures"]


def test_a_resolution_is_no_path_that_leads_nowhere(tmp_path):
    main = importlib.import_module("sl_nerfstudio.cli.process").main
    flags = ["--images", tmp_path, "--pattern", "1024x768", "--intrinsics", tmp_path / "i.json", "--output", "o"]
    said = call(main, "sl-process", *flags).err
    assert "--intrinsics" in said and "--pattern" not in said and "--images" not in said
