"""Which pairs are accepted, which of two results is better, and how much each counts."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.pairs import (
    PairMatch,
    Rival,
    edge_weights,
    is_accepted,
    is_ambiguous,
    quality,
)


def match(i: int, j: int, fitness: float = 0.9, overlap: float = 0.5, ratio: float = 0.2) -> PairMatch:
    S = Similarity.identity()
    return PairMatch(i, j, S, np.eye(7), overlap, fitness, 0.02, (Rival(S, ratio),), 0.5, 0.0, np.zeros(7))


def test_a_pair_needs_overlap_and_fitness():
    assert is_accepted(match(0, 1))
    assert not is_accepted(match(0, 1, fitness=0.59))
    assert not is_accepted(match(0, 1, overlap=0.14))
    assert is_ambiguous(match(0, 1, ratio=0.9)) and not is_ambiguous(match(0, 1, ratio=0.8))


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1))
def test_quality_grows_with_overlap_and_fitness_and_falls_with_ambiguity(overlap, fitness, ratio):
    value = quality(match(0, 1, fitness, overlap, ratio))
    assert 0 <= value <= 1
    assert quality(match(0, 1, min(1.0, fitness + 0.1), overlap, ratio)) >= value
    assert quality(match(0, 1, fitness, min(1.0, overlap + 0.1), ratio)) >= value
    assert quality(match(0, 1, fitness, overlap, 1.0)) <= value


@given(st.lists(st.tuples(st.floats(0.6, 1), st.floats(0, 1)), min_size=1, max_size=12))
def test_weights_prefer_pairs_that_fit_like_the_good_ones(pairs):
    edges = [match(0, 1, fitness=f, ratio=r) for f, r in pairs]
    weight = edge_weights(edges)
    fitness = np.array([f for f, _ in pairs])
    assert ((weight >= 0.02) & (weight <= 1)).all()
    clear = np.array([r <= 0.85 for _, r in pairs])
    good = fitness >= np.quantile(fitness, 0.75)
    np.testing.assert_array_equal(weight[good & clear], 1.0)
    np.testing.assert_array_equal(weight[good & ~clear], 0.5)
    order = np.argsort(fitness[clear])
    assert (np.diff(weight[clear][order]) >= 0).all()


def test_there_are_no_weights_without_pairs():
    assert len(edge_weights([])) == 0
