"""Planes: heights, sides, and their fit to points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.object_separation.planes import Plane, fit_plane


@given(st.integers(0, 2**31 - 1))
def test_a_fit_gives_back_the_plane_whatever_the_weights(seed):
    rng = np.random.default_rng(seed)
    normal = rng.standard_normal(3)
    plane = Plane(normal / np.linalg.norm(normal), float(rng.uniform(-50, 50)))
    p = plane.offset * plane.normal + rng.uniform(-30, 30, (40, 2)) @ plane.axes()
    found = fit_plane(p, rng.uniform(0.1, 10, 40))
    np.testing.assert_allclose(plane.heights(p), 0, atol=1e-9)
    np.testing.assert_allclose(found.heights(p), 0, atol=1e-8)
    assert abs(found.normal @ plane.normal) == pytest.approx(1)


@given(st.integers(0, 2**31 - 1))
def test_axes_are_perpendicular_and_the_other_side_has_the_opposite_heights(seed):
    rng = np.random.default_rng(seed)
    normal = rng.standard_normal(3)
    plane = Plane(normal / np.linalg.norm(normal), 3.0)
    np.testing.assert_allclose(plane.axes() @ plane.axes().T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(plane.axes() @ plane.normal, 0, atol=1e-12)
    p = rng.standard_normal((5, 3))
    np.testing.assert_allclose(plane.flipped().heights(p), -plane.heights(p))
