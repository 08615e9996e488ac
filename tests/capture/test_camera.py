"""Images of cameras and of videos in their place."""

import time

import cv2
import numpy as np
import pytest

from sl_nerfstudio.capture import camera as module
from sl_nerfstudio.capture.camera import Camera, Video, open_camera
from sl_nerfstudio.errors import UserError
from tests.capture.fake_camera import FakeCapture

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


def test_settings_reach_the_camera(monkeypatch):
    capture = plug_in(monkeypatch, FakeCapture(lambda: RED))
    camera = Camera(0, (80, 60), exposure=-6.0, focus=30.0)
    assert camera.size == (80, 60) and camera.after(-1.0)[1][0, 0].tolist() == [200, 10, 10]
    camera.close()
    assert capture.settings[cv2.CAP_PROP_AUTOFOCUS] == 0 and capture.settings[cv2.CAP_PROP_FOCUS] == 30
    assert capture.settings[cv2.CAP_PROP_EXPOSURE] == -6 and not capture.open


@pytest.mark.parametrize(
    ("capture", "settings", "message"),
    [
        (FakeCapture(lambda: None), {}, "--camera 0: gives no image"),
        (FakeCapture(lambda: RED, sizes=False), {"size": (80, 60)}, "--size 80x60: camera 0 gives images of 64 x 48"),
        (
            FakeCapture(lambda: RED, [cv2.CAP_PROP_EXPOSURE]),
            {"exposure": 3.0},
            "--exposure 3: camera 0 does not accept",
        ),
        (FakeCapture(lambda: RED, [cv2.CAP_PROP_FOCUS]), {"focus": 3.0}, "--focus 3: camera 0 does not accept it"),
    ],
)
def test_what_a_camera_refuses(monkeypatch, capture, settings, message):
    plug_in(monkeypatch, capture)
    with pytest.raises(UserError, match=message):
        Camera(0, **{"size": None, **settings})
    assert not capture.open


def test_a_camera_that_is_unplugged(monkeypatch):
    images = iter([RED, RED])
    plug_in(monkeypatch, FakeCapture(lambda: next(images, None)))
    camera = Camera(0, None)
    with pytest.raises(UserError, match="camera 0 gives no more images"):
        for _ in camera.frames(1000.0):
            pass
    camera.close()
