"""The help of every command: its words, and that it needs neither slow imports nor a network."""

import os
import re
import subprocess
import sys

import pytest

from tests.test_package import SCRIPTS

from .snapshots import expect

# Runs a command's `main` with --help and says which slow modules that loaded. Sockets raise.
HELP = """
import importlib, socket, sys
def refuse(*a, **k): raise RuntimeError("a help text reached for the network")
socket.socket.connect = socket.getaddrinfo = refuse
module, function = sys.argv[1].split(":")
sys.argv = [sys.argv[2], "--help"]
try:
    getattr(importlib.import_module(module), function)()
except SystemExit as stop:
    heavy = ("torch", "open3d", "nerfstudio", "numba", "scipy", "skimage", "trimesh", "matplotlib")
    print(f"exit {stop.code}, loaded {[name for name in heavy if name in sys.modules]}")
"""


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_explains_every_flag_and_needs_no_heavy_import_and_no_network(script):
    environment = {**os.environ, "COLUMNS": "120", "NO_COLOR": "1"}
    command = [sys.executable, "-c", HELP, SCRIPTS[script], script]
    result = subprocess.run(command, capture_output=True, text=True, env=environment)
    *text, end = result.stdout.splitlines()
    assert end == "exit 0, loaded []", result.stderr
    expect(script, "help", "\n".join(text))
    entries = re.split(r"^│ (?=-|[A-Z]{2,}\b)", "\n".join(text).replace("│\n", "\n"), flags=re.MULTILINE)[1:]
    assert len(entries) > 1
    for entry in entries:  # words besides its name, its type and its default
        flag, *rest = re.split(r"\s{2,}|\n", entry, maxsplit=1)
        explanation = re.sub(r"\((default|required|optional|repeatable)[^)]*\)|[│╰─╯╮╭]", "", " ".join(rest))
        assert re.search(r"\w+ \w+", explanation), f"{flag} is not explained"
