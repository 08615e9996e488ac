"""sl-capture as a user runs it: from a video, and with a camera in front of a display."""

import re
import shlex
import time

import cv2
import numpy as np
import pytest

from sl_nerfstudio.capture import camera as camera_module
from sl_nerfstudio.capture.screen import Window
from sl_nerfstudio.capture.selection import GridReader
from sl_nerfstudio.cli.capture import main
from sl_nerfstudio.decoding.decoders import GrayCodeDecoder
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.scan.images import read_image
from tests.capture.conftest import middle
from tests.capture.fake_camera import FakeCapture
from tests.capture.photographs import PATTERN, SIZE, homography, photograph

GRAY = GrayCode(128, 96, 8)
PLACES = [homography(), homography(shift=(25, 10), roll=5), homography(shift=(-20, 5), roll=-8, scale=0.8)]

BEFORE_DISPLAY = np.array([[1.3, 0.05, 10], [0.02, 1.25, 8], [0, 0, 1]])
WALL = (200, 150)  # pixels of the image of a camera in front of the display


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Four images a second: each place twice a second apart, with images between that must not be kept."""
    path = tmp_path_factory.mktemp("video") / "clip.avi"
    picture = PATTERN.render(2)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 4, SIZE)
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 100)
    for place, bad in zip(PLACES, ({"blur": 6.0}, {"light": 900.0}, {"light": 4.0, "ambient": 2.0}), strict=True):
        for options in ({}, {"seed": 1}, bad, {"seed": 2}, {"seed": 3}):
            writer.write(photograph(picture, place, **options)[..., ::-1])
    writer.release()
    return path


@pytest.fixture
def pattern(tmp_path):
    path = tmp_path / "the pattern" / "pattern.json"
    path.parent.mkdir()
    path.write_bytes(PATTERN.encode())
    cv2.imwrite(str(path.parent / "pattern.png"), np.rint(255 * PATTERN.render(4)).astype(np.uint8))
    return path


@pytest.fixture
def gray_pattern(tmp_path):
    path = tmp_path / "gray.json"
    path.write_bytes(GRAY.encode())
    return path


@pytest.fixture
def filmed_screen(monkeypatch, keyboard):
    """A camera in front of the display: it sees what the display shows on a wall, and presses keys by itself."""

    last = [None, None]  # the wall, and its photograph

    def take():
        part = keyboard.seen(GRAY.w, GRAY.h)
        if last[0] is None or not np.array_equal(part, last[0]):
            last[:] = part, photograph(part / 255, BEFORE_DISPLAY, WALL, noise=1.0)
        return last[1]

    capture = FakeCapture(take)
    real = cv2.VideoCapture
    monkeypatch.setattr(camera_module.cv2, "VideoCapture", lambda which: capture if which == 0 else real(which))
    return capture


@pytest.fixture
def film(command, video, pattern, tmp_path):
    """Runs sl-capture on the video."""
    place = ("--camera", video, "--output", tmp_path / "c", "--pattern", pattern)
    return lambda *flags: command(main, *place, *flags)


def kept(root):
    return sorted(path.name for path in root.glob("frame*"))


@pytest.fixture
def in_step(command, filmed_screen, gray_pattern, tmp_path):
    """Runs sl-capture with Gray code on the display and the camera in front of it."""
    place = ("--camera", 0, "--output", tmp_path / "c", "--pattern", gray_pattern, "--show", 0, "--settle", "0.001")
    return lambda *flags: command(main, *place, *flags)


def test_a_video_gives_one_frame_of_each_place(command, video, pattern, tmp_path, capsys):
    out = tmp_path / "my captures"
    command(main, "--camera", video, "--output", out, "--pattern", pattern, "--headless")
    said = capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == ["capture.json", *(f"frame_000{k}.png" for k in range(3))]
    true = [photograph(PATTERN.render(2), place) for place in PLACES]
    for k, image in enumerate(true):
        assert np.abs(read_image(out / f"frame_000{k}.png").astype(float) - image).mean() < 3  # the video is JPEG
    for words in ("this view is known", "blurred: move more slowly", "too bright", "too dark"):
        assert words in said
    assert "kept frame_0000.png" in said and "3 frames in" in said and "a scan usually takes 10 frames" in said
    words = shlex.split(said.partition("next:\n")[2].replace("\\\n", " "))
    assert words[:4] == ["sl-scan", str(out), "--pattern", str(pattern)]


def test_a_folder_is_continued_and_nothing_is_kept_twice(film, tmp_path, capsys):
    film("--headless", "--frames", "2")
    files = {path: path.read_bytes() for path in (tmp_path / "c").glob("frame*")}
    assert len(files) == 2
    film("--headless", "--frames", "2")  # there are two
    assert len(kept(tmp_path / "c")) == 2
    film("--headless")
    assert len(kept(tmp_path / "c")) == 3
    assert all(path.read_bytes() == content for path, content in files.items())
    assert "3 frames in" in capsys.readouterr().out


def test_the_preview_shows_what_is_decoded_and_keys_keep_and_end(film, keyboard, tmp_path, monkeypatch):
    pictures, show = [], Window.show

    def record(self, picture):
        show(self, picture)
        shown = keyboard.pygame.surfarray.array3d(self._window.get_surface()).transpose(1, 0, 2)
        assert np.array_equal(shown, picture)
        pictures.append(picture)

    monkeypatch.setattr(Window, "show", record)
    keyboard.press("", "", "SPACE", "a", "")  # the third image is blurred
    film()
    assert kept(tmp_path / "c") == ["frame_0000.png", "frame_0001.png"]
    assert cv2.Laplacian(read_image(tmp_path / "c" / "frame_0001.png"), cv2.CV_64F).std() < 10
    first, second = (picture.astype(int) for picture in pictures[:2])
    seen = np.ptp(first[:300, :400], axis=-1) > 40
    assert seen.mean() > 0.2  # coloured, while the camera's image is grey
    assert np.ptp(first[:300, 408:], axis=-1).max() == 0 and np.ptp(second[:300, 408:], axis=-1).max() > 60  # the map


def test_the_preview_of_a_camera_goes_on_while_an_image_is_read(
    command, keyboard, filmed_screen, pattern, tmp_path, monkeypatch
):
    reads, shown = [], []
    read = GridReader.read

    def slowly(self, image):
        reads.append(len(shown))
        while len(reads) == 2 and len(shown) < reads[1] + 3:  # until three more pictures were shown
            time.sleep(0.001)
        return read(self, image)

    monkeypatch.setattr(GridReader, "read", slowly)
    monkeypatch.setattr(Window, "show", lambda self, picture: shown.append(picture))
    keyboard.press("", "", "SPACE", *[""] * 1000)  # pressed while the second image is read
    filmed_screen.take = lambda: photograph(PATTERN.render(1), PLACES[0])
    command(main, "--camera", 0, "--output", tmp_path / "c", "--pattern", pattern, "--frames", 2, "--rate", 500)
    assert len(shown) >= len(reads) + 3
    assert len(reads) == 2 and len(kept(tmp_path / "c")) == 2  # the view was known, so the key kept it


def test_the_grid_can_be_shown_by_the_same_command(film, keyboard, pattern):
    keyboard.press(*[""] * 100)
    film("--show", 0, "--headless", "--frames", 1)
    image = read_image(pattern.parent / "pattern.png")
    assert np.array_equal(middle(keyboard.shown[0], PATTERN.w, PATTERN.h)[..., 0], image)


@pytest.mark.slow
def test_each_kept_frame_is_photographed_in_white_light_too(command, keyboard, monkeypatch, pattern, tmp_path, capsys):
    """The camera sees the display: a picture for colours shows no line of the pattern."""

    monkeypatch.setattr(
        camera_module.cv2,
        "VideoCapture",
        lambda _: FakeCapture(lambda: photograph(keyboard.seen(PATTERN.w, PATTERN.h) / 255, PLACES[0])),
    )
    flags = ["--camera", 0, "--output", tmp_path / "c", "--pattern", pattern, "--show", 0, "--headless", "--frames", 1]
    keyboard.press(*[""] * 1000)
    command(main, *flags, "--color", tmp_path / "colours", "--settle", "0.05")
    assert [path.name for path in (tmp_path / "colours").iterdir()] == ["frame_0000.png"]
    white, frame = (read_image(tmp_path / folder / "frame_0000.png").mean(-1) for folder in ("colours", "c"))
    inner = np.s_[frame.shape[0] // 3 : -frame.shape[0] // 3, frame.shape[1] // 3 : -frame.shape[1] // 3]
    assert white[inner].std() < 5 < 20 < frame[inner].std() and white[inner].mean() > 100
    assert f"--color {tmp_path / 'colours'}" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        command(main, *flags[:3], tmp_path / "other", *flags[4:], "--color", tmp_path / "colours")
    assert "holds frame_0000.png, and there is no such frame in" in capsys.readouterr().err


def test_gray_code_is_shown_and_captured_in_step(in_step, keyboard, tmp_path, capsys):
    sequence = ["SPACE", *[""] * (GRAY.images + 1)]
    early = ["SPACE", "SPACE", ""]  # pressed while the first sequence is decoded
    keyboard.press("", *sequence, *early, *sequence)
    in_step("--headless", "--rate", "100", "--frames", "2")
    said = capsys.readouterr().out
    assert "Space captures the sequence of 18 images" in said and "kept frame_0001" in said and "warning" not in said
    assert re.search(r"all frames show 9\d %|all frames show (9\d|100)%", said)
    assert len(list((tmp_path / "c" / "frame_0001").iterdir())) == GRAY.images
    paths = sorted((tmp_path / "c" / "frame_0000").iterdir())
    decoded = GrayCodeDecoder(GRAY).decode([read_image(path) for path in paths], [path.name for path in paths])
    assert decoded.rate > 0.95 and decoded.decoded.mean() > 0.5
    y, x = np.mgrid[: WALL[1], : WALL[0]][:, decoded.decoded] + 0.5
    true = (np.linalg.inv(BEFORE_DISPLAY) @ np.stack([x, y, np.ones_like(x)]))[:2].T
    inside = (true > GRAY.cell).all(-1) & (true < np.array([GRAY.w, GRAY.h]) - GRAY.cell).all(-1)
    assert np.abs(decoded.coords[decoded.decoded] - true)[inside].max() < 3
    assert "sl-scan " in said.partition("next:")[2]


def test_a_camera_that_changes_its_exposure_is_noticed(in_step, keyboard, filmed_screen, capsys):
    steady = filmed_screen.take
    filmed_screen.take = lambda: np.rint(steady() * (0.8 + 0.01 * min(len(keyboard.waits), 20))).astype(np.uint8)
    keyboard.press("", "SPACE", *[""] * (GRAY.images + 1), "ESCAPE")
    in_step("--headless")
    said = capsys.readouterr().out
    drift = int(re.search(r"white was (\d+)% brighter after the sequence", said)[1])
    assert 15 <= drift <= 26 and "kept frame_0000" in said and "give --exposure" in said


def test_a_sequence_that_shows_nothing_or_is_left_is_not_kept(in_step, keyboard, filmed_screen, tmp_path, capsys):
    filmed_screen.take = lambda: np.zeros((*WALL[::-1], 3), dtype=np.uint8)  # a lens cap
    keyboard.press("", "SPACE", *[""] * (GRAY.images + 1), "ESCAPE")
    in_step("--headless")
    filmed_screen.open = True
    keyboard.press("", "SPACE", "", "", "ESCAPE")  # leaves a sequence that is under way
    in_step()
    said = capsys.readouterr().out
    assert "not kept: this sequence no stripes are seen: the images are black" in said
    assert "no frame was kept" in said and not (tmp_path / "c").exists()


def test_without_a_pattern_the_key_keeps(command, keyboard, video, tmp_path, capsys):
    keyboard.press("SPACE", "", "SPACE")
    command(main, "--camera", video, "--output", tmp_path / "c")
    assert len(kept(tmp_path / "c")) == 2
    assert "sl-calibrate --images" in capsys.readouterr().out


def test_control_c_is_a_usual_end(film, tmp_path, capsys, monkeypatch):
    def interrupted(self, rate):
        yield 0.0, photograph(PATTERN.render(2), PLACES[0])
        raise KeyboardInterrupt

    monkeypatch.setattr(camera_module.Video, "frames", interrupted)
    film("--headless")
    assert "1 frame in" in capsys.readouterr().out and (tmp_path / "c" / "frame_0000.png").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--camera", "no.mp4", "--headless", "--pattern", "PATTERN"], "--camera no.mp4: there is no such file"),
        (["--camera", "VIDEO", "--headless"], "--headless: without a pattern, frames are kept by key alone"),
        (["--camera", "VIDEO", "--show", "0"], "--show 0: give --pattern"),
        (["--camera", "VIDEO", "--pattern", "GRAY", "--show", "0"], "Gray code cannot be captured from a video"),
        (["--camera", "0", "--pattern", "GRAY"], "Gray code is shown and captured in step"),
        (["--camera", "VIDEO", "--pattern", "PATTERN", "--color", "c"], "needs a camera, and a display that shows"),
        (["--camera", "0", "--pattern", "GRAY", "--show", "0", "--color", "c"], "Gray code has its own images in"),
        (["--camera", "VIDEO", "--pattern", "PATTERN", "--rate", "0"], "--rate 0: give a number above 0"),
        (["--camera", "VIDEO", "--pattern", "PATTERN", "--frames", "0"], "--frames 0: give a number of at least 1"),
        (["--camera", "VIDEO", "--pattern", "PATTERN", "--size", "9"], '--size "9": is no pair of numbers'),
        (["--camera", "VIDEO", "--pattern", "PATTERN", "--size", "9x9"], "--size: has no meaning for the video file"),
        (["--camera", "VIDEO", "--pattern", "nowhere.json"], "nowhere.json"),
    ],
)
def test_bad_flags(command, keyboard, filmed_screen, gray_pattern, video, pattern, tmp_path, capsys, flags, message):
    words = {"VIDEO": video, "PATTERN": pattern, "GRAY": gray_pattern}
    with pytest.raises(SystemExit) as stop:
        command(main, *(words.get(flag, flag) for flag in flags), "--output", tmp_path / "c")
    assert stop.value.code == 1 and message in capsys.readouterr().err and not (tmp_path / "c").exists()
