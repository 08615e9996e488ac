"""Captures are found in their order and with their pattern; faulty ones are named with all their faults."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sl_nerfstudio.calibration.formats import camera_names, read_device_file
from sl_nerfstudio.decoding.grid_networks import LoadedNetworks
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.processing import inputs
from sl_nerfstudio.processing.captures import describe_faults, find_captures, incomplete
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.inputs import read_captured
from sl_nerfstudio.scan.images import encode_png
from tests.decoding.gray_captures import exact_coords, photographs


def _write(path, w=16, h=12, mode="L"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, (w, h), 90).save(path)


def test_numbers_count_as_numbers_and_other_files_do_not(tmp_path):
    for name in ("b10.png", "b9.JPG", "a2.tif", ".hidden.png", "notes.txt"):
        _write(tmp_path / name) if not name.endswith("txt") else (tmp_path / name).write_text("x")
    captures = find_captures(tmp_path, sequences=False)
    assert [f.name for f in captures.frames] == ["a2", "b9", "b10"]
    assert captures.size == (16, 12) and captures.faults == {}


def test_sequences_are_folders(tmp_path):
    for frame in ("view10", "view2", "empty"):
        (tmp_path / frame).mkdir()
    for frame in ("view10", "view2"):
        for k in (0, 1, 2, 10):
            _write(tmp_path / frame / f"{k}.png")
    captures = find_captures(tmp_path, sequences=True)
    assert [f.name for f in captures.frames] == ["view2", "view10"]
    assert [p.stem for p in captures.frames[0].images] == ["0", "1", "2", "10"]


def test_images_of_another_size_and_unreadable_ones_are_faults_of_their_frames(tmp_path):
    for k in range(4):
        _write(tmp_path / f"f{k}.png")
    _write(tmp_path / "f1.png", 12, 16)
    (tmp_path / "f2.png").write_bytes(b"")
    _write(tmp_path / "f4.png", 32, 24)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("L", (16, 12), 90).save(tmp_path / "f5.jpg", exif=exif)
    captures = find_captures(tmp_path, sequences=False)
    assert sorted(captures.faults) == ["f1", "f2", "f4", "f5"]
    turned, empty, large, tagged = (str(captures.faults[name]) for name in sorted(captures.faults))
    assert "is 12 x 16 pixels, most images are 16 x 12" in tagged and "as the image's EXIF tag says" in tagged
    assert "f1.png: is 12 x 16 pixels, most images are 16 x 12" in turned and "held on its side" in turned
    assert "f2.png: is empty" in empty
    assert "f4.png: is 32 x 24 pixels" in large and "resized, cropped" in large
    assert all("remedy:" in text for text in (turned, empty, large))


def test_all_files_with_the_same_fault_are_named_together(tmp_path):
    for k in range(4):
        _write(tmp_path / f"f{k}.png")
    _write(tmp_path / "hidden.png", 8, 6)
    for name in ("cut1.png", "cut2.png"):
        Image.new("RGBA", (16, 12), (9, 9, 9, 100)).save(tmp_path / name)
    sentences = describe_faults(find_captures(tmp_path, sequences=False))
    assert len(sentences) == 2
    assert "cut1.png: is transparent in places (and so is cut2.png)" in sentences[0]
    assert "hidden.png: is 8 x 6 pixels, most images are 16 x 12" in sentences[1]
    for k in range(4):
        (tmp_path / f"f{k}.png").unlink()
    (tmp_path / "hidden.png").unlink()
    with pytest.raises(UserError, match=r"cut1.png: is transparent in places \(and so is cut2.png\)"):
        find_captures(tmp_path, sequences=False)
    for k in range(8):
        _write(tmp_path / "sequence" / f"{k}.png", mode="RGBA" if k else "L")  # transparent
        _write(tmp_path / "whole" / f"{k}.png")
    fault = find_captures(tmp_path, sequences=True).faults["sequence"]
    assert "has 7 faults: 1.png, 2.png, 3.png, 4.png, 5.png and 2 more: each is transparent in places" in str(fault)


INSIDE = r"holds its captures in a folder of its own, images(.*\n)*.*give --images .*/images$"


@pytest.mark.parametrize(
    ("sequences", "files", "message"),
    [
        (False, ["a.png"], "holds 1 images; a scan needs at least 2 frames"),
        (False, ["images/1.png", "images/2.png"], INSIDE),
        (True, ["images/p/1.png", "images/q/1.png"], INSIDE),
        (False, ["x/1.png", "y/1.png"], "holds 0 images.*\n.*do not suit the pattern: a coded grid needs"),
        (True, ["1.png", "2.png"], "holds 0 folders with images.*\n.*do not suit the pattern"),
        (False, ["a.png", "a.jpg", "b.png"], "several images named a"),
    ],
)
def test_folders_that_hold_no_captures(tmp_path, sequences, files, message):
    for name in files:
        _write(tmp_path / name)
    with pytest.raises(UserError, match=message) as caught:
        find_captures(tmp_path, sequences)
    assert "remedy:" in str(caught.value)


SIZE = (320, 240)
OPENCV = GrayCode.in_order("opencv", *SIZE, 1)


@pytest.fixture(scope="module")
def sequence():
    return photographs(exact_coords(), layout=OPENCV)


def write(folder, images):
    folder.mkdir(parents=True)
    for k, image in enumerate(images):
        (folder / f"{k:02d}.png").write_bytes(encode_png(image))


def config(tmp_path, **changes):
    names = ("images", "pattern", "intrinsics", "output")
    return replace(ProcessConfig(*(tmp_path / name for name in names)), **changes)


def test_the_order_is_recognised_and_reported(tmp_path, sequence):
    for name in ("a", "b"):
        write(tmp_path / "images" / name, sequence)
    captured = read_captured(config(tmp_path, pattern=Path("320x240"), intrinsics=tmp_path / "i.yml"))
    assert captured.decoder.layout == OPENCV and captured.notes.recognised
    assert captured.notes.sentences == (
        "Gray code of 320 x 240 pixels in cells of 1: 36 images, order opencv, procam, recognised from the images",
    )
    named = config(tmp_path, pattern=Path("320x240"), sequence="opencv", intrinsics=tmp_path / "i.yml")
    assert read_captured(named).decoder.layout == OPENCV and not read_captured(named).notes.recognised
    with pytest.raises(UserError, match=r"images/a: holds 36 images; .* have other numbers: no-inverses: 19"):
        read_captured(replace(named, sequence="no-inverses"))


def test_all_faults_of_a_frame_are_told_at_once(tmp_path, sequence):
    for name in ("a", "b"):
        write(tmp_path / name, sequence)
    (tmp_path / "b" / "17.png").unlink()
    (tmp_path / "b" / "20.png").write_bytes(encode_png(sequence[0][:-10]))
    (tmp_path / "b" / "30.png").write_bytes(b"")
    captures = find_captures(tmp_path, True)
    captures = captures.with_faults(incomplete(captures, OPENCV))
    assert list(captures.faults) == ["b"]
    said = str(captures.faults["b"])
    for part in ("b: has 3 faults", "30.png is empty", "20.png is 200 x 140 pixels, most images are 200 x 150",
                 "the folder holds 35 images, the sequence of the pattern has 36 (by the names, 17 is missing)",
                 "cause:", "resized, cropped", "images are missing or too many", "remedy:"):  # fmt: skip
        assert part in said


def test_several_cameras_take_turns_each_with_its_own_intrinsics(tmp_path):
    entry = {"fl_x": 60.0, "fl_y": 60.0, "cx": 8.0, "cy": 6.0}
    document = {"cameras": {"left": {"w": 16, "h": 12, **entry}, "right": {"w": 20, "h": 10, **entry, "fl_x": 70.0}}}
    path = tmp_path / "i.json"
    path.write_text(json.dumps(document))
    assert camera_names(path) == ("left", "right")
    for name, size in (("left", (16, 12)), ("right", (20, 10))):
        for k in range(2):
            _write(tmp_path / "c" / name / f"{k}.png", *size)
    captures = find_captures(tmp_path / "c", False, camera_names(path))
    assert [frame.name for frame in captures.frames] == ["left_0", "right_0", "left_1", "right_1"]
    assert captures.sizes == {"left": (16, 12), "right": (20, 10)} and not captures.faults
    devices = {n: read_device_file(path, "camera", s, name=n) for n, s in captures.sizes.items()}
    assert (devices["left"].fl_x, devices["right"].fl_x, devices["right"].w) == (60.0, 70.0, 20)
    (tmp_path / "c" / "right").rename(tmp_path / "c" / "rechts")
    with pytest.raises(UserError, match="has the folders left, rechts, the intrinsics file the cameras left, right"):
        find_captures(tmp_path / "c", False, camera_names(path))


def test_a_video_of_gray_code_is_refused(tmp_path):
    (tmp_path / "p.json").write_bytes(OPENCV.encode())
    (tmp_path / "v.mp4").write_bytes(b"x")
    with pytest.raises(UserError, match=r"v.mp4: is a video, and Gray code needs one image for each pattern"):
        read_captured(config(tmp_path, images=tmp_path / "v.mp4", pattern=tmp_path / "p.json"))


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_the_networks_are_computed_where_the_flag_says(tmp_path, monkeypatch, device):
    networks = LoadedNetworks()
    monkeypatch.setattr(inputs, "usable_device", lambda asked: (asked, f"said of {asked}"))
    monkeypatch.setattr(inputs, "networks_for_all_processes", lambda device: networks)
    (tmp_path / "p.json").write_bytes(GridPattern().encode())
    for k in range(3):
        _write(tmp_path / "images" / f"{k}.png")
    captured = read_captured(config(tmp_path, pattern=tmp_path / "p.json", device=device))
    assert captured.decoder.networks is (networks if device == "cuda" else None)
    assert captured.notes.sentences == (f"said of {device}",)


def flat(size, part):
    """Exact coordinates of a board tilted before the projector, from `part` shares of each side to one less of it."""
    x, y = np.meshgrid(np.linspace(-0.08, 1.08, 260), np.linspace(-0.08, 1.08, 220))
    u, v = size[0] * (x + 0.04 * (y - 0.5)), size[1] * (y - 0.03 * (x - 0.5))
    coords = np.stack([u, v], -1)
    low, high = np.multiply(size, part), np.multiply(size, 1 - part)
    coords[((coords < low) | (coords > high)).any(-1)] = np.nan
    return coords


WRONG = [((640, 480, 2), "800x600"), ((640, 480, 2), "640x400"), ((1280, 800, 4), "1024x768")]


@pytest.mark.parametrize(("true", "stated"), WRONG)
@pytest.mark.slow
def test_a_resolution_that_the_codes_exclude_is_refused_and_the_likely_one_named(tmp_path, true, stated):
    layout = GrayCode(*true)
    for name in ("a", "b"):
        write(tmp_path / "images" / name, photographs(flat(true[:2], 0), layout=layout))
    given = config(tmp_path, intrinsics=tmp_path / "i.yml")
    with pytest.raises(UserError, match=f"--pattern {true[0]}x{true[1]}, or the pattern.json") as caught:
        read_captured(replace(given, pattern=Path(stated)))
    said = str(caught.value)
    assert str(tmp_path / "images" / "a") in said and f"{stated.replace('x', ' x ')} pixels" in said
    columns, rows = map(int, re.search(r"shows (\d+) columns and (\d+) rows of cells", said).groups())
    assert layout.columns - 3 <= columns <= layout.columns and layout.rows - 3 <= rows <= layout.rows
    captured = read_captured(replace(given, pattern=Path(f"{true[0]}x{true[1]}")))
    assert captured.decoder.layout == layout


def test_a_board_in_part_of_the_pattern_says_nothing_against_the_resolution(tmp_path):
    layout = GrayCode(640, 480, 2)
    for name in ("a", "b"):
        write(tmp_path / "images" / name, photographs(flat((640, 480), 0.2), layout=layout))
    given = config(tmp_path, pattern=Path("640x480"), intrinsics=tmp_path / "i.yml")
    assert read_captured(given).decoder.layout == layout
