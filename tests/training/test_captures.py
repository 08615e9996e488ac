"""Random captures and graphs: the truth that comes with them is right."""

import numpy as np
import pytest

from sl_nerfstudio.decoding.grid_graph import STEPS, neighbourhoods
from sl_nerfstudio.pattern.codes import rotate_codes
from training.graphs import Damage, damage_graph
from training.patterns import PatternStock
from training.unet import random_capture


@pytest.fixture(scope="module")
def captures():
    rng = np.random.default_rng(0)
    stock = PatternStock(rng, 2)
    return [random_capture(rng, stock, 64) for _ in range(40)]


def test_lines_are_bright_where_the_truth_has_lines(captures):
    """Correlation of contrast and distance from a line, over all captures, difficult ones included."""
    near, seen = [], []
    for capture in captures:
        where = capture.lit & capture.certain
        off = np.abs(capture.coords - np.rint(capture.coords)).min(-1)[where]
        near.append(off < 0.12)
        seen.append(capture.channels[0].reshape(32, 2, 32, 2).mean((1, 3))[where])
    assert np.corrcoef(np.concatenate(near), np.concatenate(seen))[0, 1] > 0.35


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
