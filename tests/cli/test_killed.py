"""What a killed command leaves does not stand in the way of the next one, and two at once are refused."""

import os

import pytest

from sl_nerfstudio.cli import pattern, process, synth
from sl_nerfstudio.cli.export import ExportConfig, export
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.storage import NewFolder, locked, locked_file
from tests.forks import killed_at_change

from .snapshots import call

COMMANDS = {
    "sl-pattern": (pattern.main, ["--width", "120", "--height", "120", "--period", "20"]),
    "sl-pattern gray": (pattern.main, ["--kind", "gray-code", "--width", "16", "--height", "8"]),
    "sl-synth": (synth.main, ["--frames", "2", "--resolution", "16"]),
    "sl-synth images": (synth.main, ["--frames", "2", "--resolution", "16", "--images-only"]),
}
each_command = pytest.mark.parametrize(
    "command", [pytest.param(name, marks=[pytest.mark.slow] * ("synth" in name)) for name in COMMANDS]
)


def run(command, output):
    main, flags = COMMANDS[command]
    return call(main, command.split()[0], "--output", output, *flags)


def content(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@each_command
@pytest.mark.slow
def test_after_a_kill_at_any_moment_the_same_command_succeeds(tmp_path, command):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    run(command, whole)
    assert all(killed_at_change(moment, run, command, broken) for moment in (0, 1, 3, 5, 8))
    assert f"{broken}: removed what " in run(command, broken).err
    assert content(broken) == content(whole)


@each_command
def test_with_a_file_of_the_user_in_it_or_in_use_an_output_is_refused_and_stays(tmp_path, command):
    assert killed_at_change(7, run, command, tmp_path / "new")
    (tmp_path / "new" / "mine").write_text("mine")
    before = content(tmp_path)
    ended = run(command, tmp_path / "new")
    assert ended.status == 1 and "was killed before it had finished, and mine was not listed" in ended.err
    assert "remedy: choose another output, or remove it first" in ended.err and content(tmp_path) == before
    with NewFolder(tmp_path / "held"):
        ended = run(command, tmp_path / "held")
    assert ended.status == 1 and f"(process {os.getpid()} on " in ended.err
    assert list((tmp_path / "held").iterdir()) == []  # made by the one that held it


def test_sl_export_holds_its_outputs_before_it_loads_the_run(tmp_path):
    config = ExportConfig(tmp_path / "missing.yml", tmp_path / "mesh.ply", poses=tmp_path / "poses")
    with locked_file(config.output), pytest.raises(UserError, match=r"mesh\.ply: is in use by"):
        export(config)
    with locked(config.poses), pytest.raises(UserError, match="poses: is in use by"):
        export(config)
    with pytest.raises(UserError, match=r"missing\.yml: no such file"):
        export(config)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("output", [".", "..", "/", "", "/proc/x", "file", "loop", "n" * 300])
def test_outputs_of_sl_process_that_cannot_be(monkeypatch, tmp_path, output):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "loop").symlink_to("loop")
    monkeypatch.chdir(tmp_path)
    flags = ("--images", "x", "--pattern", "x", "--intrinsics", "x", f"--output={output}")
    ended = call(process.main, "sl-process", *flags)
    assert ended.status == 1 and ended.err.startswith("error: ")
    assert {path.name for path in tmp_path.iterdir()} == {"file", "loop"}
