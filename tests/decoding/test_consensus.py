"""Beliefs of single nodes become assignments that agree with each other and with the symbols."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.decoding.grid_graph import (
    Assignment,
    GridGraph,
    agree,
    believe,
    choose_turn,
)
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


def settle(belief, graph, codes=CODES):
    """From beliefs to places."""
    return Assignment(2, agree(believe(belief, graph.neighbour), graph, codes))


@pytest.mark.parametrize("certainty", [1.0, 0.6])
def test_nodes_that_agree_get_their_places(certainty):
    graph, true = graph_of(5, 6, certainty)
    found = settle(belief_in(true), graph)
    assert found.known.all()
    np.testing.assert_array_equal(found.place, true)


@given(st.integers(0, 10_000))
def test_single_wrong_nodes_are_outvoted(seed):
    graph, true = graph_of(5, 6)
    rng = np.random.default_rng(seed)
    places = true.copy()
    wrong = rng.choice(len(true), 4, replace=False)
    places[wrong] = rng.integers(0, CODES.shape, (4, 2))
    found = settle(belief_in(places), graph)
    assert found.known.mean() > 0.9
    np.testing.assert_array_equal(found.place[found.known], true[found.known])


def test_a_piece_that_believes_in_a_wrong_place_is_moved_to_where_its_symbols_fit():
    graph, true = graph_of(5, 6)
    found = settle(belief_in(true + (2, -3)), graph)
    assert found.known.all()
    np.testing.assert_array_equal(found.place, true)


def test_symbols_of_another_pattern_are_dropped():
    graph, true = graph_of(5, 6)
    other = np.random.default_rng(9).integers(0, 5, CODES.shape).astype(np.int8)
    assert not settle(belief_in(true), graph, other).known.any()


def test_nodes_without_a_belief_get_the_place_that_follows_from_their_neighbours():
    graph, true = graph_of(5, 6)
    belief = belief_in(true)
    belief[14] = -9.0  # a node in the middle
    found = settle(belief, graph)
    np.testing.assert_array_equal(found.place[14], true[14])


def test_nodes_on_another_surface_are_cut_off():
    """Lines seem to continue to the right, but the symbols there are those of another place."""
    graph, true = graph_of(6, 8)
    elsewhere = true[:, 1] >= ORIGIN[1] + 5
    moved = (true + (-4, -6)) % CODES.shape
    score = graph.score.copy()
    score[elsewhere] = np.eye(5, dtype=np.float32)[CODES[moved[elsewhere, 0], moved[elsewhere, 1]]]
    found = settle(belief_in(true), GridGraph(graph.place, graph.neighbour, score))
    right = true[:, 1] < ORIGIN[1] + 4
    np.testing.assert_array_equal(found.place[right], true[right])
    far = true[:, 1] == ORIGIN[1] + 7
    assert not found.known[far].any()


def test_too_few_nodes_are_dropped_and_no_nodes_are_no_error():
    graph, true = graph_of(1, 3)
    assert not settle(belief_in(true), graph).known.any()


def test_the_more_pieces_there_are_the_more_evidence_each_needs():
    graph, true = graph_of(2, 4)  # eight nodes: enough for one piece, too few for one of hundreds
    assert settle(belief_in(true), graph).known.all()
    copies = 300
    rng = np.random.default_rng(0)
    junk = rng.integers(0, 5, (copies, len(true)))
    score = np.concatenate([graph.score, np.eye(5, dtype=np.float32)[junk.reshape(-1)]])
    shift = len(true) * np.arange(copies + 1)[:, None, None]
    neighbour = np.where(graph.neighbour >= 0, graph.neighbour + shift, -1).reshape(-1, 4).astype(np.int32)
    many = GridGraph(np.tile(graph.place, (copies + 1, 1)), neighbour, score)
    assert not settle(belief_in(np.tile(true, (copies + 1, 1))), many).known.any()


def test_the_turn_is_that_in_which_most_nodes_are_recognised():
    best = np.full((20, 4), -6.0, dtype=np.float32)
    best[:14, 2] = best[14:, 3] = -0.1
    assert choose_turn(best) == 2
    assert choose_turn(best[14:]) == 3
    texture = np.random.default_rng(0).uniform(-8, -4, (3000, 4)).astype(np.float32)
    assert choose_turn(np.concatenate([best, texture])) == 2
