"""Outputs appear complete or not at all, belong to one process alone, and survive kills; large arrays go to a file."""

import errno
import fcntl
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.storage import (
    LOCK,
    PARTIAL,
    GrowingArray,
    Holder,
    NewFolder,
    beside,
    files_below,
    held_by_another,
    in_file,
    locked,
    locked_file,
    remove_partial,
    write_atomic,
)
from tests.forks import exit_status, fork, killed_at_change


@contextmanager
def another_process(code: str, *arguments: str | Path) -> Iterator[subprocess.Popen]:
    """A process that runs `code` with `sys` and `Path` until it prints `ready`, and then waits; killed afterwards."""
    begin = "import sys\nfrom pathlib import Path\nsys.argv[0] = 'sl-other'\n"
    code = f"{begin}{code}\nprint('ready', flush=True); sys.stdin.read()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
    )
    with process:
        assert process.stdout.readline() == "ready\n"
        try:
            yield process
        finally:
            process.send_signal(signal.SIGKILL)


def kill(process: subprocess.Popen) -> None:
    """As the kernel does when memory is short."""
    process.send_signal(signal.SIGKILL)
    process.wait()


def files(root):
    return {str(p.relative_to(root)) for p in root.rglob("*") if p.is_file()}


@contextmanager
def full_after(most: int) -> Iterator[None]:
    """A disk on which files may have so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


# Files that appear complete or not at all.


def test_files_are_replaced_and_their_folders_made(tmp_path: Path) -> None:
    for content in (b"1", b"2"):
        write_atomic(tmp_path / "a" / ("n" * 255), content)  # as long as the system allows
    assert files(tmp_path) == {"a/" + "n" * 255} and (tmp_path / "a" / ("n" * 255)).read_bytes() == b"2"
    (tmp_path / "file").write_text("in the way")
    for path in ("n" * 256, "file/b/c.json"):
        with pytest.raises(UserError, match=r"cannot be written(.|\n)*cause(.|\n)*remedy: free some space"):
            write_atomic(tmp_path / path, b"")
    assert files(tmp_path) == {"a/" + "n" * 255, "file"}


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_an_error_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    (tmp_path / "a").write_text("old")
    with full_after(1000), pytest.raises(UserError, match="cannot be written"):
        write_atomic(tmp_path / "a", bytes(5000))

    def fail(self: Path, target: Path) -> None:
        raise error

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(UserError if isinstance(error, OSError) else KeyboardInterrupt):
        write_atomic(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_text() == "old" and files(tmp_path) == {"a"}


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


def write_often(path: Path, number: int) -> None:
    for _ in range(40):
        try:
            write_atomic(path, bytes([number]) * 20_000)
        except UserError as error:
            if "is in use" not in str(error):
                raise


def test_many_processes_that_write_one_file_never_leave_half_of_it(tmp_path: Path) -> None:
    processes = [fork(write_often, tmp_path / "a", k) for k in range(4)]
    while any(process.is_alive() for process in processes):
        if (tmp_path / "a").exists():
            content = (tmp_path / "a").read_bytes()
            assert len(content) == 20_000 and len(set(content)) == 1
    assert all(exit_status(process) == 0 for process in processes)
    assert files(tmp_path) == {"a"}


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


_FILL = """
from sl_nerfstudio.storage import NewFolder
folder = NewFolder(Path(sys.argv[1]))
for path in sys.argv[2:]:
    folder.write(path, b"old")
"""


def _leave(root, *paths):
    """What a process leaves that is killed after it wrote some files."""
    with another_process(_FILL, root, *paths) as other:
        kill(other)


def test_a_folder_is_complete_after_the_block_and_not_there_after_an_exception(tmp_path):
    with NewFolder(tmp_path / "a" / "new") as folder:
        folder.write("inner/ä.txt", b"1")
        folder.write("last", b"2", last=True)
        assert LOCK in files(tmp_path / "a" / "new")
        for path in ("../x", "/tmp/x", "a/../../x", "", "a\0b"):
            with pytest.raises(ValueError, match="leaves the folder"):
                folder.write(path, b"")
    assert files(tmp_path) == {"a/new/inner/ä.txt", "a/new/last"}
    with pytest.raises(KeyboardInterrupt), locked(tmp_path / "b" / "c"), NewFolder(tmp_path / "d" / "new") as folder:
        folder.write("inner/x", b"1")
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["a"]  # folders that were made for nothing are gone, too
    for most in (10, 100, 200, 300, 1000):
        with (
            full_after(most),
            pytest.raises(UserError, match="cannot be written"),
            NewFolder(tmp_path / "new") as folder,
        ):
            for number in range(100):
                folder.write(f"inner/{number}", b"short")
        assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_what_a_killed_process_left_is_removed_and_named(tmp_path, capsys):
    root = tmp_path / "new"
    _leave(root, "inner/ä", "b")
    beside(root / "inner" / "ä", PARTIAL).write_text("half")
    with NewFolder(root) as folder:
        assert files(root) == {LOCK} and list(root.iterdir()) == [root / LOCK]
        folder.write("c", b"new", last=True)
    assert files(root) == {"c"}
    assert capsys.readouterr().err.startswith(f"{root}: removed what sl-other (process ")
    _leave(tmp_path / "empty")  # one that wrote nothing leaves nothing to say
    with NewFolder(tmp_path / "empty"):
        pass
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("mine", ["mine", "inner/mine", "empty/", "link"])
def test_with_anything_of_the_user_in_it_all_stays(tmp_path, mine):
    root = tmp_path / "new"
    _leave(root, "inner/a")
    if mine == "link":
        (root / mine).symlink_to(tmp_path, target_is_directory=True)
    elif mine.endswith("/"):
        (root / mine).mkdir()
    else:
        (root / mine).write_text("mine")
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    for _ in range(2):
        with pytest.raises(UserError, match=r"is not empty\n.*sl-other .* was killed before it had finished, and "):
            NewFolder(root)
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before


def test_a_folder_in_use_is_refused_and_a_complete_one_is_not_taken_for_left_over(tmp_path):
    root = tmp_path / "busy"
    with another_process(_FILL, root, "a") as other:
        for take in (NewFolder, lambda path: locked(path).__enter__()):
            with pytest.raises(UserError, match=rf"is in use by sl-other \(process {other.pid}"):
                take(root)
        kill(other)
        with pytest.raises(UserError, match=r"is not finished\n.*was killed.*\n.*run that command again"), locked(root):
            pass
    assert files(root) == {LOCK, "a"}
    root = tmp_path / "new"
    with another_process(_FILL + "folder.write('last', b'1', last=True)", root, "a") as other:
        kill(other)
    with pytest.raises(UserError, match="is not empty"):
        NewFolder(root)
    assert files(root) == {LOCK, "a", "last"}


def test_earlier_results_and_files_are_refused_untouched(tmp_path):
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "scan").write_text("x")
    with pytest.raises(UserError, match=r"old: is not empty\n.*it holds an earlier result"):
        NewFolder(tmp_path / "old")
    with pytest.raises(UserError, match="scan: is a file"):
        NewFolder(tmp_path / "old" / "scan")
    assert files(tmp_path) == {"old/scan"}


@given(
    st.lists(
        st.sampled_from(["../mine", "..", "mine", "/etc/hostname", "sub/../../mine", ".", ""])
        | st.text()
        | st.integers()
    )
)
def test_a_list_from_elsewhere_reaches_nothing_outside(tmp_path_factory, paths):
    tmp = tmp_path_factory.mktemp("list")
    (tmp / "mine").write_text("mine")
    (tmp / "new").mkdir()
    (tmp / "new" / LOCK).write_bytes(Holder.here().note() + b"".join(json.dumps(p).encode() + b"\n" for p in paths))
    with NewFolder(tmp / "new") as folder:
        folder.write("a", b"")
    assert (tmp / "mine").read_text() == "mine" and os.listdir(tmp / "new") == ["a"]


@pytest.mark.parametrize("most", [0, 100, 10**6])
def test_the_whole_is_what_was_added(most, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    rng, grown = np.random.default_rng(0), GrowingArray(most)
    pieces = [rng.random((n, 2)).astype(np.float32) for n in (5, 0, 30, 1)]
    for piece in pieces:
        grown.append(piece[:, ::-1])
    whole = grown.whole()
    assert whole.dtype == np.float32 and isinstance(whole, np.memmap) == (most < 288)
    np.testing.assert_array_equal(whole, np.concatenate(pieces)[:, ::-1])
    whole[0] = 7  # as an array in memory
    assert not list(tmp_path.iterdir())  # the file has no name that could stay behind


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read from /proc")
def test_pieces_that_went_to_a_file_take_no_memory(tmp_path, monkeypatch):
    """Else freed memory would stay with the process, where the file's pages should be."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def own() -> int:
        status = Path("/proc/self/status").read_text()
        return int(status.split("RssAnon:")[1].split()[0]) // 1024

    before, grown = own(), GrowingArray(200 << 20)
    for k in range(200):
        grown.append(np.full(1 << 17, float(k)))  # a megabyte each, as small as arrays that the C library keeps
    assert own() > before + 150
    grown.append(np.zeros(1 << 17))
    assert own() < before + 50
    assert grown.whole()[5 << 17] == 5


def test_arrays_in_a_file_are_the_same_arrays(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    rng = np.random.default_rng(0)
    arrays = [rng.random((5, 3))[:, ::2], np.zeros((0, 2)), rng.random(7) > 0.5, np.float32([[1, np.nan]]), np.eye(4)]
    found = in_file(arrays)
    for array, same in zip(arrays, found, strict=True):
        assert same.dtype == array.dtype and same.shape == array.shape
        np.testing.assert_array_equal(same, array)
    found[-1][0, 0] = 7  # as an array in memory
    assert found[-1].sum() == 10 and not list(tmp_path.iterdir())
    assert in_file([]) == [] and in_file([np.zeros(0)])[0].shape == (0,)


@pytest.mark.parametrize("write", [GrowingArray(0).append, lambda array: in_file([array])])
def test_no_place_for_a_temporary_file_is_a_fault_of_the_user(monkeypatch, write):
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null/nowhere")
    with pytest.raises(UserError, match=r"temporary file.*\n.*\n.*TMPDIR"):
        write(np.zeros(3))


def fill_two(root: Path) -> None:
    with NewFolder(root) as folder:
        folder.write("inner/first", b"1")
        folder.write("last", b"2", last=True)


def test_a_folder_that_was_not_finished_is_filled_again_whenever_its_process_was_killed(tmp_path):
    """Also while the last file, which is never removed, was written."""
    moments = 0
    while killed_at_change(moments, fill_two, tmp_path / str(moments)):
        root = tmp_path / str(moments)
        if not (root / "last").exists():
            fill_two(root)
        assert files_below(root) == ["inner/first", "last"]
        moments += 1
    assert moments > 5


def test_an_earlier_result_stays_until_the_first_new_file_and_with_anything_else_in_it_for_good(tmp_path):
    root, old = tmp_path / "scan", ["a/x", "t"]
    with NewFolder(root) as folder:
        for name in old:
            folder.write(name, b"1", last=name == "t")
    with pytest.raises(ZeroDivisionError), NewFolder(root, old):
        raise ZeroDivisionError
    assert files_below(root) == old
    (root / "mine").touch()
    with pytest.raises(UserError, match="is not empty"):
        NewFolder(root, old)
    (root / "mine").unlink()
    with NewFolder(root, old) as folder:
        assert files_below(root) == old and held_by_another(root)
        folder.write("b", b"2")
        assert files_below(root) == ["b"]
        folder.write("t", b"2", last=True)
    assert files_below(root) == ["b", "t"] == sorted(folder.digests) and not held_by_another(root)
