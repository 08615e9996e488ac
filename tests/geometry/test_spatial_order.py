"""Morton's curve against its definition, bit by bit, and its purpose: neighbours follow each other."""

import numpy as np

from sl_nerfstudio.model.exporters import spatial_order


def test_points_are_ordered_by_the_interleaved_bits_of_their_cells() -> None:
    cells = np.random.default_rng(4).integers(0, 1024, (500, 3))
    cells[0], cells[1] = 0, 1023  # the bounding cube is that of all cells
    place = [sum((int(c[k]) >> bit & 1) << (3 * bit + k) for bit in range(10) for k in range(3)) for c in cells]
    p = cells * 0.25 + np.array([-7.0, 3.0, 1e3])
    assert np.array_equal(spatial_order(p), np.argsort(place, kind="stable"))


def test_neighbours_follow_each_other() -> None:
    p = np.random.default_rng(5).normal(size=(4000, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    order = spatial_order(p)
    assert np.array_equal(np.sort(order), np.arange(4000))
    steps = [np.linalg.norm(np.diff(q, axis=0), axis=1).mean() for q in (p, p[order])]
    assert steps[1] < 0.1 * steps[0]


def test_points_without_extent() -> None:
    assert spatial_order(np.zeros((0, 3))).tolist() == []
    assert spatial_order(np.ones((3, 3))).tolist() == [0, 1, 2]
