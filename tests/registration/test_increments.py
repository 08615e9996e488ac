"""Increments of similarities about a pivot."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarities, exps_at, log_at, logs_at
from tests.registration.graph_edges import exp_at

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


def test_many_similarities_do_what_each_of_them_does():
    rng = np.random.default_rng(1)
    x, centre, radius = rng.normal(size=(2, 5, 7)), rng.normal(size=(5, 3)), rng.uniform(0.5, 2, 5)
    a, b = (exps_at(part, centre, radius, 2.0) for part in x)
    ones = list(zip(a.each(), b.each(), strict=True))
    wanted = {"product": (a @ b, [p @ q for p, q in ones]), "inverse": (a.inverse(), [p.inverse() for p, _ in ones])}
    for many, each in wanted.values():
        np.testing.assert_allclose([S.matrix() for S in many.each()], [S.matrix() for S in each], atol=1e-12)
    points = [p.points(c[None])[0] for (p, _), c in zip(ones, centre, strict=True)]
    np.testing.assert_allclose(a.points(centre), points, atol=1e-12)
    logs = [log_at(p, c, r) for (p, _), c, r in zip(ones, centre, radius, strict=True)]
    np.testing.assert_allclose(logs_at(a, centre, radius), logs, atol=1e-12)
    some = np.array([3, 0])
    again = Similarities.of([a.each()[k] for k in some])
    assert np.array_equal(again.R, a.chosen(some).R) and np.array_equal(again.t, a.chosen(some).t)
