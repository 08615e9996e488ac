"""Connected components against a flood fill, robust kernels, evenly spaced indices."""

from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.geometry.numerics import (
    MAD_TO_SIGMA,
    all_finite,
    component_labels,
    evenly_spaced,
    geman_mcclure_weight,
)
from sl_nerfstudio.parallel import compiled


def _flooded(a, b, nodes):
    """Number of each node's component, by walking along edges from every node that has none."""
    label = [-1] * nodes
    for number, start in enumerate(range(nodes)):
        todo = [start] if label[start] < 0 else []
        while todo:
            k = todo.pop()
            if label[k] < 0:
                label[k] = number
                todo += [j for i, j in [*zip(a, b, strict=True), *zip(b, a, strict=True)] if i == k]
    return np.array(label)


@pytest.mark.parametrize("seed", range(10))
def test_nodes_have_the_same_label_exactly_where_edges_connect_them(seed):
    rng = np.random.default_rng(seed)
    nodes, edges = int(rng.integers(1, 30)), int(rng.integers(0, 25))
    a, b = rng.integers(0, nodes, (2, edges))  # some edges twice, some from a node to itself
    found, true = component_labels(a, b, nodes), _flooded(a.tolist(), b.tolist(), nodes)
    np.testing.assert_array_equal(found[:, None] == found, true[:, None] == true)
    assert sorted(set(found.tolist())) == list(range(found.max() + 1))


def test_an_edge_that_is_given_many_times_still_joins():
    assert component_labels(np.zeros(256, dtype=int), np.ones(256, dtype=int), 2).tolist() == [0, 0]


def test_the_factor_turns_a_median_deviation_into_a_standard_deviation():
    x = np.random.default_rng(0).normal(3.0, 2.0, 10**6)
    assert MAD_TO_SIGMA * np.median(np.abs(x - np.median(x))) == pytest.approx(2.0, rel=5e-3)


def test_arrays_tensors_and_compiled_loops_have_the_same_weights():
    squared = np.array([0.0, 0.25, 1.0, 9.0, 1e4])
    expected = [1.0, 0.64, 0.25, 0.01, 1 / 10001**2]
    np.testing.assert_allclose(geman_mcclure_weight(squared), expected)
    np.testing.assert_allclose(geman_mcclure_weight(torch.from_numpy(squared)).numpy(), expected)
    in_loop = compiled(geman_mcclure_weight)
    np.testing.assert_allclose([in_loop(s) for s in squared], expected)


@given(st.integers(1, 2**40), st.integers(1, 300))
def test_indices_are_the_nearest_to_an_exactly_even_spacing(length, count):
    index = evenly_spaced(length, count)
    assert index.shape == (count,) and index.dtype == np.int64
    assert index[0] == 0 and index.max() < length and (np.diff(index) >= 0).all()
    for k in (0, count // 3, count // 2, count - 1):
        exact = Fraction(k * (length - 1), max(count - 1, 1))
        assert abs(index[k] - exact) <= Fraction(1, 2)  # a float32 has 24 bits: it would end beyond the table
    assert len(evenly_spaced(0, 0)) == 0


@given(st.integers(0, 2**32 - 1), st.integers(0, 5))
def test_vectors_are_finite_where_all_their_numbers_are(seed, n):
    rng = np.random.default_rng(seed)
    values = rng.choice([0.0, 1.0, np.nan, np.inf, -np.inf], (7, 3, n), p=[0.5, 0.3, 0.1, 0.05, 0.05])
    assert np.array_equal(all_finite(values), np.isfinite(values).all(-1))
    assert np.array_equal(all_finite(values[:, :0]), np.ones((7, 0), dtype=bool))
