"""A new folder is complete or not there; what a killed process left of one is removed, and nothing else."""

import json
import os
import resource

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.storage import LOCK, PARTIAL, Holder, NewFolder, beside, locked
from tests.files.holding import another_process, kill

_FILL = """
from sl_nerfstudio.storage import NewFolder
folder = NewFolder(Path(sys.argv[1]))
for path in sys.argv[2:]:
    folder.write(path, b"old")
"""


def files(root):
    return {str(p.relative_to(root)) for p in root.rglob("*") if p.is_file()}


def _leave(root, *paths):
    """What a process leaves that is killed after it wrote some files."""
    with another_process(_FILL, root, *paths) as other:
        kill(other)


def test_files_are_there_after_the_block_and_the_lock_is_gone(tmp_path):
    with NewFolder(tmp_path / "a" / "new") as folder:
        folder.write("inner/ä.txt", b"1")
        folder.write("last", b"2", last=True)
        assert LOCK in files(tmp_path / "a" / "new")
    assert files(tmp_path) == {"a/new/inner/ä.txt", "a/new/last"}


def test_after_an_exception_nothing_is_left(tmp_path):
    with pytest.raises(KeyboardInterrupt), NewFolder(tmp_path / "a" / "new") as folder:
        folder.write("inner/x", b"1")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_removed_and_named(tmp_path, capsys):
    root = tmp_path / "new"
    _leave(root, "inner/ä", "b")
    beside(root / "inner" / "ä", PARTIAL).write_text("half")
    with NewFolder(root) as folder:
        assert files(root) == {LOCK} and list(root.iterdir()) == [root / LOCK]
        folder.write("c", b"new", last=True)
    assert files(root) == {"c"}
    assert capsys.readouterr().err.startswith(f"{root}: removed what sl-other (process ")


def test_a_killed_process_that_wrote_nothing_leaves_nothing_to_say(tmp_path, capsys):
    _leave(tmp_path / "new")
    with NewFolder(tmp_path / "new"):
        pass
    assert capsys.readouterr().err == "" and files(tmp_path) == set()


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


def test_a_complete_folder_is_not_taken_for_left_over(tmp_path):
    root = tmp_path / "new"
    with another_process(_FILL + "folder.write('last', b'1', last=True)", root, "a") as other:
        kill(other)
    with pytest.raises(UserError, match="is not empty"):
        NewFolder(root)
    assert files(root) == {LOCK, "a", "last"}


def test_a_second_process_is_refused(tmp_path):
    root = tmp_path / "new"
    with another_process(_FILL, root, "a") as other:
        for take in (NewFolder, lambda path: locked(path).__enter__()):
            with pytest.raises(UserError, match=rf"is in use by sl-other \(process {other.pid}"):
                take(root)
        kill(other)
        with pytest.raises(UserError, match=r"is not finished\n.*was killed.*\n.*run that command again"), locked(root):
            pass
    assert files(root) == {LOCK, "a"}


def test_earlier_results_and_files_are_refused_untouched(tmp_path):
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "scan").write_text("x")
    with pytest.raises(UserError, match=r"old: is not empty\n.*it holds an earlier result"):
        NewFolder(tmp_path / "old")
    with pytest.raises(UserError, match="scan: is a file"):
        NewFolder(tmp_path / "old" / "scan")
    assert files(tmp_path) == {"old/scan"}


@pytest.mark.parametrize("path", ["../x", "/tmp/x", "a/../../x", "", "a\0b"])
def test_files_may_not_leave_the_folder(tmp_path, path):
    with NewFolder(tmp_path / "new") as folder, pytest.raises(ValueError, match="leaves the folder"):
        folder.write(path, b"")


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


def test_on_a_full_disk_nothing_is_left(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for most in (10, 100, 200, 300, 1000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
        try:
            with pytest.raises(UserError, match="cannot be written"), NewFolder(tmp_path / "new") as folder:
                for k in range(100):
                    folder.write(f"inner/{k}", b"short")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert list(tmp_path.iterdir()) == []
