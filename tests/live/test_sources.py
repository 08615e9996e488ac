"""Sources of images: folders that fill up, videos that go on, and what is not there."""

import cv2
import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.live.sources import CameraSource, FolderSource, open_source
from sl_nerfstudio.scan.images import encode_png


def image(value: int) -> bytes:
    return encode_png(np.full((6, 8, 3), value, dtype=np.uint8))


def test_images_of_a_folder_come_when_they_are_complete_and_once(tmp_path):
    (tmp_path / "b.png").write_bytes(image(1))
    half = image(2)
    steps = iter([
        lambda: None,
        lambda: (tmp_path / "a.png").write_bytes(half[:30]),
        lambda: (tmp_path / "a.png").write_bytes(half),
        lambda: (tmp_path / "notes.txt").write_text("no image"),
    ])  # fmt: skip

    def wait(_: float) -> None:
        next(steps, lambda: None)()

    source = FolderSource(tmp_path, quiet_s=3.0, wait=wait)
    shots = [shot for shot in source.shots([]) if shot is not None]
    assert [(shot.name, int(shot.image[0, 0, 0])) for shot in shots] == [("b.png", 1), ("a.png", 2)]
    assert [s.name for s in FolderSource(tmp_path, 2.0, lambda _: None).shots(["b.png"]) if s] == ["a.png"]
    assert source.size == (8, 6)


def test_a_video_goes_on_after_the_images_that_were_seen(tmp_path):
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 2.0, (64, 48))
    for k in range(5):
        writer.write(np.full((48, 64, 3), 40 * k, dtype=np.uint8))
    writer.release()
    source = open_source(str(path))
    assert isinstance(source, CameraSource) and source.size == (64, 48)
    shots = [shot for shot in source.shots(["image 0", "image 1"]) if shot is not None]
    source.close()
    assert [shot.name for shot in shots] == ["image 2", "image 3", "image 4"]
    assert [round(float(shot.image.mean()) / 40) for shot in shots] == [2, 3, 4]


@pytest.mark.parametrize("ask, said", [
    (lambda root: FolderSource(root, 1.0, lambda _: None).size,
     r"no image has come\n(.|\n)*remedy: let the camera save its pictures there"),
    (lambda root: list(FolderSource(root / "gone", 1.0, lambda _: None).shots([])),
     r"gone: cannot be read(.|\n)*remedy: give a folder that stays"),
    (lambda _: open_source("nothing"),
     r"--camera nothing: there is no such file or folder\n(.|\n)*a folder that fills"),
])  # fmt: skip
def test_a_source_that_is_empty_removed_or_not_there_says_so(tmp_path, ask, said):
    with pytest.raises(UserError, match=said):
        ask(tmp_path)
