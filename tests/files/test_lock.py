"""A second process on the same output is refused; what a killed one left blocks nobody."""

import errno
import fcntl
import json
import os
import socket

import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.storage import LOCK, locked, locked_file
from tests.files.holding import another_process, kill

_HOLD = "from sl_nerfstudio.storage import locked\nheld = locked(Path(sys.argv[1]))\nheld.__enter__()"
_HOLD_FILE = _HOLD.replace("locked", "locked_file")


@pytest.fixture
def no_locks(monkeypatch):
    """A file system without locks."""

    def flock(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)


def _note(**changes):
    own = {"command": "sl-x", "process": os.getpid(), "host": socket.gethostname(), "since": "2026-01-01 00:00:00"}
    return json.dumps({"sl-nerfstudio": {**own, **changes}}) + "\n"


def test_a_second_process_is_refused_and_told_which_one_holds_the_folder(tmp_path):
    folder = tmp_path / "ö" / "out"
    with another_process(_HOLD, folder) as other:
        with pytest.raises(UserError) as caught, locked(folder):
            pass
        said = str(caught.value)
        assert said.startswith(
            f"{folder}: is in use by sl-other (process {other.pid} on {socket.gethostname()}, since 2"
        )
        assert "cause:" in said and "remedy: wait until it has ended, or choose another output" in said
        kill(other)
    assert (folder / LOCK).exists()
    with locked(folder):
        (folder / "result").write_text("")
    assert [path.name for path in folder.iterdir()] == ["result"]


def test_a_file_is_held_without_its_folder(tmp_path):
    path = tmp_path / "mesh.ply"
    with another_process(_HOLD_FILE, path) as other:
        with locked(tmp_path), locked_file(tmp_path / "other.ply"):
            pass
        with (
            pytest.raises(UserError, match=rf"mesh.ply: is in use by sl-other \(process {other.pid}"),
            locked_file(path),
        ):
            pass
    with locked_file(path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_the_same_process_cannot_hold_a_folder_twice(tmp_path):
    with locked(tmp_path), pytest.raises(UserError, match=f"is in use by .*process {os.getpid()} "), locked(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_folders_that_were_made_for_nothing_are_removed(tmp_path):
    with pytest.raises(KeyboardInterrupt), locked(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b").is_dir()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["mine", "{}\n", '{"sl-nerfstudio": 3}\n', "[" * 100_000])
def test_a_file_of_the_user_with_the_name_of_a_lock_stays(tmp_path, text):
    (tmp_path / LOCK).write_text(text)
    with pytest.raises(UserError, match="is not a lock of this package"), locked(tmp_path):
        pass
    assert (tmp_path / LOCK).read_text() == text


def test_a_link_is_not_followed(tmp_path):
    (tmp_path / "mine").write_text("")
    (tmp_path / LOCK).symlink_to(tmp_path / "mine")
    with pytest.raises(UserError, match="cannot be written"), locked(tmp_path):
        pass
    assert (tmp_path / "mine").exists()


@pytest.mark.parametrize("path", ["file/x", "/proc/x", "loop/x", "n" * 300, "x/" + "n" * 300])
def test_places_where_nothing_can_be_written(tmp_path, path):
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to("loop")
    for lock in (locked, locked_file):
        for target in (tmp_path / path, tmp_path / path / "y"):
            if lock is locked_file and target.name == "x":
                continue  # a file that could be made
            with pytest.raises(UserError, match="cannot be written"), lock(target):
                pass
    assert {p.name for p in tmp_path.iterdir()} == {"file", "loop"}


def test_without_locks_the_noted_process_decides(no_locks, tmp_path):
    with locked(tmp_path / "new"):
        pass
    assert list(tmp_path.iterdir()) == []
    gone = 4_194_304  # above the largest number that Linux gives
    (tmp_path / LOCK).write_text(_note(process=gone))
    with locked(tmp_path):
        pass
    for note in (_note(process=1), _note(host="elsewhere", process=gone)):
        (tmp_path / LOCK).write_text(note)
        said = rf"is in use by sl-x \(process(.|\n)*if it has ended, remove .*{LOCK}"
        with pytest.raises(UserError, match=said), locked(tmp_path):
            pass
        assert (tmp_path / LOCK).read_text() == note
