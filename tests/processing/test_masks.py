"""Masks: which files count, found by name, checked before anything slow, applied before calibration, never stale."""

import json

import numpy as np
import pytest
from PIL import Image

from sl_nerfstudio.decoding.decoder import Decoded, DecodingError
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.frames import run_frame_stage
from sl_nerfstudio.processing.inputs import read_inputs
from sl_nerfstudio.processing.masks import find_masks, read_mask
from sl_nerfstudio.processing.process import process
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.document import FileError
from sl_nerfstudio.scan.images import encode_png
from tests.processing.ramp_scan import NAMES

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


SIZE = (130, 130)


def _mask(rows=slice(None)):
    mask = np.zeros(SIZE, dtype=bool)
    mask[rows] = True
    return mask


def _write(folder, masks):
    folder.mkdir(exist_ok=True)
    for name, mask in masks.items():
        (folder / f"{name}.png").write_bytes(encode_png(mask.astype(np.uint8) * np.uint8(255)))
    return folder


UPPER = {name: _mask(slice(0, 75)) for name in NAMES}


@pytest.mark.parametrize(
    ("masks", "words"),
    [
        (None, "is no folder"),
        ({}, "holds no masks"),
        ({NAMES[0]: _mask(), "other": _mask()}, r"has no mask for 3 of 4 frames: a 2, a 3, a 10\n.*name of the frame"),
        (
            UPPER | {NAMES[1]: _mask()[:50], NAMES[3]: np.zeros(SIZE, bool)},
            r"a 2.png: is 130 x 50 pixels.* \(and 1 more cannot be used: a 10.png\)",
        ),
        (UPPER, "holds several masks for a 3"),
    ],
)
def test_folders_whose_masks_cannot_be_used_are_refused_with_all_names_at_once(tmp_path, masks, words):
    if masks is not None:
        _write(tmp_path / "m", masks)
    if masks is UPPER:
        (tmp_path / "m" / f"{NAMES[2]}.bmp").write_bytes(b"x")
    with pytest.raises(FileError, match=words):
        find_masks(tmp_path / "m", dict.fromkeys(NAMES, SIZE))


def test_a_mask_limits_everything_that_was_decoded(tmp_path):
    masks = find_masks(_write(tmp_path / "m", UPPER), dict.fromkeys(NAMES, SIZE))
    ones = np.ones((*SIZE, 2), np.float32)
    found = masks.applied(NAMES[0], Decoded(ones, np.ones(SIZE, bool), ones[..., 0]))
    assert (np.isfinite(found.coords).all(-1) == UPPER[NAMES[0]]).all() and found.rate == 1
    assert (found.mask == UPPER[NAMES[0]]).all() and ((found.pattern == 1) == UPPER[NAMES[0]]).all()
    ones[:80] = np.nan
    with pytest.raises(DecodingError, match=r"no decoded pixel is inside its mask, .*a 1.png\n.*inverted"):
        masks.applied(NAMES[0], Decoded(ones, np.ones(SIZE, bool), ones[..., 0]))
    _write(tmp_path / "m", {NAMES[0]: _mask()})
    with pytest.raises(UserError, match=r"a 1.png: was changed while sl-process was running"):
        masks.applied(NAMES[0], Decoded(ones, np.ones(SIZE, bool), ones[..., 0]))


@pytest.mark.slow
def test_a_changed_mask_counts_in_the_next_run_and_needs_no_decoding(ramp_scan, ramps_registered, tmp_path):
    captures = find_captures(ramp_scan.root / "images", True)
    folder, work, seen = tmp_path / "m", tmp_path / "w", []
    for masks in (UPPER, {name: _mask() for name in NAMES}):
        config = ramp_scan.config(tmp_path / "s", masks=_write(folder, masks), work=work)
        results = run_frame_stage(config, read_inputs(config).job, captures)
        for result, mask in zip(results, masks.values(), strict=True):
            known = np.isfinite(result.cloud.coords).all(-1)
            assert known.any() and not (known & ~mask).any()
        seen.append((results, json.loads((work / "manifest.json").read_text())))
    (first, before), (second, after) = seen
    assert all(not a.resumed and b.resumed and b.mask_share > a.mask_share for a, b in zip(first, second, strict=True))
    assert before["settings"]["masks"] == str(folder)
    assert before["settings"]["masks_digest"] != after["settings"]["masks_digest"]


def test_the_scan_holds_what_is_inside_the_masks_and_no_frame_without_anything(ramp_scan, ramps_registered, tmp_path):
    corner = np.zeros(SIZE, dtype=bool)
    corner[:2, :2] = True
    masks = _write(tmp_path / "m", UPPER | {NAMES[3]: corner})
    config = ramp_scan.config(tmp_path / "s", masks=masks, no_adjust=True)
    result = process(config, lambda *_: "", lambda _: None)
    assert [frame.in_scan for frame in result.frames] == [True, True, True, False]
    for frame in read_scan(tmp_path / "s").frames:
        outside = ~UPPER[frame.name]
        assert np.isnan(frame.read_coords()[outside]).all() and not frame.read_mask()[outside].any()
        assert frame.read_mask().any() and frame.read_image().any()
    assert result.frames[3].stage == "decoding" and "no decoded pixel is inside its mask" in result.frames[3].reason
