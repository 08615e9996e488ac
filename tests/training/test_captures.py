"""Random captures, photographs and graphs: the truth that comes with them is right; the fit of right matches."""

import numpy as np
import pytest

from sl_nerfstudio.decoding.grid_graph import STEPS, neighbourhoods
from sl_nerfstudio.pattern.codes import rotate_codes
from training.edge_captures import edge_capture
from training.graphs import Damage, damage_graph
from training.matching import fit_logistic
from training.patterns import PatternStock
from training.rendered_captures import rendered_captures
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


@pytest.mark.slow
def test_rendered_captures_can_be_read_and_their_truth_fits_what_is_read():
    found = list(rendered_captures(0, 2, 2))
    assert len(found) == 2 and all(one.image.shape == one.true.shape[:2] for one in found)
    captures = [edge_capture(one.image, one.grid, one.true) for one in found]
    errors = [np.linalg.norm(c.view.fitted - c.true, axis=-1) for c in captures if c is not None]
    assert errors and all(np.nanmedian(error) < 0.05 for error in errors)


def test_the_weights_that_made_the_data_are_found():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(200_000, 3)) * [1.0, 20.0, 0.1] + [0.0, 100.0, -2.0]
    constant, weights = -1.0, np.array([0.7, -0.05, 8.0])
    right = rng.random(len(x)) < 1 / (1 + np.exp(-(constant + 15 + x @ weights + 5)))
    found, slopes = fit_logistic(x, right)
    np.testing.assert_allclose(slopes, weights, rtol=0.05)
    assert abs(found - (constant + 20)) < 1.0
    p = 1 / (1 + np.exp(-(found + x @ slopes)))
    assert abs(p.mean() - right.mean()) < 1e-3  # a fit of the largest likelihood is calibrated
