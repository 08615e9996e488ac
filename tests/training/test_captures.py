"""Random captures and graphs: the truth that comes with them is right."""

import numpy as np
import pytest

from sl_nerfstudio.decoding.grid_graph import STEPS, neighbourhoods
from sl_nerfstudio.pattern.codes import rotate_codes
from training.captures import random_capture
from training.graphs import Damage, damage_graph, soft_scores
from training.patterns import CELLS, PatternStock, draw_pattern, random_grid


@pytest.fixture(scope="module")
def captures():
    rng = np.random.default_rng(0)
    stock = PatternStock(rng, 2)
    return [random_capture(rng, stock, 64) for _ in range(40)]


def test_captures_are_complete_and_finite(captures):
    for capture in captures:
        assert capture.channels.shape == (2, 64, 64) and np.isfinite(capture.channels).all()
        assert capture.lit.shape == capture.certain.shape == capture.symbol.shape == (32, 32)
        inside = capture.coords[capture.lit & capture.certain]
        assert ((inside > -0.5) & (inside < CELLS - 0.5)).all()
    assert 0.3 < np.mean([capture.lit.mean() for capture in captures]) < 0.95


def test_lines_are_bright_where_the_truth_has_lines(captures):
    """Correlation of contrast and distance from a line, over all captures, difficult ones included."""
    near, seen = [], []
    for capture in captures:
        where = capture.lit & capture.certain
        off = np.abs(capture.coords - np.rint(capture.coords)).min(-1)[where]
        near.append(off < 0.12)
        seen.append(capture.channels[0].reshape(32, 2, 32, 2).mean((1, 3))[where])
    assert np.corrcoef(np.concatenate(near), np.concatenate(seen))[0, 1] > 0.35


def test_the_same_seed_gives_the_same():
    def draw():
        rng = np.random.default_rng(4)
        return random_capture(rng, PatternStock(rng, 1), 48)

    a, b = draw(), draw()
    assert np.array_equal(a.channels, b.channels) and np.array_equal(a.coords, b.coords)


def test_nodes_of_drawn_patterns_are_where_the_codes_say():
    pattern = draw_pattern(random_grid(np.random.default_rng(0)))
    middle = np.rint((np.arange(CELLS) + 0.5) * pattern.period).astype(int)
    plain = pattern.codes == 0
    assert pattern.pictures[..., 0][np.ix_(middle, middle)][plain].min() > 0.95


@pytest.mark.parametrize("turn", range(4))
def test_damaged_graphs_are_parts_of_the_turned_pattern(turn):
    codes = np.random.default_rng(1).integers(0, 5, (18, 25)).astype(np.int8)
    graph = damage_graph(np.random.default_rng(2), codes, Damage(0, 0.2), turn)
    turned = rotate_codes(codes, turn)
    assert (graph.score.argmax(-1) == turned[tuple(graph.place.T)]).all()
    for direction, step in enumerate(STEPS):
        a = np.nonzero(graph.neighbour[:, direction] >= 0)[0]
        b = graph.neighbour[a, direction]
        assert (graph.place[b] == graph.place[a] + step).all()
        assert (graph.neighbour[b, (direction + 2) % 4] == a).all()
    assert neighbourhoods(graph.neighbour).max() < len(graph.place)


def test_the_stated_share_of_symbols_is_misread():
    symbol = np.random.default_rng(0).integers(0, 5, 4000).astype(np.int8)
    score = soft_scores(np.random.default_rng(1), symbol, 0.3)
    assert np.allclose(score.sum(-1), 1, atol=1e-5) and score.min() >= 0
    assert 0.27 < (score.argmax(-1) != symbol).mean() < 0.33
