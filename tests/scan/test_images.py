"""Photographs are turned as their tag says, phone pictures are read, raw files and mosaics are refused."""

import sys

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageOps

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan.images import (
    is_mosaic,
    photograph_header,
    read_photograph,
    refuse_mosaic,
    turned,
    turned_by_tag,
)

SCENE = cv2.GaussianBlur(np.random.default_rng(0).random((96, 128, 3)).astype(np.float32), (0, 0), 4)
SCENE = ((SCENE - SCENE.min()) / np.ptp(SCENE) * 220 + 20).astype(np.uint8)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_orientation_is_turned_as_pillow_turns_it(tmp_path, orientation):
    image, path = Image.fromarray(SCENE), tmp_path / "a.png"
    exif = Image.Exif()
    exif[0x0112] = orientation
    image.save(path, exif=exif)
    with Image.open(path) as stored:
        expected = np.array(ImageOps.exif_transpose(stored))
    assert np.array_equal(read_photograph(path), expected)
    header = photograph_header(path)
    assert (header.h, header.w) == expected.shape[:2] and turned_by_tag(path) == (orientation != 1)
    grey = SCENE[..., 0]
    assert turned(grey, orientation).shape == expected.shape[:2]


def test_a_turned_16_bit_tiff_keeps_its_bits(tmp_path):
    deep = SCENE.astype(np.uint16) * np.uint16(257)
    for name, pixels in (("grey.tif", deep[..., 0]), ("colour.tiff", deep)):
        cv2.imwrite(str(tmp_path / name), pixels if pixels.ndim == 2 else pixels[..., ::-1])
        assert np.array_equal(read_photograph(tmp_path / name), pixels)
        assert photograph_header(tmp_path / name).bits == 16


def test_a_phone_picture_is_read_upright(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    path = tmp_path / "phone.HEIC"
    pillow_heif.from_pillow(Image.fromarray(SCENE)).save(path, quality=95, exif=exif.tobytes())
    pixels, header = read_photograph(path), photograph_header(path)
    assert pixels.shape == (header.h, header.w, 3) == (128, 96, 3)
    assert np.abs(pixels.astype(int) - np.rot90(SCENE, -1)).mean() < 12  # colours are stored at half resolution
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(UserError, match=r"phone.HEIC: cannot be read as HEIC"):
        read_photograph(path)


def test_a_missing_reader_is_named_with_its_command(tmp_path, monkeypatch):
    path = tmp_path / "phone.heic"
    path.write_bytes(b"x")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(UserError, match=r"pip install 'sl-nerfstudio\[phone\]'"):
        read_photograph(path)


def test_raw_files_are_refused_with_the_command_that_converts_them(tmp_path):
    path = tmp_path / "DSC_0001.NEF"
    path.write_bytes(b"raw")
    for read in (read_photograph, photograph_header):
        with pytest.raises(UserError, match=r"DSC_0001.NEF: is a raw file(.*\n)*.*dcraw_emu -T -W DSC_0001.NEF"):
            read(path)


def _mosaic(scene, greens, gains=(0.5, 1.0, 0.65)):
    out = np.zeros(scene.shape[:2])
    for place in range(4):
        colour = 1 if place in greens else (0 if place < 2 else 2)
        out[place // 2 :: 2, place % 2 :: 2] = gains[colour] * scene[place // 2 :: 2, place % 2 :: 2, colour]
    return out.astype(np.uint8)


@pytest.mark.parametrize("greens", [(0, 3), (1, 2)])
def test_raw_mosaics_are_recognised(tmp_path, greens):
    mosaic = _mosaic(np.repeat(SCENE[..., :1], 3, -1), greens)
    assert is_mosaic(mosaic) and is_mosaic(mosaic.astype(np.uint16) * np.uint16(16))
    cv2.imwrite(str(tmp_path / "m.png"), mosaic)
    with pytest.raises(UserError, match=r"m.png: is the raw mosaic(.*\n)*.*cv2.COLOR_BayerRG2GRAY.*--not-mosaic"):
        refuse_mosaic(tmp_path / "m.png")


def test_pictures_are_no_mosaics():
    grey = SCENE[..., 1]
    rng = np.random.default_rng(1)
    noisy = np.clip(grey + rng.normal(0, 25, grey.shape), 0, 255).astype(np.uint8)
    stripes = np.where(np.arange(128) % 2, grey, grey // 2).astype(np.uint8)
    squares = np.where(np.add.outer(np.arange(96), np.arange(128)) % 4 < 2, grey, grey // 3).astype(np.uint8)
    for picture in (grey, noisy, stripes, squares, SCENE, np.zeros_like(grey), np.full_like(grey, 255), grey[:8]):
        assert not is_mosaic(picture)
