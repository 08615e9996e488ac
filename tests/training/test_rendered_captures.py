"""Random objects and their photographs: of one size, different, and with a truth that fits what is read."""

import numpy as np
import pytest

from training.edge_captures import edge_capture
from training.rendered_captures import SIZE, random_object, rendered_captures


@pytest.mark.parametrize("seed", range(12))
def test_objects_are_of_one_size_about_the_origin(seed):
    mesh = random_object(np.random.default_rng(seed))
    assert mesh.extents.max() == pytest.approx(SIZE) and np.abs(mesh.bounds.mean(0)).max() < 1e-6
    assert np.isfinite(mesh.vertices).all() and mesh.extents.min() > 0.02 * SIZE


def test_the_same_seed_gives_the_same_object_and_another_one_another():
    a, b, c = (random_object(np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.vertices, b.vertices)
    assert a.vertices.shape != c.vertices.shape or not np.allclose(a.vertices, c.vertices)


def test_rendered_captures_can_be_read_and_their_truth_fits_what_is_read():
    found = list(rendered_captures(0, 2, 2))
    assert len(found) == 2 and all(one.image.shape == one.true.shape[:2] for one in found)
    captures = [edge_capture(one.image, one.grid, one.true) for one in found]
    errors = [np.linalg.norm(c.view.fitted - c.true, axis=-1) for c in captures if c is not None]
    assert errors and all(np.nanmedian(error) < 0.05 for error in errors)
