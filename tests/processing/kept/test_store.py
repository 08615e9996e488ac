"""Decoded frames are loaded again, but only for the same images and the same decoder."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.decoding.decoder import Decoded
from sl_nerfstudio.decoding.decoders import DECODERS
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.processing.captures import CapturedFrame
from sl_nerfstudio.processing.records import DecodedStore, Manifest


@pytest.fixture
def frame(tmp_path):
    path = tmp_path / "främe 1.png"
    path.write_bytes(b"pixels")
    return CapturedFrame("främe 1", (path,))


@pytest.fixture
def decoded():
    rng = np.random.default_rng(0)
    coords = rng.random((5, 7, 2)).astype(np.float32)
    coords[2] = np.nan
    light = np.where(np.isnan(coords[..., 0]), np.nan, rng.random((5, 7))).astype(np.float32)
    return Decoded(coords, rng.random((5, 7)) > 0.3, rng.random((5, 7)).astype(np.float32), light)


def test_a_frame_is_loaded_as_it_was_saved(tmp_path, frame, decoded):
    store = DecodedStore(tmp_path / "work", "a decoder")
    key = store.key(frame)
    assert store.load(frame, key) is None
    saved = store.save(frame, key, decoded)
    again = DecodedStore(tmp_path / "work", "a decoder").load(frame, key)
    for one in (saved, again):
        np.testing.assert_array_equal(one.coords, decoded.coords)
        np.testing.assert_array_equal(one.mask, decoded.mask)
        np.testing.assert_array_equal(one.pattern, saved.pattern)
        np.testing.assert_array_equal(one.light, saved.light)
    np.testing.assert_allclose(saved.pattern, decoded.pattern, atol=1e-5)
    np.testing.assert_allclose(saved.light, decoded.light, rtol=1e-3)


def test_light_that_was_not_measured_stays_unknown(tmp_path, frame, decoded):
    store = DecodedStore(tmp_path, "a decoder")
    key = store.key(frame)
    assert store.save(frame, key, replace(decoded, light=None)).light is None
    assert store.load(frame, key).light is None


def test_other_images_or_another_decoder_make_another_key(tmp_path, frame):
    store = DecodedStore(tmp_path, "a decoder")
    key = store.key(frame)
    assert DecodedStore(tmp_path, "another").key(frame) != key
    frame.images[0].write_bytes(b"other pixels")
    assert store.key(frame) != key


def test_damaged_files_count_as_not_decoded(tmp_path, frame, decoded):
    store = DecodedStore(tmp_path, "a decoder")
    key = store.key(frame)
    store.save(frame, key, decoded)
    path = next((tmp_path / "decoded").iterdir())
    content = path.read_bytes()
    flipped = [bytearray(content) for _ in range(20)]
    for bad, place in zip(flipped, np.random.default_rng(0).integers(0, len(content), 20), strict=True):
        bad[place] ^= 1  # the checksums of the archive itself do not cover its names and headers
    for bad in (b"", content[: len(content) // 2], b"no archive", *flipped):
        path.write_bytes(bad)
        assert store.load(frame, key) is None


def test_every_pattern_has_its_own_key():
    keys = {
        DECODERS["graycode"](GrayCode(32, 24, 2)).key,
        DECODERS["graycode"](GrayCode(32, 24, 4)).key,
        DECODERS["network"](GridPattern(w=160, h=120)).key,
        DECODERS["network"](GridPattern(w=160, h=120, seed=1)).key,
    }
    assert len(keys) == 4


def test_the_manifest_is_kept_and_survives_damage(tmp_path):
    Manifest(tmp_path, {"decoder": "graycode"}).note("a", "k1", "decoded")
    second = Manifest(tmp_path, {"decoder": "graycode"})
    second.note("b", "", "failed in reading", "b.png: is empty")
    frames = json.loads((tmp_path / "manifest.json").read_text())["frames"]
    assert frames == {
        "a": {"key": "k1", "status": "decoded"},
        "b": {"key": "", "status": "failed in reading", "reason": "b.png: is empty"},
    }
    (tmp_path / "manifest.json").write_text("[")
    Manifest(tmp_path, {}).note("c", "k", "decoded")
    assert list(json.loads((tmp_path / "manifest.json").read_text())["frames"]) == ["c"]
