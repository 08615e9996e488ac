"""The solids of the benchmark of nearly symmetric objects."""

import numpy as np
import pytest

from benchmarks.registration.solids import ball, block, meshed
from sl_nerfstudio.synthesis.sdf import carve, union


def test_solids_are_what_they_say():
    solid = carve(0.0, union(0.0, block((0, 0, 0), (40, 30, 20), 0.01), ball((0, 0, 12), 9)), ball((20, 0, 0), 6))
    mesh = meshed(solid, (26, 22, 26), 0.5)
    assert mesh.is_watertight
    # a cap of 11 mm on a sphere of 9, less half a ball
    cap = np.pi * 11**2 * (3 * 9 - 11) / 3
    assert mesh.volume == pytest.approx(40 * 30 * 20 + cap - 2 / 3 * np.pi * 6**3, rel=0.01)
    with pytest.raises(ValueError, match="does not fit into its box"):
        meshed(solid, (18, 22, 26))
