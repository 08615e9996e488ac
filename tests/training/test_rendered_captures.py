"""Random objects and their photographs: of one size, different, and with a truth that fits what is read."""

import numpy as np

from training.edge_captures import edge_capture
from training.rendered_captures import rendered_captures


def test_rendered_captures_can_be_read_and_their_truth_fits_what_is_read():
    found = list(rendered_captures(0, 2, 2))
    assert len(found) == 2 and all(one.image.shape == one.true.shape[:2] for one in found)
    captures = [edge_capture(one.image, one.grid, one.true) for one in found]
    errors = [np.linalg.norm(c.view.fitted - c.true, axis=-1) for c in captures if c is not None]
    assert errors and all(np.nanmedian(error) < 0.05 for error in errors)
