"""Values, decoded frames and clouds come back as they were; damaged files, and what is no data, do not."""

import json
import math
import pickle
from dataclasses import dataclass, replace
from io import BytesIO

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sl_nerfstudio.decoding.decoder import Decoded
from sl_nerfstudio.decoding.decoders import DECODERS
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.processing.captures import CapturedFrame
from sl_nerfstudio.processing.records import DecodedStore, Manifest, decode, digest, encode

_PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
_ARRAYS = arrays.arrays(
    st.sampled_from([np.float32, np.float64, np.int64, bool]), arrays.array_shapes(min_dims=0, max_dims=3, min_side=0)
)
_VALUES = st.recursive(
    _PLAIN | _ARRAYS, lambda inner: st.lists(inner, max_size=3) | st.lists(inner, max_size=3).map(tuple)
)


@dataclass(frozen=True)
class Pair:
    first: object
    second: object = 3


def _same(a, b):
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, Pair):
        return isinstance(b, Pair) and _same(a.first, b.first) and _same(a.second, b.second)
    if isinstance(a, float) and math.isnan(a):
        return isinstance(b, float) and math.isnan(b)
    return type(a) is type(b) and a == b


@given(_VALUES, _VALUES)
def test_values_come_back_exactly(first, second):
    value = Pair(first, (Pair(second), [first]))
    assert _same(decode(encode(value), [Pair]), value)
    assert digest(value) == digest(decode(encode(value), [Pair]))


def test_tensors_stay_tensors_and_scalars_become_plain():
    tensor = torch.linspace(0, 1, 5, dtype=torch.float64)
    back = decode(encode((tensor, np.float32(0.1), np.bool_(True))), [])
    assert torch.equal(back[0], tensor) and back[1:] == (float(np.float32(0.1)), True) and type(back[2]) is bool


@pytest.mark.parametrize(
    "other",
    [Pair(1, 2.0), Pair(2, 1), Pair(1, (2,)), Pair(np.ones(2), 2), Pair(np.ones((2, 1)), 2), Pair(np.ones(2, "f4"), 2),
     Pair(np.array([1.0, -0.0]), 2), (1, 2), Pair(None, 2)],
)  # fmt: skip
def test_other_values_have_another_digest(other):
    assert digest(other) != digest(Pair(1, 2))
    assert digest(Pair(np.array([1.0, 0.0]), 2)) != digest(other)


def test_what_is_no_data_is_not_kept():
    for value in (object(), {1: 2}, Pair, print, 1j):
        with pytest.raises(TypeError, match="cannot be kept"):
            encode(value)


def test_reading_makes_only_the_classes_that_were_asked_for():
    with pytest.raises(KeyError):
        decode(encode(Pair(1)), [])
    buffer = BytesIO()
    tree = np.frombuffer(json.dumps({"array": 0}).encode(), np.uint8)
    np.savez(buffer, tree=tree, array0=np.array([Pair], dtype=object))
    assert b"Pair" in pickle.dumps(Pair) and b"Pair" in buffer.getvalue()
    with pytest.raises(ValueError, match="allow_pickle=False"):
        decode(buffer.getvalue(), [Pair])


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
    notes = ("decoded to 4 px", "overexposed")
    return Decoded(coords, rng.random((5, 7)) > 0.3, rng.random((5, 7)).astype(np.float32), light, notes)


@pytest.mark.parametrize("lit", [True, False])
def test_a_frame_is_loaded_as_it_was_saved(tmp_path, frame, decoded, lit):
    decoded = decoded if lit else replace(decoded, light=None)
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
        assert one.notes == decoded.notes
    np.testing.assert_allclose(saved.pattern, decoded.pattern, atol=1e-5)
    assert saved.light is None if not lit else np.allclose(saved.light, decoded.light, rtol=1e-3, equal_nan=True)


def test_other_images_or_another_decoder_make_another_key(tmp_path, frame):
    store = DecodedStore(tmp_path, "a decoder")
    key = store.key(frame)
    assert DecodedStore(tmp_path, "another").key(frame) != key
    frame.images[0].write_bytes(b"other pixels")
    assert store.key(frame) != key


def test_every_pattern_and_every_version_of_a_decoder_has_its_own_key(monkeypatch):
    gray, grid = DECODERS["graycode"], DECODERS["network"]
    keys = [gray(GrayCode(32, 24, 2)).key, gray(GrayCode(32, 24, 4)).key]
    keys += [gray(GrayCode(32, 24, 2), order_stated=True).key, gray(GrayCode(32, 24, 2, centred=True)).key]
    keys += [grid(GridPattern(w=160, h=120)).key, grid(GridPattern(w=160, h=120, seed=1)).key]
    monkeypatch.setattr(gray, "version", gray.version + 1)
    assert len({*keys, gray(GrayCode(32, 24, 2)).key}) == 7


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
