"""The folder of captures: numbered on, nothing overwritten, one pattern and one image size."""

import json
import os
import shutil
import signal

import numpy as np
import pytest

from benchmarks.attacks.dying import dying
from sl_nerfstudio.capture.camera import CaptureFolder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.scan.images import read_image

PATTERN = GrayCode(64, 32, 8)
IMAGE = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)


def folder(root, pattern=PATTERN, size=(8, 6)):
    return CaptureFolder(root, pattern, size)


def names(root):
    return sorted(path.name for path in root.iterdir())


def test_frames_are_numbered_on_and_exact(tmp_path):
    root = tmp_path / "a" / "captures"
    with folder(root) as captures:
        assert captures.add(IMAGE) == root / "frame_0000.png"
        captures.add(IMAGE)
    (root / "frame_0000.png").unlink()  # the user does not want it
    with folder(root) as captures:
        assert captures.frames == [root / "frame_0001.png"]
        assert captures.add(255 - IMAGE).name == "frame_0002.png"
    assert names(root) == ["capture.json", "frame_0001.png", "frame_0002.png"]
    assert np.array_equal(read_image(root / "frame_0002.png"), 255 - IMAGE)


def test_frames_are_in_the_order_of_their_numbers(tmp_path):
    with folder(tmp_path) as captures:
        captures.add(IMAGE)
        (tmp_path / "frame_9999.png").write_bytes((tmp_path / "frame_0000.png").read_bytes())
        assert captures.add(IMAGE).name == "frame_10000.png"
        assert [path.name for path in captures.frames] == ["frame_0000.png", "frame_9999.png", "frame_10000.png"]


def test_a_sequence_appears_complete_or_not_at_all(tmp_path, monkeypatch):
    with folder(tmp_path) as captures:
        captures.add_sequence([IMAGE, 255 - IMAGE])
        monkeypatch.setattr("sl_nerfstudio.capture.camera.encode_png", _full_disk_at_the_second())
        with pytest.raises(OSError, match="full"):
            captures.add_sequence([IMAGE, IMAGE])
        assert [path.name for path in captures.frames] == ["frame_0000"]
    monkeypatch.undo()
    with folder(tmp_path) as captures:
        assert captures.add_sequence([IMAGE]).name == "frame_0001"
    assert names(tmp_path) == ["capture.json", "frame_0000", "frame_0001"]
    assert names(tmp_path / "frame_0000") == ["00.png", "01.png"] and names(tmp_path / "frame_0001") == ["00.png"]
    assert np.array_equal(read_image(tmp_path / "frame_0000" / "01.png"), 255 - IMAGE)


def _full_disk_at_the_second():
    calls = []

    def encode(image):
        calls.append(image)
        if len(calls) == 2:
            raise OSError("the disk is full")
        return b"some bytes"

    return encode


def test_what_a_killed_command_leaves_is_complete_and_is_continued(tmp_path):
    for moment in range(40):
        with dying(moment):
            child = os.fork()
            if child == 0:
                try:
                    with folder(tmp_path) as captures:
                        captures.add(IMAGE)
                        captures.add_sequence([IMAGE, 255 - IMAGE])
                finally:
                    os._exit(0)
        was_killed = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        with folder(tmp_path) as captures:
            for path in captures.frames:
                files = [path] if path.suffix else sorted(path.iterdir())
                assert len(files) == (1 if path.suffix else 2)
                assert all(read_image(file).shape == IMAGE.shape for file in files)
            frames = [path.name for path in captures.frames]
            assert set(names(tmp_path)) == {"capture.json", ".sl-lock", *frames}
        if not was_killed:
            break
        shutil.rmtree(tmp_path, ignore_errors=True)
    assert moment > 8 and not was_killed and frames == ["frame_0000.png", "frame_0001"]


def test_a_folder_without_a_frame_is_removed(tmp_path):
    with folder(tmp_path / "new"):
        assert json.loads((tmp_path / "new" / "capture.json").read_text())["w"] == 8
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": (8, 7)}, "was begun with another image height"),
        ({"size": (9, 6)}, "was begun with another image width"),
        ({"pattern": None}, "was begun with another pattern"),
        ({"pattern": GrayCode(64, 32, 4)}, "was begun with another pattern"),
    ],
)
def test_other_captures_do_not_get_into_a_folder(tmp_path, change, message):
    with folder(tmp_path) as captures:
        captures.add(IMAGE)
    before = names(tmp_path)
    with pytest.raises(UserError, match=message):
        folder(tmp_path, **change)
    assert names(tmp_path) == before
    with folder(tmp_path):
        pass  # it is not left locked


def test_files_of_the_user_are_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="is not empty"):
        folder(tmp_path)
    assert names(tmp_path) == ["notes.txt"]


def test_a_folder_has_one_process(tmp_path):
    with folder(tmp_path) as captures:
        captures.add(IMAGE)
        with pytest.raises(UserError, match="is in use"):
            folder(tmp_path)
