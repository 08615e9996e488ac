import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, geman_mcclure_weight
from sl_nerfstudio.parallel import compiled


def test_the_factor_turns_a_median_deviation_into_a_standard_deviation():
    x = np.random.default_rng(0).normal(3.0, 2.0, 10**6)
    assert MAD_TO_SIGMA * np.median(np.abs(x - np.median(x))) == pytest.approx(2.0, rel=5e-3)


@given(st.floats(0, 1e6))
def test_the_weight_is_the_slope_of_the_kernel(squared):
    """Geman-McClure's cost of a squared residual s is s / (1 + s)."""
    h = 1e-6 * (1 + squared)
    ahead, behind = ((s / (1 + s)) for s in (squared + h, squared - h))
    weight = geman_mcclure_weight(squared)
    assert weight == pytest.approx((ahead - behind) / (2 * h), rel=1e-3, abs=1e-9)
    assert 0 < weight <= 1


def test_arrays_tensors_and_compiled_loops_have_the_same_weights():
    squared = np.array([0.0, 0.25, 1.0, 9.0, 1e4])
    expected = [1.0, 0.64, 0.25, 0.01, 1 / 10001**2]
    np.testing.assert_allclose(geman_mcclure_weight(squared), expected)
    np.testing.assert_allclose(geman_mcclure_weight(torch.from_numpy(squared)).numpy(), expected)
    in_loop = compiled(geman_mcclure_weight)
    np.testing.assert_allclose([in_loop(s) for s in squared], expected)
