"""Masks of all frames: found by name, checked before anything slow, applied before calibration, never stale."""

import json
import sys

import numpy as np
import pytest

from sl_nerfstudio.cli.process import main
from sl_nerfstudio.decoding.decoder import Decoded, DecodingError
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.frames import run_frame_stage
from sl_nerfstudio.processing.inputs import read_inputs
from sl_nerfstudio.processing.masks import find_masks
from sl_nerfstudio.processing.process import process
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.document import FileError
from sl_nerfstudio.scan.images import encode_png
from tests.processing.ramp_scan import NAMES

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


def test_all_frames_without_a_mask_are_named_at_once(tmp_path):
    folder = _write(tmp_path / "m", {NAMES[0]: _mask(), "other": _mask()})
    with pytest.raises(FileError, match=r"has no mask for 3 of 4 frames: a 2, a 3, a 10\n.*name of the frame"):
        find_masks(folder, dict.fromkeys(NAMES, SIZE))


def test_all_masks_that_cannot_be_used_are_named_at_once(tmp_path):
    folder = _write(tmp_path / "m", UPPER | {NAMES[1]: _mask()[:50], NAMES[3]: np.zeros(SIZE, bool)})
    with pytest.raises(FileError, match=r"a 2.png: is 130 x 50 pixels.* \(and 1 more cannot be used: a 10.png\)"):
        find_masks(folder, dict.fromkeys(NAMES, SIZE))


def test_folders_that_cannot_be_meant_are_refused(tmp_path):
    with pytest.raises(FileError, match="is no folder"):
        find_masks(tmp_path / "nowhere", dict.fromkeys(NAMES, SIZE))
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileError, match="holds no masks"):
        find_masks(tmp_path / "empty", dict.fromkeys(NAMES, SIZE))
    folder = _write(tmp_path / "m", UPPER)
    (folder / f"{NAMES[2]}.bmp").write_bytes(b"x")
    with pytest.raises(FileError, match="holds several masks for a 3"):
        find_masks(folder, dict.fromkeys(NAMES, SIZE))


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


def test_the_scan_holds_only_what_is_inside_the_masks(ramp_scan, ramps_registered, tmp_path):
    config = ramp_scan.config(tmp_path / "s", masks=_write(tmp_path / "m", UPPER), no_adjust=True)
    process(config, lambda *_: "", lambda _: None)
    for frame in read_scan(tmp_path / "s").frames:
        outside = ~UPPER[frame.name]
        assert np.isnan(frame.read_coords()[outside]).all() and not frame.read_mask()[outside].any()
        assert frame.read_mask().any() and frame.read_image().any()


def test_a_frame_whose_mask_holds_nothing_decoded_is_left_out_by_name(ramp_scan, ramps_registered, tmp_path):
    corner = np.zeros(SIZE, dtype=bool)
    corner[:2, :2] = True
    masks = _write(tmp_path / "m", UPPER | {NAMES[3]: corner})
    config = ramp_scan.config(tmp_path / "s", masks=masks, no_adjust=True)
    result = process(config, lambda *_: "", lambda _: None)
    assert [frame.in_scan for frame in result.frames] == [True, True, True, False]
    assert result.frames[3].stage == "decoding" and "no decoded pixel is inside its mask" in result.frames[3].reason


def test_the_command_refuses_bad_masks_before_it_decodes(monkeypatch, ramp_scan, ramps_registered, tmp_path, capsys):
    folder = _write(tmp_path / "m", {NAMES[0]: _mask()})
    monkeypatch.setattr(sys, "argv", ["sl-process", *ramp_scan.flags(tmp_path / "s"), "--masks", str(folder)])
    with pytest.raises(SystemExit):
        main()
    assert "has no mask for 3 of 4 frames" in capsys.readouterr().err
    assert not (tmp_path / "s.work").exists()
