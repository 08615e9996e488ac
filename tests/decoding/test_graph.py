"""The grid graph, from phases that are known exactly."""

import numpy as np
import pytest

from sl_nerfstudio.decoding.grid_graph import (
    OFFSETS,
    STEPS,
    build_graph,
    neighbourhoods,
    phase_maps,
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
def test_gradients_are_exact_for_an_affine_map_of_any_period(period, roll, shear):
    coords, jacobian = affine(period, roll, shear)
    inner = maps(coords).gradient[:, :, 6:-6, 6:-6]
    assert np.allclose(inner, jacobian[:, :, None, None], atol=1e-5)


@pytest.mark.parametrize("period, roll, shear", [(7, 0, 0), (7, 30, 0), (5, -25, 0.3), (12, 12, -0.4)])
def test_every_crossing_becomes_a_node_and_every_line_an_edge(period, roll, shear):
    coords, jacobian = affine(period, roll, shear)
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


def test_lines_do_not_join_across_a_tear():
    coords, _ = affine()
    coords[:, 40:, 1] += 0.5  # the right half slipped by half a period
    graph = build_graph(maps(coords))
    left = graph.place[:, 0] < 38  # the nodes at 39.9 show on the right of the tear too
    right_of_left = graph.neighbour[left, 0]
    assert not (graph.place[right_of_left[right_of_left >= 0], 0] > 39).any()


def test_no_nodes_where_the_pattern_is_not():
    coords, _ = affine()
    mask = np.zeros((H, W))
    mask[:, :40] = 1
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
