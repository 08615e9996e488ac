"""One mask file: what counts as white, and which files are refused with which words."""

import numpy as np
import pytest
from PIL import Image

from sl_nerfstudio.processing.masks import read_mask
from sl_nerfstudio.scan.document import FileError

W, H = 12, 9
DRAWN = np.zeros((H, W), dtype=bool)
DRAWN[2:7, 3:9] = True


def _save(path, image):
    (image if isinstance(image, Image.Image) else Image.fromarray(image)).save(path)
    return path


def _palette():
    image = Image.fromarray(DRAWN.astype(np.uint8), "P")
    image.putpalette([0, 0, 0, 255, 255, 255])
    return image


def _transparent():
    rgba = np.full((H, W, 4), 255, np.uint8)
    rgba[..., 3] = 255 * DRAWN
    return rgba


@pytest.mark.parametrize(
    ("name", "image"),
    {
        "0 and 255.png": (255 * DRAWN).astype(np.uint8),
        "0 and 1.png": DRAWN.astype(np.uint8),
        "0 and 7.bmp": (7 * DRAWN).astype(np.uint8),
        "16 bit.png": (65535 * DRAWN).astype(np.uint16),
        "0 and 1 of 16 bit.tif": DRAWN.astype(np.uint16),
        "one bit.png": Image.fromarray(DRAWN),
        "rgb.tiff": np.repeat((255 * DRAWN).astype(np.uint8)[..., None], 3, -1),
        "palette.png": _palette(),
        "transparent where black.png": _transparent(),
    }.items(),
)
def test_every_usual_kind_gives_the_same_mask(tmp_path, name, image):
    np.testing.assert_array_equal(read_mask(_save(tmp_path / name, image), (W, H)), DRAWN)


def test_jpeg_and_smooth_edges_are_used_from_half_of_full_scale_on(tmp_path):
    large = np.zeros((200, 300), np.uint8)
    large[50:150, 60:200] = 255
    smooth = large.copy()
    smooth[50, 60:200], smooth[149, 60:200] = 127, 128
    expected = large > 0
    assert (read_mask(_save(tmp_path / "a.jpg", large), (300, 200)) == expected).mean() > 0.999
    expected[50] = False
    np.testing.assert_array_equal(read_mask(_save(tmp_path / "b.png", smooth), (300, 200)), expected)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        ((255 * DRAWN[:, :-1]).astype(np.uint8), "is 11 x 9 pixels, the captures are 12 x 9\n.*reduced or cropped"),
        (np.zeros((H, W), np.uint8), "is all black: no pixel of its capture would be used\n.*black stands for"),
        (np.arange(H * W, dtype=np.uint8).reshape(H, W) // 6, "is no mask: its values go from 0 to 17, with several"),
        (np.linspace(0, 255, H * W).astype(np.uint8).reshape(H, W), "is no mask: 80% of its pixels are between"),
        (np.dstack([DRAWN * 200, DRAWN * 90, DRAWN * 10]).astype(np.uint8), "has colours.*\n.*cut-out whose trans"),
        (np.zeros((H, W, 4), np.uint8), "is all black"),
    ],
)
def test_what_is_no_mask_is_refused_with_cause_and_remedy(tmp_path, image, words):
    path = _save(tmp_path / "m.png", image)
    with pytest.raises(FileError, match=words) as error:
        read_mask(path, (W, H))
    assert error.value.path == path and error.value.cause and error.value.remedy


@pytest.mark.parametrize(("content", "words"), [(b"", "is empty"), (b"no image", "is not an image that can be read")])
def test_a_broken_file_is_named(tmp_path, content, words):
    (tmp_path / "m.png").write_bytes(content)
    with pytest.raises(FileError, match=words):
        read_mask(tmp_path / "m.png", (W, H))
    with pytest.raises(FileError, match="is missing"):
        read_mask(tmp_path / "n.png", (W, H))


def test_a_truncated_palette_image_and_a_rotated_one_are_refused(tmp_path):
    whole = _save(tmp_path / "a.png", _palette()).read_bytes()
    (tmp_path / "b.png").write_bytes(whole[: len(whole) - 30])
    with pytest.raises(FileError):
        read_mask(tmp_path / "b.png", (W, H))
    image = Image.fromarray((255 * DRAWN).astype(np.uint8))
    exif = image.getexif()
    exif[0x0112] = 6
    image.save(tmp_path / "c.jpg", exif=exif)
    with pytest.raises(FileError, match="EXIF orientation 6"):
        read_mask(tmp_path / "c.jpg", (W, H))
