"""Images of cameras and of videos in their place."""

import json
import shutil
import time

import cv2
import numpy as np
import pytest

from sl_nerfstudio.capture import camera as module
from sl_nerfstudio.capture.camera import Camera, CaptureFolder, Video, open_camera
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.scan.images import read_image
from tests.capture.fake_camera import FakeCapture
from tests.forks import killed_at_change

RED = np.zeros((48, 64, 3), dtype=np.uint8) + np.array([200, 10, 10], dtype=np.uint8)


def plug_in(monkeypatch, capture):
    monkeypatch.setattr(module.cv2, "VideoCapture", lambda number: capture)
    return capture


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Ten images a second; image k has red 20 k."""
    path = tmp_path_factory.mktemp("video") / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for k in range(11):
        writer.write(np.full((48, 64, 3), (0, 0, 20 * k), dtype=np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize(
    ("rate", "images"), [(10.0, range(11)), (100.0, range(11)), (5.0, range(0, 11, 2)), (0.1, [0])]
)
def test_videos_give_so_many_images_a_second(video, rate, images):
    source = open_camera(str(video))
    assert isinstance(source, Video) and source.size == (64, 48)
    found = list(source.frames(rate))
    source.close()
    assert [round(image[..., 0].mean() / 20) for _, image in found] == list(images)  # red comes first
    assert [seconds for seconds, _ in found] == pytest.approx([k / 10 for k in images])


def test_videos_that_cannot_be_read(tmp_path):
    (tmp_path / "notes.mp4").write_text("not a video")
    for text, message in (("nowhere.mp4", "there is no such file"), (str(tmp_path / "notes.mp4"), "is no video")):
        with pytest.raises(UserError, match=message):
            open_camera(text)
    with pytest.raises(UserError, match="--focus: has no meaning for the video file clip"):
        open_camera("clip", focus=3.0)


def test_a_camera_gives_its_newest_image(monkeypatch):
    taken = []

    def take():
        taken.append(len(taken) % 251)
        return np.full((4, 4, 3), taken[-1], dtype=np.uint8)

    plug_in(monkeypatch, FakeCapture(take))
    camera = open_camera("0")
    assert next(iter(camera.frames(1000.0)))[1].shape == (4, 4, 3)
    while len(taken) < 20:
        time.sleep(0.001)
    before, moment = len(taken), time.monotonic()
    seconds, image = camera.after(moment)
    camera.close()
    assert seconds > moment and image[0, 0, 0] in taken[before:]


def test_settings_reach_the_camera_and_an_unplugged_one_is_noticed(monkeypatch):
    capture = plug_in(monkeypatch, FakeCapture(lambda: RED))
    camera = Camera(0, (80, 60), exposure=-6.0, focus=30.0)
    assert camera.size == (80, 60) and camera.after(-1.0)[1][0, 0].tolist() == [200, 10, 10]
    capture.take = lambda: None
    with pytest.raises(UserError, match="camera 0 gives no more images"):
        for _ in camera.frames(1000.0):
            pass
    camera.close()
    assert capture.settings[cv2.CAP_PROP_AUTOFOCUS] == 0 and capture.settings[cv2.CAP_PROP_FOCUS] == 30
    assert capture.settings[cv2.CAP_PROP_EXPOSURE] == -6 and not capture.open


@pytest.mark.parametrize(
    ("capture", "settings", "message"),
    [
        (FakeCapture(lambda: None), {}, "--camera 0: gives no image"),
        (FakeCapture(lambda: RED, sizes=False), {"size": (80, 60)}, "--size 80x60: camera 0 gives images of 64 x 48"),
        (FakeCapture(lambda: RED, [cv2.CAP_PROP_EXPOSURE]), {"exposure": 3.0}, "--exposure 3: camera 0 does not acc"),
        (FakeCapture(lambda: RED, [cv2.CAP_PROP_FOCUS]), {"focus": 3.0}, "--focus 3: camera 0 does not accept it"),
    ],
)
def test_what_a_camera_refuses(monkeypatch, capture, settings, message):
    plug_in(monkeypatch, capture)
    with pytest.raises(UserError, match=message):
        Camera(0, **{"size": None, **settings})
    assert not capture.open


# The folder of captures: numbered on, nothing overwritten, one pattern and one image size.


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
        (root / "frame_9999.png").write_bytes((root / "frame_0001.png").read_bytes())
        assert captures.add(IMAGE).name == "frame_10000.png"
        numbers = [path.stem[6:] for path in captures.frames]
        assert numbers == ["0001", "0002", "9999", "10000"]
    assert names(root) == ["capture.json", *sorted(f"frame_{number}.png" for number in numbers)]
    assert np.array_equal(read_image(root / "frame_0002.png"), 255 - IMAGE)


def test_a_sequence_appears_complete_or_not_at_all(tmp_path, monkeypatch):
    with folder(tmp_path) as captures:
        captures.add_sequence([IMAGE, 255 - IMAGE])
        written = iter([b"some bytes"])  # and then the disk is full
        monkeypatch.setattr(module, "encode_png", lambda _: next(written))
        with pytest.raises(StopIteration):
            captures.add_sequence([IMAGE, IMAGE])
        assert [path.name for path in captures.frames] == ["frame_0000"]
    monkeypatch.undo()
    with folder(tmp_path) as captures:
        assert captures.add_sequence([IMAGE]).name == "frame_0001"
    assert names(tmp_path) == ["capture.json", "frame_0000", "frame_0001"]
    assert names(tmp_path / "frame_0000") == ["00.png", "01.png"] and names(tmp_path / "frame_0001") == ["00.png"]
    assert np.array_equal(read_image(tmp_path / "frame_0000" / "01.png"), 255 - IMAGE)


def capture_twice(path):
    with folder(path) as captures:
        captures.add(IMAGE)
        captures.add_sequence([IMAGE, 255 - IMAGE])


@pytest.mark.slow
def test_what_a_killed_command_leaves_is_complete_and_is_continued(tmp_path):
    for moment in range(40):
        was_killed = killed_at_change(moment, capture_twice, tmp_path)
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
        with pytest.raises(UserError, match="is in use"):
            folder(tmp_path)
    before = names(tmp_path)
    with pytest.raises(UserError, match=message):
        folder(tmp_path, **change)
    assert names(tmp_path) == before
    with folder(tmp_path):
        pass  # it is not left locked


def test_a_folder_without_a_frame_is_removed_and_files_of_the_user_are_left_alone(tmp_path):
    with folder(tmp_path / "new"):
        assert json.loads((tmp_path / "new" / "capture.json").read_text())["w"] == 8
    assert not (tmp_path / "new").exists()
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="is not empty"):
        folder(tmp_path)
    assert names(tmp_path) == ["notes.txt"]
