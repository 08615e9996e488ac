"""Connected components, against a flood fill."""

import numpy as np
import pytest

from sl_nerfstudio.geometry.numerics import component_labels


def _flooded(a, b, nodes):
    """Number of each node's component, by walking along edges from every node that has none."""
    label = [-1] * nodes
    for number, start in enumerate(range(nodes)):
        todo = [start] if label[start] < 0 else []
        while todo:
            k = todo.pop()
            if label[k] < 0:
                label[k] = number
                todo += [j for i, j in [*zip(a, b, strict=True), *zip(b, a, strict=True)] if i == k]
    return np.array(label)


@pytest.mark.parametrize("seed", range(10))
def test_nodes_have_the_same_label_exactly_where_edges_connect_them(seed):
    rng = np.random.default_rng(seed)
    nodes, edges = int(rng.integers(1, 30)), int(rng.integers(0, 25))
    a, b = rng.integers(0, nodes, (2, edges))  # some edges twice, some from a node to itself
    found, true = component_labels(a, b, nodes), _flooded(a.tolist(), b.tolist(), nodes)
    np.testing.assert_array_equal(found[:, None] == found, true[:, None] == true)
    assert sorted(set(found.tolist())) == list(range(found.max() + 1))


def test_an_edge_that_is_given_many_times_still_joins():
    assert component_labels(np.zeros(256, dtype=int), np.ones(256, dtype=int), 2).tolist() == [0, 0]
