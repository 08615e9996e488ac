"""Increments of similarities about a pivot."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from sl_nerfstudio.registration.increments import exp_at, log_at

increments = arrays(np.float64, 7, elements=st.floats(-1, 1))
pivots = arrays(np.float64, 3, elements=st.floats(-5, 5))


@settings(max_examples=25)
@given(increments, pivots, st.floats(0.1, 10))
def test_points_move_as_the_formula_says_and_the_logarithm_undoes_it(x, centre, radius):
    S = exp_at(x, centre, radius, 2.0)
    p = np.random.default_rng(0).normal(size=(4, 3))
    turned = (p - centre) @ Rotation.from_rotvec(x[3:6]).as_matrix().T
    np.testing.assert_allclose(S.points(p), centre + np.exp(x[6]) * turned + radius * x[:3], atol=1e-9)
    np.testing.assert_allclose(log_at(S, centre, radius), x, atol=1e-9)


def test_the_scale_of_a_step_is_bounded():
    x = np.array([0.0] * 6 + [3.0])
    assert exp_at(x, np.zeros(3), 1.0, 0.5).scale == np.exp(0.5)
    assert exp_at(-x, np.zeros(3), 1.0, 0.5).scale == np.exp(-0.5)
