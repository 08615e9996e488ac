"""Which node is which: the graph network, window matching, and consensus among neighbours."""

import numpy as np
import pytest

from benchmarks.baselines.window_matching import match_windows
from sl_nerfstudio.decoding.grid_detection import NodeRecogniser
from sl_nerfstudio.decoding.grid_graph import (
    OFFSETS,
    GridGraph,
    agree,
    believe,
    neighbourhoods,
    one_hot,
    turned_pattern,
)
from sl_nerfstudio.pattern.codes import code_array, rotate_codes
from sl_nerfstudio.pattern.grid import GridPattern
from training.graphs import Damage, damage_graph

CODES = code_array(20, 24, seed=5)


@pytest.fixture(scope="module")
def recogniser():
    return NodeRecogniser(GridPattern(w=480, h=400, codes=CODES))


def graphs(damage, count=6):
    for index in range(count):
        rng = np.random.default_rng([9, index])
        yield damage_graph(rng, CODES, damage, index % 4, 0.5)


def test_turned_pattern_lists_every_node_of_every_turn():
    pattern = turned_pattern(CODES)
    assert len(pattern.symbol) == 4 * CODES.size
    for turn in range(4):
        mine = pattern.turn == turn
        turned = rotate_codes(CODES, turn)
        assert (pattern.symbol[mine] == turned[tuple(pattern.place[mine].T)]).all()
        for k, (di, dj) in enumerate(OFFSETS):
            around = pattern.around[mine, k]
            assert (pattern.place[around[around >= 0]] == pattern.place[mine][around >= 0] + (di, dj)).all()
            assert (pattern.turn[around[around >= 0]] == turn).all()


@pytest.mark.parametrize(
    "damage, most_wrong",
    [
        (Damage(0, 0, 0), 0.002),
        (Damage(0.1, 0.2), 0.005),
        (Damage(0.2, 0.2), 0.01),
        (Damage(0.2, 0.1, torn=True), 0.06),
    ],
)
def test_nearly_every_node_finds_its_place_and_hardly_any_a_wrong_one(recogniser, damage, most_wrong):
    right = wrong = total = 0
    for graph in graphs(damage):
        assignment = recogniser.assign(graph.as_grid())
        assert assignment.turn == graph.turn
        same = (assignment.place == graph.place).all(-1)
        right, total = right + same.sum(), total + len(same)
        wrong += (~same & assignment.known).sum()
    assert right > 0.93 * total and wrong <= most_wrong * total


def test_the_graph_network_beats_window_matching_on_damaged_graphs(recogniser):
    pattern = turned_pattern(CODES)
    for misread in (0.1, 0.2, 0.3):
        network = windows = total = 0
        for graph in graphs(Damage(misread, 0.2)):
            around = neighbourhoods(graph.neighbour)
            judged = recogniser.logits(graph.as_grid()).argmax(1).numpy()
            true = (pattern.turn == graph.turn) & (pattern.place[:, None] == graph.place).all(-1).T  # node, candidate
            rows = np.arange(len(graph.place))
            network += true[rows, judged].sum()
            matched = match_windows(graph.score, around, pattern)
            windows += (true[rows, matched] & (matched >= 0)).sum()
            total += len(rows)
        assert network > windows + 0.1 * total


def test_window_matching_corrects_one_symbol_and_is_certain_without_damage():
    pattern = turned_pattern(CODES)
    rng = np.random.default_rng(0)
    graph = damage_graph(rng, CODES, Damage(0, 0, 0), 1, 1.0)
    around = neighbourhoods(graph.neighbour)
    score = one_hot(rotate_codes(CODES, 1)[tuple(graph.place.T)]).numpy()
    hurt = score.copy()
    hurt[100] = np.roll(hurt[100], 1)
    for scores in (score, hurt):
        matched = match_windows(scores, around, pattern)
        assert (matched >= 0).mean() > 0.99
        assert (pattern.place[matched[matched >= 0]] == graph.place[matched >= 0]).all()
        assert (pattern.turn[matched[matched >= 0]] == 1).all()


def test_small_pieces_that_fit_several_places_are_dropped():
    codes = np.tile(np.arange(4, dtype=np.int8).reshape(2, 2), (6, 6))  # the same windows everywhere
    index = np.arange(9).reshape(3, 3)
    neighbour = np.full((9, 4), -1, dtype=np.int32)
    neighbour[index[:, :-1], 0], neighbour[index[:, 1:], 2] = index[:, 1:], index[:, :-1]
    neighbour[index[:-1], 1], neighbour[index[1:], 3] = index[1:], index[:-1]
    score = np.eye(5, dtype=np.float32)[codes[4:7, 4:7].reshape(-1)]
    belief = np.full((9, 12, 12), -8, dtype=np.float32)
    for k in range(9):
        belief[k, 4 + k // 3, 4 + k % 3] = 0  # every node is certain, and all agree
    graph = GridGraph(np.zeros((9, 2), np.float32), neighbour, score)
    assert (agree(believe(belief, neighbour), graph, codes) < 0).all()
    unique = np.random.default_rng(0).integers(0, 5, (12, 12)).astype(np.int8)
    certain = GridGraph(graph.place, neighbour, np.eye(5, dtype=np.float32)[unique[4:7, 4:7].reshape(-1)])
    settled = agree(believe(belief, neighbour), certain, unique)
    assert (settled >= 0).all() and (settled[0] == (4, 4)).all()
