"""The grid graph, from phases that are known exactly."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.decoding.grid_graph import (
    OFFSETS,
    STEPS,
    Assignment,
    GridGraph,
    agree,
    believe,
    build_graph,
    choose_turn,
    neighbourhoods,
    phase_maps,
    symbol_log_likelihood,
    symbol_log_ratio,
)

H, W = 60, 80


def maps(coords, mask=None, symbol=None):
    angle = 2 * np.pi * coords
    vector = np.stack([np.cos(angle[..., 0]), np.sin(angle[..., 0]), np.cos(angle[..., 1]), np.sin(angle[..., 1])])
    mask = np.ones(coords.shape[:2]) if mask is None else mask
    symbol = np.zeros((5, *coords.shape[:2])) if symbol is None else symbol
    return phase_maps(mask.astype(np.float32), vector.astype(np.float32), symbol.astype(np.float32))


def affine(period=7.0, roll_deg=0.0, shear=0.0):
    a = np.radians(roll_deg)
    jacobian = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) @ np.array([[1, shear], [0, 1]]) / period
    x, y = np.meshgrid(np.arange(W), np.arange(H))
    return np.stack([x, y], -1) @ jacobian.T + (0.3, 0.4), jacobian


@pytest.mark.parametrize("period, roll, shear", [(7, 0, 0), (7, 30, 0), (5, -25, 0.3), (12, 12, -0.4), (3.2, 5, 0)])
def test_gradients_are_exact_every_crossing_becomes_a_node_and_every_line_an_edge(period, roll, shear):
    coords, jacobian = affine(period, roll, shear)
    gradient = maps(coords).gradient[:, :, 6:-6, 6:-6]
    assert np.allclose(gradient, jacobian[:, :, None, None], atol=1e-5)
    if period < 4:  # gradients are exact, but nodes are too near each other
        return
    graph = build_graph(maps(coords))
    at = graph.place @ jacobian.T + (0.3, 0.4)
    inner = (graph.place > 4).all(-1) & (graph.place < (W - 5, H - 5)).all(-1)
    assert np.allclose(at[inner], np.rint(at[inner]), atol=0.02)
    index = {tuple(cell): k for k, cell in enumerate(np.rint(at).astype(int))}
    assert len(index) == len(at)  # none twice
    inside = np.rint(
        coords[4:-4, 4:-4].reshape(-1, 2)[np.abs(coords - np.rint(coords)).max(-1)[4:-4, 4:-4].ravel() < 0.1]
    )
    assert {tuple(cell) for cell in inside.astype(int)} <= index.keys()
    for k in np.nonzero(inner)[0]:
        x, y = np.rint(at[k]).astype(int)
        for direction, (di, dj) in enumerate(STEPS):
            other = index.get((x + dj, y + di))
            if other is not None and inner[other]:
                assert graph.neighbour[k, direction] == other


def test_lines_do_not_join_across_a_tear_or_leave_the_mask():
    coords, _ = affine()
    coords[:, 40:, 1] += 0.5  # the right half slipped by half a period
    graph = build_graph(maps(coords))
    left = graph.place[:, 0] < 38  # the nodes at 39.9 show on the right of the tear too
    right_of_left = graph.neighbour[left, 0]
    assert not (graph.place[right_of_left[right_of_left >= 0], 0] > 39).any()
    mask = np.broadcast_to(np.arange(W) < 40, (H, W))  # where the pattern is not, there are no nodes
    assert (build_graph(maps(coords, mask)).place[:, 0] < 41).all()
    assert len(build_graph(maps(coords, np.zeros((H, W)))).place) == 0


def test_symbols_are_read_at_the_nodes():
    coords, _ = affine()
    symbol = np.zeros((5, H, W))
    cell = np.rint(coords).astype(int)
    truth = (cell[..., 0] + 2 * cell[..., 1]) % 5
    np.put_along_axis(symbol, truth[None], 6.0, axis=0)
    graph = build_graph(maps(coords, symbol=symbol))
    at = np.clip(np.rint(graph.place).astype(int), 0, (W - 1, H - 1))
    assert np.allclose(graph.score.sum(-1), 1, atol=1e-5)
    inner = (at > 2).all(-1) & (at < (W - 3, H - 3)).all(-1)
    assert (graph.score.argmax(-1) == truth[at[:, 1], at[:, 0]])[inner].all()


def lattice(rows, columns, without=()):
    index = np.full((rows + 2, columns + 2), -1, dtype=np.int32)
    cells = [(i, j) for i in range(rows) for j in range(columns) if (i, j) not in without]
    for k, (i, j) in enumerate(cells):
        index[i + 1, j + 1] = k
    neighbour = np.array([[index[i + 1 + di, j + 1 + dj] for di, dj in STEPS] for i, j in cells], dtype=np.int32)
    return index, cells, neighbour


@pytest.mark.parametrize("without", [(), ((3, 3),), ((2, 2), (3, 4), (4, 1))])
def test_neighbourhoods_are_the_lattice_also_around_missing_nodes(without):
    index, cells, neighbour = lattice(7, 8, without)
    table = neighbourhoods(neighbour)
    for k, (i, j) in enumerate(cells):
        for o, (di, dj) in enumerate(OFFSETS):
            inside = 0 <= i + di < 7 and 0 <= j + dj < 8
            expected = index[i + 1 + di, j + 1 + dj] if inside else -1
            assert table[k, o] in (expected, -1)  # never another node
            if not without:
                assert table[k, o] == expected
    centre = cells.index((3, 2))
    assert (table[centre] >= 0).sum() >= 25 - len(without) - 1


def test_walks_that_disagree_lead_nowhere():
    _, cells, neighbour = lattice(3, 3)
    a, b = cells.index((0, 1)), cells.index((1, 2))
    neighbour[a, 1] = cells.index((2, 1))  # a false line: down from (0, 1) skips a node
    table = neighbourhoods(neighbour)
    corner = cells.index((0, 0))
    assert table[corner, OFFSETS.index((1, 1))] == -1
    assert table[b, OFFSETS.index((1, 0))] == cells.index((2, 2))


# Symbols decide between places: right coordinates are likely, those of another place are not.


CODES = np.random.default_rng(0).integers(0, 5, (12, 14)).astype(np.int8)
PERIOD = 10
IDENTITY = np.array([[1.0, 0, 0], [0, 1.0, 0]])


def coords(shift=(0, 0)):
    """Periods (x, y) of the array, ten pixels each."""
    x, y = np.meshgrid(np.arange(14 * PERIOD) / PERIOD, np.arange(12 * PERIOD) / PERIOD)
    return (np.stack([x, y], -1) + shift).astype(np.float32)


def logits(certainty=6.0):
    """What a network says that reads every symbol rightly."""
    cell = np.clip(np.rint(coords()).astype(int), 0, (13, 11))
    symbol = CODES[cell[..., 1], cell[..., 0]]
    return (certainty * (np.arange(5)[:, None, None] == symbol)).astype(np.float32)


@given(st.lists(st.floats(0, 1), min_size=5, max_size=5).filter(lambda p: sum(p) > 0.1))
def test_likelihoods_stay_probabilities_and_never_exclude_a_symbol(share):
    score = (np.array([share]) / sum(share)).astype(np.float32)
    log = symbol_log_likelihood(score)
    assert np.exp(log).sum() == pytest.approx(1, abs=1e-5)
    assert log.min() >= np.log(0.03) - 1e-5
    assert (np.diff(log[0][np.argsort(score[0])]) >= 0).all()


def test_right_coordinates_are_likely_and_other_places_are_not():
    inner, symbol = np.s_[20:-30, 20:-30], logits()
    right = symbol_log_ratio(coords(), CODES, symbol, IDENTITY, float(PERIOD))[inner]
    assert right.min() > 1.0 and right.max() < np.log(5) + 0.01
    for shift in ((1, 0), (0, 1), (-1, 2)):
        wrong = symbol_log_ratio(coords(shift), CODES, symbol, IDENTITY, float(PERIOD))[inner]
        assert wrong.mean() < -0.5 and (wrong > 1.0).mean() < 0.05
    nothing = symbol_log_ratio(coords(), CODES, np.zeros_like(symbol), IDENTITY, float(PERIOD))
    assert np.abs(nothing).max() < 1e-5
    some = coords()
    some[:, 40:] = np.nan
    ratio = symbol_log_ratio(some, CODES, symbol, IDENTITY, float(PERIOD))
    assert ratio[20:-20, 20:35].min() > 1 and (ratio[:, 80:] == 0).all()
    half = np.pad(symbol[:, ::2, ::2], ((0, 0), (0, 0), (3, 0)))  # at half the resolution, and three places farther
    to_map = np.array([[0.5, 0, 3.0], [0, 0.5, 0]])
    assert symbol_log_ratio(coords(), CODES, half, to_map, float(PERIOD))[inner].min() > 1.0


# Beliefs of single nodes become assignments that agree with each other and with the symbols.


BELIEVED = np.random.default_rng(3).integers(0, 5, (14, 16)).astype(np.int8)
ORIGIN = np.array([4, 6])  # where the lattice of a test truly is


def graph_of(rows, columns, codes=BELIEVED, certainty=1.0):
    """A complete lattice whose symbols were read with this certainty, and the true places of its nodes."""
    _, cells, neighbour = lattice(rows, columns)
    true = np.array(cells) + ORIGIN
    score = np.full((len(true), 5), (1 - certainty) / 4, dtype=np.float32)
    score[np.arange(len(true)), codes[true[:, 0], true[:, 1]]] = certainty
    return GridGraph(true[:, ::-1].astype(np.float32), neighbour, score), true


def settle(places, graph, codes=BELIEVED):
    """From nodes that are each certain of one place, or of none where it is negative."""
    belief = np.full((len(places), *codes.shape), -9.0, dtype=np.float32)
    sure = places[:, 0] >= 0
    belief[sure, places[sure, 0], places[sure, 1]] = 0
    return Assignment(2, agree(believe(belief, graph.neighbour), graph, codes))


@pytest.mark.parametrize("certainty", [1.0, 0.6])
@pytest.mark.parametrize("off", [(0, 0), (2, -3)])  # the piece is moved to where its symbols fit
def test_nodes_that_agree_get_the_places_that_fit_their_symbols(certainty, off):
    graph, true = graph_of(5, 6, certainty=certainty)
    believed = true + off
    believed[14] = -1  # a node in the middle without a belief
    np.testing.assert_array_equal(settle(believed, graph).place, true)


def test_pieces_that_fit_nowhere_or_anywhere_or_are_too_small_are_dropped():
    graph, true = graph_of(5, 6)
    other = np.random.default_rng(9).integers(0, 5, BELIEVED.shape).astype(np.int8)
    assert not settle(true, graph, other).known.any()
    everywhere = np.tile(np.arange(4, dtype=np.int8).reshape(2, 2), (7, 8))
    graph, true = graph_of(3, 3, everywhere)
    assert not settle(true, graph, everywhere).known.any()
    graph, true = graph_of(1, 3)
    assert not settle(true, graph).known.any()


@given(st.integers(0, 10_000))
def test_single_wrong_nodes_are_outvoted(seed):
    graph, true = graph_of(5, 6)
    rng = np.random.default_rng(seed)
    places = true.copy()
    wrong = rng.choice(len(true), 4, replace=False)
    places[wrong] = rng.integers(0, BELIEVED.shape, (4, 2))
    found = settle(places, graph)
    assert found.known.mean() > 0.9
    np.testing.assert_array_equal(found.place[found.known], true[found.known])


def test_nodes_on_another_surface_are_cut_off():
    """Lines seem to continue to the right, but the symbols there are those of another place."""
    graph, true = graph_of(6, 8)
    elsewhere = true[:, 1] >= ORIGIN[1] + 5
    moved = (true + (-4, -6)) % BELIEVED.shape
    score = graph.score.copy()
    score[elsewhere] = np.eye(5, dtype=np.float32)[BELIEVED[moved[elsewhere, 0], moved[elsewhere, 1]]]
    found = settle(true, GridGraph(graph.place, graph.neighbour, score))
    right = true[:, 1] < ORIGIN[1] + 4
    np.testing.assert_array_equal(found.place[right], true[right])
    far = true[:, 1] == ORIGIN[1] + 7
    assert not found.known[far].any()


def test_the_more_pieces_there_are_the_more_evidence_each_needs():
    graph, true = graph_of(2, 4)  # eight nodes: enough for one piece, too few for one of hundreds
    assert settle(true, graph).known.all()
    copies = 300
    rng = np.random.default_rng(0)
    junk = rng.integers(0, 5, (copies, len(true)))
    score = np.concatenate([graph.score, np.eye(5, dtype=np.float32)[junk.reshape(-1)]])
    shift = len(true) * np.arange(copies + 1)[:, None, None]
    neighbour = np.where(graph.neighbour >= 0, graph.neighbour + shift, -1).reshape(-1, 4).astype(np.int32)
    many = GridGraph(np.tile(graph.place, (copies + 1, 1)), neighbour, score)
    assert not settle(np.tile(true, (copies + 1, 1)), many).known.any()


def test_the_turn_is_that_in_which_most_nodes_are_recognised():
    best = np.full((20, 4), -6.0, dtype=np.float32)
    best[:14, 2] = best[14:, 3] = -0.1
    assert choose_turn(best) == 2
    assert choose_turn(best[14:]) == 3
    texture = np.random.default_rng(0).uniform(-8, -4, (3000, 4)).astype(np.float32)
    assert choose_turn(np.concatenate([best, texture])) == 2
