"""Files appear complete or not at all."""

import errno
import os
import resource
from pathlib import Path

import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.storage import PARTIAL, beside, remove_partial, write_atomic
from tests.files.holding import another_process


def files(root):
    return {str(p.relative_to(root)) for p in root.rglob("*") if p.is_file()}


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")

    def full(self: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(UserError) as error:
        write_atomic(path, b"new")
    assert str(error.value) == (
        f"{path}: cannot be written (No space left on device)\n"
        "    cause:  the disk is full, the folder is read-only, or there is a file where a folder is needed\n"
        "    remedy: free some space, or choose another output"
    )
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_where_a_folder_is_needed(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("x")
    with pytest.raises(UserError, match="cannot be written"):
        write_atomic(tmp_path / "a" / "b" / "c.json", b"")


def test_write_atomic_replaces_and_makes_folders(tmp_path: Path) -> None:
    write_atomic(tmp_path / "a" / "b.txt", b"1")
    write_atomic(tmp_path / "a" / "b.txt", b"2")
    assert files(tmp_path) == {"a/b.txt"}
    assert (tmp_path / "a" / "b.txt").read_bytes() == b"2"


def test_a_real_full_disk_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(UserError, match="cannot be written"):
            write_atomic(path, bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_text() == "old" and files(tmp_path) == {"a"}


def test_an_interrupt_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(self: Path, target: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_atomic(tmp_path / "a", b"new")
    assert files(tmp_path) == set()


def test_what_a_killed_process_left_is_replaced(tmp_path: Path) -> None:
    beside(tmp_path / "a", PARTIAL).write_bytes(bytes(1000))
    write_atomic(tmp_path / "a", b"new")
    assert files(tmp_path) == {"a"} and (tmp_path / "a").read_bytes() == b"new"
    beside(tmp_path / "x", PARTIAL).write_text("half")
    (tmp_path / ".rsync.partial").write_text("of another program")
    remove_partial(tmp_path)
    remove_partial(tmp_path / "nowhere")
    assert files(tmp_path) == {"a", ".rsync.partial"}


def test_two_processes_do_not_write_into_the_same_file(tmp_path: Path) -> None:
    hold = "from sl_nerfstudio.storage import open_alone\nopen_alone(Path(sys.argv[1]))"
    with (
        another_process(hold, beside(tmp_path / "a", PARTIAL)),
        pytest.raises(UserError, match="a: is in use by another process"),
    ):
        write_atomic(tmp_path / "a", b"new")


def test_many_processes_that_write_one_file_never_leave_half_of_it(tmp_path: Path) -> None:
    children = []
    for k in range(6):
        child = os.fork()
        if child == 0:
            for _ in range(100):
                try:
                    write_atomic(tmp_path / "a", bytes([k]) * 20_000)
                except UserError as error:
                    if "is in use" not in str(error):
                        os._exit(1)
            os._exit(0)
        children.append(child)
    running = set(children)
    while running:
        done, status = os.waitpid(-1, os.WNOHANG)
        running -= {done}
        assert done == 0 or status == 0
        if (tmp_path / "a").exists():
            content = (tmp_path / "a").read_bytes()
            assert len(content) == 20_000 and len(set(content)) == 1
    assert files(tmp_path) == {"a"}


def test_names_may_be_as_long_as_the_system_allows(tmp_path: Path) -> None:
    write_atomic(tmp_path / ("n" * 255), b"")
    with pytest.raises(UserError, match="cannot be written"):
        write_atomic(tmp_path / ("n" * 256), b"")
    assert files(tmp_path) == {"n" * 255}
