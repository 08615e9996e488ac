"""Paths and image files of a scan, and photographs: read exactly, turned as their tag says, or refused."""

import os
import struct
import sys
import zlib

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageOps
from sphere_scan import CAMERA, NAMES, edit, only_fault

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan import FileError, check_scan
from sl_nerfstudio.scan.images import (
    as_grey,
    encode_png,
    is_mosaic,
    photograph_header,
    read_header,
    read_image,
    read_photograph,
    refuse_mosaic,
    turned,
    turned_by_tag,
)

IMAGE = f"images/{NAMES[1]}.png"


@pytest.mark.parametrize(
    ("path", "problem"),
    [
        ("/etc/passwd", "is absolute (/etc/passwd)"),
        ("C:\\scan\\a.png", "is absolute"),
        ("../scan/images/frame_00001.png", "leaves the scan folder"),
        ("images/../../scan/images/frame_00001.png", "leaves the scan folder"),
        ("images\\..\\..\\x.png", "leaves the scan folder"),
        ("images\\frame_00001.png", "has backslashes"),
        ("images/a\0b.png", "characters that no file name can have"),
        ("images/\ud800.png", "characters that no file name can have"),
        ("images/frame_00000.png/x.png", "cannot be followed"),
        ("x" * 300, "cannot be followed"),
    ],
)
@pytest.mark.parametrize("key", ["mask_path", "sl_coords_path"])
def test_paths_that_are_refused(sphere, path, problem, key):
    edit(sphere, lambda document: document["frames"][1].update({key: path}))
    fault = only_fault(sphere)
    assert (fault.file, fault.frame, fault.field) == ("transforms.json", NAMES[1], key)
    assert problem in fault.problem and fault.remedy


def test_links(sphere, tmp_path):
    outside = tmp_path / "outside.png"
    (sphere / IMAGE).rename(outside)
    (sphere / IMAGE).symlink_to(outside)
    fault = only_fault(sphere)
    assert (fault.frame, fault.field) == (NAMES[1], "file_path")
    assert "is a link out of the scan folder" in fault.problem
    (sphere / IMAGE).unlink()
    (sphere / IMAGE).symlink_to(sphere / IMAGE)
    assert "cannot be followed" in only_fault(sphere).problem
    (sphere / IMAGE).unlink()
    outside.rename(sphere / "inside.png")
    (sphere / IMAGE).symlink_to("../inside.png")
    assert check_scan(sphere) == []
    link = tmp_path / "link"
    link.symlink_to(sphere)
    assert check_scan(link) == []
    (sphere / IMAGE).unlink()
    (sphere / IMAGE).symlink_to("nowhere.png")
    assert only_fault(sphere).problem == "is missing"


@pytest.mark.parametrize("file", ["pattern.png", IMAGE, f"patterns/{NAMES[1]}.png", f"masks/{NAMES[1]}.png"])
def test_missing_empty_truncated_foreign(sphere, file):
    content = (sphere / file).read_bytes()
    frame = None if file == "pattern.png" else NAMES[1]
    for damaged, problem in (
        (None, "is missing"),
        (b"", "is empty (0 bytes)"),
        (content[: len(content) // 2], "cannot be decoded"),
        (content[:80], "cannot be decoded"),
        (content[:20], "is not an image that can be read"),
        (b"%PDF-1.4 nothing like it", "is not an image that can be read"),
    ):
        (sphere / file).unlink()
        if damaged is not None:
            (sphere / file).write_bytes(damaged)
        fault = only_fault(sphere)
        assert (fault.file, fault.frame) == (file, frame)
        assert problem in fault.problem, damaged
        (sphere / file).write_bytes(content)
    (sphere / file).unlink()
    for make in (os.mkdir, os.mkfifo):  # a pipe does not hang the check
        make(sphere / file)
        assert only_fault(sphere).problem == "is not a file"
        (sphere / file).rmdir() if make is os.mkdir else (sphere / file).unlink()


def save(path, mode, size=(CAMERA.w, CAMERA.h), **options):
    rows = np.random.default_rng(1).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(rows).convert(mode).save(path, format="PNG", **options)


@pytest.mark.parametrize(
    ("mode", "kind", "options"),
    [
        ("P", "a colour palette", {}),
        ("RGBA", "transparency", {}),
        ("LA", "transparency", {}),
        ("1", "one bit per pixel", {}),
        ("L", "transparency", {"transparency": 3}),
    ],
)
def test_kinds_of_image_that_are_refused(sphere, mode, kind, options):
    save(sphere / IMAGE, mode, **options)
    fault = only_fault(sphere)
    assert fault.problem == f"is of a kind that a scan must not hold ({kind})" and "grey or RGB" in fault.remedy


def test_colour_is_for_images_only(sphere):
    with Image.open(sphere / IMAGE) as image:
        image.convert("RGB").save(sphere / IMAGE)
    assert check_scan(sphere) == []
    save(sphere / f"patterns/{NAMES[1]}.png", "RGB")
    assert only_fault(sphere).problem == "is in colour"


@pytest.mark.parametrize(
    ("size", "cause"), [((60, 72), "swapped"), ((36, 30), "resized"), ((72, 59), "cropped"), ((144, 120), "resized")]
)
@pytest.mark.parametrize("folder", ["images", "patterns", "masks"])
def test_wrong_size(sphere, size, cause, folder):
    Image.new("L", size, 255).save(sphere / folder / f"{NAMES[1]}.png")
    fault = only_fault(sphere)
    assert fault.problem == f"is {size[0]} x {size[1]} pixels, but the camera has 72 x 60"
    assert cause in fault.cause


def test_wrong_size_of_the_pattern_and_of_coordinates(sphere):
    Image.new("L", (128, 97), 9).save(sphere / "pattern.png")
    assert only_fault(sphere).problem == "is 128 x 97 pixels, but the projector has 128 x 96"
    edit(sphere, lambda document: document["projector"].update(h=97))
    np.savez(sphere / f"coords/{NAMES[0]}.npz", coords=np.zeros((72, 60, 2), np.float32))
    sizes = {fault.file: fault.problem for fault in check_scan(sphere)}
    assert sizes[f"coords/{NAMES[0]}.npz"] == "is 60 x 72 pixels, but the camera has 72 x 60"


def tag(orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    return exif


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_exif_rotation_is_refused(sphere, orientation, kind):
    Image.open(sphere / IMAGE).copy().save(sphere / IMAGE, format=kind, exif=tag(orientation))
    said = f"must be rotated before it is shown (EXIF orientation {orientation})"
    assert [fault.problem for fault in check_scan(sphere)] == ([] if orientation == 1 else [said])


def chunk(kind, data):
    """A part of a PNG file."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_exif_rotation_behind_the_pixels_of_a_png(sphere):
    content = (sphere / IMAGE).read_bytes()
    exif = chunk(b"eXIf", b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0")
    end = content.rindex(b"IEND") - 4
    (sphere / IMAGE).write_bytes(content[:end] + exif + content[end:])
    assert "EXIF orientation 6" in only_fault(sphere).problem


def png_head(w, h):
    head = struct.pack(">IIBBBBB", w, h, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")


def test_decompression_bombs_are_not_unpacked(sphere):
    (sphere / IMAGE).write_bytes(png_head(60_000, 60_000))
    fault = only_fault(sphere)
    assert "is far too large" in fault.problem and "exhaust memory" in fault.cause
    (sphere / IMAGE).write_bytes(png_head(9_000, 9_500))  # below Pillow's own limit
    assert only_fault(sphere).problem == "is 9000 x 9500 pixels, but the camera has 72 x 60"


def test_animations_and_formats_beyond_the_list_are_refused(tmp_path):
    image = Image.new("L", (4, 4))
    image.save(tmp_path / "a.tiff", save_all=True, append_images=[image])
    image.save(tmp_path / "a.png", format="GIF")
    for name, problem in (("a.tiff", "holds several images"), ("a.png", "is not an image that can be read")):
        with pytest.raises(FileError, match=problem):
            read_image(tmp_path / name)


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_pixels_come_back_exactly(tmp_path, suffix, dtype, channels):
    image = np.random.default_rng(2).integers(0, np.iinfo(dtype).max, (5, 7, *channels), dtype=dtype)
    path = tmp_path / f"ü{suffix}"
    path.write_bytes(cv2.imencode(suffix, image[..., ::-1] if channels else image)[1].tobytes())
    found = read_image(path)
    assert found.dtype == dtype and np.array_equal(found, image)
    header = read_header(path)
    assert (header.w, header.h, header.mode, header.bits) == (7, 5, "RGB" if channels else "grey", 8 * dtype().itemsize)
    if suffix == ".png":
        path.write_bytes(encode_png(image))
        assert np.array_equal(read_image(path), image)


def test_grey_is_a_fraction_of_full_scale():
    assert as_grey(np.array([[0, 255]], np.uint8)).tolist() == [[0, 1]]
    assert as_grey(np.array([[0, 65535]], np.uint16)).tolist() == [[0, 1]]
    colours = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]]], np.uint8)
    assert np.allclose(as_grey(colours), [[0.299, 0.587, 0.114, 1]])


def test_a_png_whose_check_sum_is_wrong(sphere):
    """The last bits of the pixels may be changed and still be decoded."""
    path = sphere / f"patterns/{NAMES[1]}.png"
    content = bytearray(path.read_bytes())
    place = content.index(b"IDAT") + 4
    content[place - 8 + 12 + int.from_bytes(content[place - 8 : place - 4], "big") - 1] ^= 1  # of the sum itself
    path.write_bytes(bytes(content))
    fault = only_fault(sphere)
    assert fault.file == f"patterns/{NAMES[1]}.png" and "the check sum of its part 'IDAT' is wrong" in fault.problem


SCENE = cv2.GaussianBlur(np.random.default_rng(0).random((96, 128, 3)).astype(np.float32), (0, 0), 4)
SCENE = ((SCENE - SCENE.min()) / np.ptp(SCENE) * 220 + 20).astype(np.uint8)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_orientation_is_turned_as_pillow_turns_it(tmp_path, orientation):
    path = tmp_path / "a.png"
    Image.fromarray(SCENE).save(path, exif=tag(orientation))
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


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_photograph_is_shrunk_to_means_of_squares_after_it_is_turned(tmp_path, dtype):
    pixels = SCENE.astype(dtype)[:95, :125] * (1 if dtype == np.uint8 else np.uint16(257))
    cv2.imwrite(str(tmp_path / "a.png"), pixels[..., ::-1])
    found = read_photograph(tmp_path / "a.png", 4)
    mean = pixels[:92, :124].reshape(23, 4, 31, 4, 3).mean((1, 3))
    assert found.dtype == dtype and found.shape == mean.shape and np.abs(found - mean).max() <= 0.5
    Image.fromarray(SCENE[:95, :125]).save(tmp_path / "turned.png", exif=tag(6))
    turned_first = np.rot90(SCENE[:95, :125], -1)[:124, :92].reshape(31, 4, 23, 4, 3).mean((1, 3))
    assert np.abs(read_photograph(tmp_path / "turned.png", 4) - turned_first).max() <= 0.5


def test_a_phone_picture_is_read_upright(tmp_path):
    path = tmp_path / "phone.HEIC"
    pillow_heif.from_pillow(Image.fromarray(SCENE)).save(path, quality=95, exif=tag(6).tobytes())
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


def _deep_with_alpha(path, alpha):
    deep = np.dstack([SCENE.astype(np.uint16)[..., ::-1] * np.uint16(257), np.full(SCENE.shape[:2], alpha, np.uint16)])
    cv2.imwrite(str(path), deep)


@pytest.mark.parametrize("ending", [".png", ".tif"])
def test_photographs_may_have_an_opaque_alpha_a_palette_of_greys_or_one_bit(tmp_path, ending):
    path, grey = tmp_path / f"a{ending}", SCENE[..., 0]
    palette = Image.fromarray(grey).convert("P", palette=Image.Palette.ADAPTIVE, colors=256)
    for image, expected in (
        (Image.fromarray(SCENE).convert("RGBA"), SCENE),
        (Image.fromarray(grey).convert("LA"), grey),
        (palette, np.array(palette.convert("L"))),
        (Image.new("1", (128, 96)), np.zeros_like(grey)),
        (Image.new("1", (128, 96), 1), np.full_like(grey, 255)),
    ):
        image.save(path)
        pixels = read_photograph(path)
        np.testing.assert_array_equal(pixels, expected)
        header = photograph_header(path)
        assert (header.h, header.w) == pixels.shape[:2] and header.mode == ("grey" if pixels.ndim == 2 else "RGB")
    _deep_with_alpha(path, 65535)
    np.testing.assert_array_equal(read_photograph(path), SCENE.astype(np.uint16) * np.uint16(257))
    assert photograph_header(path).bits == 16


def test_photographs_that_are_cut_out_or_have_few_colours_are_refused_with_the_command_that_converts(tmp_path):
    path = tmp_path / "a.png"
    cut = np.dstack([SCENE, np.full(SCENE.shape[:2], 255, np.uint8)])
    cut[3, 4, 3] = 254
    deep = tmp_path / "b.png"
    _deep_with_alpha(deep, 65534)
    for name, image, problem in (
        (path, Image.fromarray(cut), "is transparent in places"),
        (path, Image.fromarray(SCENE).convert("P"), "has a palette of colours"),
        (deep, None, "is transparent in places"),
    ):
        if image is not None:
            image.save(name)
        for read in (read_photograph, photograph_header):
            with pytest.raises(FileError, match=problem) as caught:
                read(name)
            assert f"{tmp_path}/*.png" in caught.value.remedy and "convert('RGB')" in caught.value.remedy
