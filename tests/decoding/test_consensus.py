"""Beliefs of single nodes become assignments that agree with each other and with the symbols."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.decoding.grid.consensus import agree, choose_turn
from sl_nerfstudio.decoding.grid.graph import GridGraph
from tests.decoding.test_graph import lattice

CODES = np.random.default_rng(3).integers(0, 5, (14, 16)).astype(np.int8)
ORIGIN = np.array([4, 6])  # where the lattice of a test truly is


def graph_of(rows, columns, certainty=1.0, origin=ORIGIN):
    """A complete lattice whose symbols were read with this certainty, and the true places of its nodes."""
    _, cells, neighbour = lattice(rows, columns)
    true = np.array(cells) + origin
    symbol = CODES[true[:, 0], true[:, 1]]
    score = np.full((len(true), 5), (1 - certainty) / 4, dtype=np.float32)
    score[np.arange(len(true)), symbol] = certainty
    return GridGraph(true[:, ::-1].astype(np.float32), neighbour, score), true


def belief_in(places):
    """Every node is certain of one place."""
    belief = np.full((len(places), *CODES.shape), -9.0, dtype=np.float32)
    belief[np.arange(len(places)), places[:, 0], places[:, 1]] = 0
    return belief


@pytest.mark.parametrize("certainty", [1.0, 0.6])
def test_nodes_that_agree_get_their_places(certainty):
    graph, true = graph_of(5, 6, certainty)
    found = agree(belief_in(true), graph, CODES, 2)
    assert found.turn == 2 and found.known.all()
    np.testing.assert_array_equal(found.place, true)


@given(st.integers(0, 10_000))
def test_single_wrong_nodes_are_outvoted(seed):
    graph, true = graph_of(5, 6)
    rng = np.random.default_rng(seed)
    places = true.copy()
    wrong = rng.choice(len(true), 4, replace=False)
    places[wrong] = rng.integers(0, CODES.shape, (4, 2))
    found = agree(belief_in(places), graph, CODES, 0)
    assert found.known.mean() > 0.9
    np.testing.assert_array_equal(found.place[found.known], true[found.known])


def test_a_piece_that_believes_in_a_wrong_place_is_moved_to_where_its_symbols_fit():
    graph, true = graph_of(5, 6)
    found = agree(belief_in(true + (2, -3)), graph, CODES, 0)
    assert found.known.all()
    np.testing.assert_array_equal(found.place, true)


def test_symbols_of_another_pattern_are_dropped():
    graph, true = graph_of(5, 6)
    other = np.random.default_rng(9).integers(0, 5, CODES.shape).astype(np.int8)
    assert not agree(belief_in(true), graph, other, 0).known.any()


def test_nodes_without_a_belief_get_the_place_that_follows_from_their_neighbours():
    graph, true = graph_of(5, 6)
    belief = belief_in(true)
    belief[14] = -9.0  # a node in the middle
    found = agree(belief, graph, CODES, 0)
    np.testing.assert_array_equal(found.place[14], true[14])


def test_nodes_on_another_surface_are_cut_off():
    """Lines seem to continue to the right, but the symbols there are those of another place."""
    graph, true = graph_of(6, 8)
    elsewhere = true[:, 1] >= ORIGIN[1] + 5
    moved = (true + (-4, -6)) % CODES.shape
    score = graph.score.copy()
    score[elsewhere] = np.eye(5, dtype=np.float32)[CODES[moved[elsewhere, 0], moved[elsewhere, 1]]]
    found = agree(belief_in(true), GridGraph(graph.place, graph.neighbour, score), CODES, 0)
    right = true[:, 1] < ORIGIN[1] + 4
    np.testing.assert_array_equal(found.place[right], true[right])
    far = true[:, 1] == ORIGIN[1] + 7
    assert not found.known[far].any()


def test_too_few_nodes_are_dropped_and_no_nodes_are_no_error():
    graph, true = graph_of(1, 3)
    assert not agree(belief_in(true), graph, CODES, 0).known.any()


def test_the_turn_is_that_of_most_nodes():
    turn_of = np.repeat(np.arange(4), 10)
    log_probability = np.full((20, 40), -6.0, dtype=np.float32)
    for node in range(20):
        log_probability[node, (20 if node < 14 else 30) + node % 10] = -0.1
    assert choose_turn(log_probability, turn_of) == 2
    assert choose_turn(log_probability[14:], turn_of) == 3
    assert choose_turn(log_probability[:, 30:], turn_of[30:]) == 3  # the others have no candidates
