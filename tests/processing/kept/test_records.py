"""Values come back exactly as they were, and nothing else than data comes back."""

import json
import math
import pickle
from dataclasses import dataclass
from io import BytesIO

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sl_nerfstudio.processing.records import decode, digest, encode

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
