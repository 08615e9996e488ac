"""Groups that contradict each other, and weak places in a graph, against brute force."""

import itertools

import networkx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.review.agreement import agreeing_groups, bridges, components
from tests.verdict.cases import ring

edges_of_eight = st.lists(
    st.tuples(st.integers(0, 7), st.integers(0, 7)).filter(lambda e: e[0] < e[1]), max_size=16, unique=True
)


@given(edges_of_eight)
def test_components_and_bridges_are_those_of_graph_theory(edges):
    graph = networkx.Graph(edges)
    graph.add_nodes_from(range(8))
    assert {frozenset(g) for g in components(edges, range(8))} == set(
        map(frozenset, networkx.connected_components(graph))
    )
    found = bridges(edges, range(8))
    assert {frozenset(edge) for edge, _ in found} == set(map(frozenset, networkx.bridges(graph)))
    for edge, part in found:
        assert len(set(edge) & set(part)) == 1  # one end on each side


@pytest.mark.parametrize("sizes", [(8,), (5, 3), (4, 4), (7, 1), (3, 3, 2)])
def test_groups_are_found_in_spite_of_pairs_that_agree_by_accident(sizes):
    label = np.repeat(np.arange(len(sizes)), sizes)
    rng = np.random.default_rng(0)
    excess = np.where(label[:, None] == label[None], 1.0, 8.0)
    for a, b in itertools.combinations(range(len(sizes)), 2):  # one accident between every two groups
        i, j = rng.choice(np.flatnonzero(label == a)), rng.choice(np.flatnonzero(label == b))
        if sizes[a] * sizes[b] > 3:
            excess[i, j] = excess[j, i] = 1.0
    groups = agreeing_groups(ring(excess))
    assert sorted(map(len, groups), reverse=True) == sorted(sizes, reverse=True)
    assert all(len(set(label[group])) == 1 for group in groups)


def test_frames_without_pairs_are_in_no_group():
    excess = np.full((4, 4), np.nan)
    excess[0, 1] = 1.0
    assert agreeing_groups(ring(excess)) == [[0, 1]]
    assert agreeing_groups(ring(np.full((3, 3), np.nan))) == []
