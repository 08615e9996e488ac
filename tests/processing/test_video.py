"""Sharp frames are chosen from a video, apart by motion, the same ones again; others are refused with the reason."""

import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.video import SHARP, sharpness, video_frames
from sl_nerfstudio.scan.images import read_image

W, H = 320, 240
BLURRED = (8, 9, 10, 21)
SCENE = np.kron(np.random.default_rng(0).random((40, 70)) > 0.5, np.ones((8, 8))).astype(np.float32) * 180 + 30


def write_video(path, frames):
    """Grey pictures as an H.264 video of 25 frames a second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height = frames[0].shape[1], frames[0].shape[0]
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, 25)
        stream.options = {"crf": "12", "preset": "ultrafast"}
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(np.repeat(frame[..., None], 3, -1), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def pictures(speed=4.0, blurred=BLURRED, count=30, blur=4.0):
    """A walk past a scene of squares; some pictures are blurred."""
    out = []
    for k in range(count):
        shift = np.float32([[1, 0, -speed * k], [0, 1, -10]])
        image = cv2.warpAffine(SCENE, shift, (W, H))
        out.append(np.rint(gaussian_filter(image, blur) if k in blurred else image).astype(np.uint8))
    return out


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "walk.mp4"
    write_video(path, pictures())
    return path


def test_sharp_frames_apart_by_motion_are_kept(video, tmp_path):
    folder, choice = video_frames(video, tmp_path)
    numbers = [frame.number for frame in choice.chosen]
    assert choice.frames_in_video == 30 and not set(numbers) & set(BLURRED) and choice.blurred >= len(BLURRED)
    moved = np.diff(numbers) * 4.0 / np.hypot(W, H)  # shares of the diagonal, exactly
    assert moved.min() > 0.45 * choice.step and moved.max() < 3 * choice.step
    np.testing.assert_allclose([frame.moved for frame in choice.chosen[1:]], moved, atol=0.012)
    np.testing.assert_allclose([frame.time_s for frame in choice.chosen], np.array(numbers) / 25, atol=1e-3)
    stored = read_image(folder / f"{choice.chosen[1].name}.png")
    assert np.abs(stored.mean(-1) - pictures()[numbers[1]]).mean() < 6
    assert "4 frames are blurred" in choice.sentences()[1] and "walk.mp4: " in choice.sentences()[0]


def test_another_run_takes_the_same_frames_without_reading_the_video(video, tmp_path, monkeypatch):
    first = video_frames(video, tmp_path)
    times = {path: path.stat().st_mtime_ns for path in first[0].iterdir()}
    monkeypatch.setattr(av, "open", None)
    assert video_frames(video, tmp_path) == first
    assert {path: path.stat().st_mtime_ns for path in first[0].iterdir()} == times


def test_a_video_that_says_it_is_turned_is_turned(video, tmp_path):
    """The display matrix of a phone that was held upright: a quarter turn."""
    content = bytearray(video.read_bytes())
    place = content.index(b"tkhd") + 4 + 4 + 32 + 4  # version, times, .., then the matrix
    one = 1 << 16
    content[place : place + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, 0, 0, 1 << 30)
    turned = tmp_path / "turned.mp4"
    turned.write_bytes(content)
    plain, choice = video_frames(video, tmp_path)
    upright, again = video_frames(turned, tmp_path)
    assert [frame.number for frame in again.chosen] == [frame.number for frame in choice.chosen]
    name = f"{choice.chosen[0].name}.png"
    assert np.array_equal(read_image(upright / name), np.rot90(read_image(plain / name), -1))


def test_a_video_that_stands_still_or_is_blurred_is_refused(tmp_path):
    write_video(tmp_path / "still.mp4", pictures(speed=0.0, count=5))
    with pytest.raises(UserError, match=r"still.mp4: moves by 0.\d% .*only: 1 frame was chosen(.*\n)*.*remedy: walk"):
        video_frames(tmp_path / "still.mp4", tmp_path)
    write_video(tmp_path / "soft.mp4", pictures(blurred=range(5), count=5))
    with pytest.raises(UserError, match=r"soft.mp4: has no two sharp frames.*\n.*out of focus.*\n.*lock the focus"):
        video_frames(tmp_path / "soft.mp4", tmp_path)


def test_files_that_are_no_video(tmp_path, video):
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(4000))
    (tmp_path / "cut.mp4").write_bytes(video.read_bytes()[:3000])
    for name in ("noise.mp4", "cut.mp4"):
        with pytest.raises(UserError, match=rf"{name}: cannot be read as a video(.*\n)*.*remedy: copy it again"):
            video_frames(tmp_path / name, tmp_path)
    with pytest.raises(UserError, match=r"gone.mp4: is missing"):
        video_frames(tmp_path / "gone.mp4", tmp_path)


@pytest.mark.parametrize("contrast", [1.0, 0.2])
def test_sharpness_falls_with_blur_in_any_direction_whatever_the_contrast_and_noise(contrast):
    rng = np.random.default_rng(1)
    scene = cv2.resize(SCENE, None, fx=1.7, fy=1.7, interpolation=cv2.INTER_NEAREST) * contrast

    def value(image):
        return sharpness(np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8))

    sharp = value(gaussian_filter(scene, 0.7))
    defocused = [value(gaussian_filter(scene, sigma)) for sigma in (1.5, 3.0)]
    assert sharp > 0.62 > defocused[0] > SHARP > defocused[1]
    assert max(value(cv2.blur(scene, size)) for size in ((13, 1), (1, 13))) < SHARP
    assert value(np.full_like(scene, 80)) < SHARP
