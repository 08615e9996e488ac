"""Evenly spaced indices, exact for any length."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.geometry.numerics import evenly_spaced


@given(st.integers(1, 2**40), st.integers(1, 300))
def test_indices_are_the_nearest_to_an_exactly_even_spacing(length, count):
    index = evenly_spaced(length, count)
    assert index.shape == (count,) and index.dtype == np.int64
    assert index[0] == 0 and index.max() < length and (np.diff(index) >= 0).all()
    for k in (0, count // 3, count // 2, count - 1):
        exact = Fraction(k * (length - 1), max(count - 1, 1))
        assert abs(index[k] - exact) <= Fraction(1, 2)


@given(st.integers(2, 5000))
def test_as_many_as_there_are_is_every_one(length):
    assert np.array_equal(evenly_spaced(length, length), np.arange(length))


@pytest.mark.parametrize("length", [2**24 + 1, 2**24 + 3, 2**31 + 7])
def test_long_tables_end_at_their_last_row(length):
    """A float32 has 24 bits: spaced in floats, the last index lies beyond the table."""
    assert evenly_spaced(length, 2000)[-1] == length - 1
    assert len(np.unique(evenly_spaced(length, 2000))) == 2000


def test_none_is_none():
    assert len(evenly_spaced(0, 0)) == 0
