"""What a killed command leaves does not stand in the way of the next one, and two at once are refused."""

import os
import signal
import sys

import pytest

from benchmarks.attacks.dying import dying
from sl_nerfstudio.cli import pattern, process, synth
from sl_nerfstudio.cli.export import ExportConfig, export
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.storage import NewFolder, locked, locked_file

COMMANDS = {
    "sl-pattern": (pattern.main, ["--width", "120", "--height", "120", "--period", "20"]),
    "sl-pattern gray": (pattern.main, ["--kind", "gray-code", "--width", "16", "--height", "8"]),
    "sl-synth": (synth.main, ["--frames", "2", "--resolution", "16"]),
    "sl-synth images": (synth.main, ["--frames", "2", "--resolution", "16", "--images-only"]),
}
each_command = pytest.mark.parametrize("command", COMMANDS)


def run(monkeypatch, command, output):
    main, flags = COMMANDS[command]
    monkeypatch.setattr(sys, "argv", [command.split()[0], "--output", str(output), *flags])
    main()


def killed(monkeypatch, command, output, moment):
    """Run in a copy of this process, killed at a change of the disk; whether it was."""
    with dying(moment):
        child = os.fork()
        if child == 0:
            try:
                run(monkeypatch, command, output)
            finally:
                os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def content(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@each_command
def test_after_a_kill_at_any_moment_the_same_command_succeeds(monkeypatch, tmp_path, capsys, command):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    run(monkeypatch, command, whole)
    assert all(killed(monkeypatch, command, broken, moment) for moment in (0, 1, 3, 5, 8))
    run(monkeypatch, command, broken)
    assert content(broken) == content(whole)
    assert f"{broken}: removed what " in capsys.readouterr().err


@each_command
def test_with_a_file_of_the_user_in_it_the_rest_is_refused_and_stays(monkeypatch, tmp_path, capsys, command):
    assert killed(monkeypatch, command, tmp_path / "new", 7)
    (tmp_path / "new" / "mine").write_text("mine")
    before = content(tmp_path)
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, command, tmp_path / "new")
    said = capsys.readouterr().err
    assert stop.value.code == 1 and "was killed before it had finished, and mine was not listed" in said
    assert "remedy: choose another output, or remove it first" in said and content(tmp_path) == before


@each_command
def test_an_output_in_use_is_refused(monkeypatch, tmp_path, capsys, command):
    with NewFolder(tmp_path / "new"), pytest.raises(SystemExit) as stop:
        run(monkeypatch, command, tmp_path / "new")
    assert stop.value.code == 1 and f"(process {os.getpid()} on " in capsys.readouterr().err
    assert list((tmp_path / "new").iterdir()) == []  # made by the one that held it


def test_sl_export_holds_its_outputs_before_it_loads_the_run(tmp_path):
    config = ExportConfig(tmp_path / "missing.yml", tmp_path / "mesh.ply", poses=tmp_path / "poses")
    with locked_file(config.output), pytest.raises(UserError, match=r"mesh\.ply: is in use by"):
        export(config)
    with locked(config.poses), pytest.raises(UserError, match="poses: is in use by"):
        export(config)
    with pytest.raises(UserError, match=r"missing\.yml: no such file"):
        export(config)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("poses", ["mesh.ply", "mesh.ply/refined"])
def test_mesh_and_poses_of_sl_export_must_not_collide(tmp_path, poses):
    with pytest.raises(UserError, match=r"mesh\.ply: is to be the mesh, and --poses .* a folder there"):
        export(ExportConfig(tmp_path / "missing.yml", tmp_path / "mesh.ply", poses=tmp_path / poses))


@pytest.mark.parametrize("output", [".", "..", "/", "", "/proc/x", "file", "loop", "n" * 300])
def test_outputs_of_sl_process_that_cannot_be(monkeypatch, tmp_path, capsys, output):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "loop").symlink_to("loop")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sl-process", "--images", "x", "--pattern", "x", "--intrinsics", "x",
                                      f"--output={output}"])  # fmt: skip
    with pytest.raises(SystemExit) as stop:
        process.main()
    assert stop.value.code == 1 and capsys.readouterr().err.startswith("error: ")
    assert {path.name for path in tmp_path.iterdir()} == {"file", "loop"}
