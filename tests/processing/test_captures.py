"""Captures are found in their order, and faulty ones are named."""

import numpy as np
import pytest
from PIL import Image

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.captures import find_captures


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
    captures = find_captures(tmp_path, sequences=False)
    assert sorted(captures.faults) == ["f1", "f2", "f4"]
    turned, empty, large = (str(captures.faults[k]) for k in ("f1", "f2", "f4"))
    assert "f1.png: is 12 x 16 pixels, most images are 16 x 12" in turned and "held on its side" in turned
    assert "f2.png: is empty" in empty
    assert "f4.png: is 32 x 24 pixels" in large and "resized, cropped" in large
    assert all("remedy:" in text for text in (turned, empty, large))


@pytest.mark.parametrize(
    ("sequences", "files", "message"),
    [
        (False, ["a.png"], "holds 1 images; a scan needs at least 2 frames"),
        (
            False,
            ["x/1.png", "y/1.png"],
            "holds 0 images.*\n.*do not suit the pattern: a coded grid needs",
        ),
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


def test_no_folder_at_all(tmp_path):
    with pytest.raises(UserError, match=r"nowhere: is no folder"):
        find_captures(tmp_path / "nowhere", sequences=False)


def test_when_nothing_can_be_read_the_first_reason_is_given(tmp_path):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(np.random.default_rng(0).bytes(100))
    with pytest.raises(UserError, match=r"a\.png: is not an image that can be read"):
        find_captures(tmp_path, sequences=False)
