"""Phase unwrapping from nodes: exact within reach, and it stops at gaps and tears."""

import numpy as np

from sl_nerfstudio.decoding.grid_phases import spread


def field(h=40, w=50, period=10.0):
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    return np.stack([x / period + 3.2, y / period + 1.1], -1).astype(np.float32)


def wrapped(coords):
    return (coords - np.rint(coords)).astype(np.float32)


def node_at(coords, place):
    distance = np.abs(coords - np.array(place)[::-1]).sum(-1)
    return np.unravel_index(distance.argmin(), distance.shape)


def test_one_node_gives_its_surroundings_up_to_two_periods():
    coords, everywhere = field(), np.ones((40, 50), dtype=bool)
    place = np.array([[3, 5]], dtype=np.int32)  # row, column
    out = spread(wrapped(coords), everywhere, np.array([node_at(coords, (3, 5))], dtype=np.int32), place)
    known = np.isfinite(out[..., 0])
    assert np.allclose(out[known], coords[known], atol=1e-5)
    assert (known == (np.abs(coords - (5, 3)).max(-1) <= 2.0)).mean() > 0.97


def test_a_gap_and_a_tear_stop_it():
    coords, seen = field(), np.ones((40, 50), dtype=bool)
    coords[:, 30:] += 0.45
    seen[25] = False
    pixel = np.array([node_at(field(), (2, 5))], dtype=np.int32)
    out = spread(wrapped(coords), seen, pixel, np.array([[2, 5]], dtype=np.int32))
    known = np.isfinite(out[..., 0])
    assert known[:25, :30].all() and not known[25:].any() and not known[:, 30:].any()


def test_nodes_outside_the_image_or_the_mask_say_nothing():
    coords = field()
    pixel = np.array([[-1, 5], [100, 2], [3, 3]], dtype=np.int32)
    seen = np.zeros((40, 50), dtype=bool)
    out = spread(wrapped(coords), seen, pixel, np.zeros((3, 2), dtype=np.int32))
    assert np.isnan(out).all()
