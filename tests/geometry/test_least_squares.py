"""Levenberg-Marquardt against scipy, blocks against dense equations, covariance against the scatter of estimates."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from sl_nerfstudio.geometry.least_squares import BlockEquations, NormalEquations, minimise
from sl_nerfstudio.geometry.numerics import geman_mcclure_cost, geman_mcclure_curvature, geman_mcclure_weight

T = np.linspace(0, 3, 40)


def curve(x):
    """Amplitude, rate and offset of a decay."""
    return x[0] * np.exp(-x[1] * T) + x[2]


def derivatives(x):
    decay = np.exp(-x[1] * T)
    return np.stack([decay, -x[0] * T * decay, np.ones_like(T)], 1)


def fitted(data, start, scale=1.0, **options):
    """The decay in unknowns of other units: `x = scale * u`."""
    return minimise(
        np.asarray(start) / scale,
        lambda u: NormalEquations.of(derivatives(scale * u) * scale, curve(scale * u) - data),
        lambda u, step: u + step,
        lambda u: 0.5 * float(((curve(scale * u) - data) ** 2).sum()),
        **options,
    )


@given(st.integers(0, 10**6))
def test_the_minimum_is_that_of_scipy_in_any_units(seed):
    rng = np.random.default_rng(seed)
    truth = np.array([rng.uniform(1, 3), rng.uniform(0.5, 2), rng.uniform(-1, 1)])
    data = curve(truth) + rng.normal(0, 0.05, len(T))
    start = truth * rng.uniform(0.7, 1.4, 3)
    found = fitted(data, start)
    theirs = least_squares(lambda x: curve(x) - data, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(found.state, theirs.x, atol=1e-5)
    assert found.converged and found.cost <= theirs.cost * (1 + 1e-8)
    scale = np.array([1e3, 1e-3, 1e5])
    other = fitted(data, start, scale)
    np.testing.assert_allclose(other.state * scale, found.state, rtol=1e-7, atol=1e-7)
    assert other.iterations == found.iterations


def test_without_noise_the_truth_comes_back_and_running_out_of_steps_is_said():
    truth = np.array([2.0, 1.0, 0.5])
    found = fitted(curve(truth), [1.0, 0.4, 0.0])
    np.testing.assert_allclose(found.state, truth, atol=1e-9)
    assert not fitted(curve(truth), [1.0, 0.4, 0.0], iterations=2).converged


def test_covariance_is_the_scatter_of_estimates():
    rng, truth, sigma = np.random.default_rng(1), np.array([2.0, 1.0, 0.5]), 0.02
    found = [fitted(curve(truth) + rng.normal(0, sigma, len(T)), truth) for _ in range(1500)]
    scatter = np.cov(np.stack([one.state for one in found]).T)
    stated = sigma**2 * found[0].equations.covariance()
    sigmas = np.sqrt(np.outer(stated.diagonal(), stated.diagonal()))
    np.testing.assert_allclose(scatter / sigmas, stated / sigmas, atol=0.1)


def test_undetermined_directions_are_not_moved_along():
    J = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0]])
    equations = NormalEquations.of(J, np.array([1.0, 2.0]))
    np.testing.assert_allclose(equations.step(0.0), [-0.5, -0.5, 0.0], atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        NormalEquations(np.zeros((2, 2)), np.zeros(2)).covariance()


@given(st.integers(0, 10**6), st.sampled_from([0.0, 1e-3, 1.0]))
def test_eliminated_blocks_give_the_steps_of_the_dense_equations(seed, damping):
    rng = np.random.default_rng(seed)
    s, b, k = 4, 3, 2
    J = np.zeros((b, 8, s + b * k))
    for i in range(b):
        J[i][:, :s] = rng.normal(size=(8, s))
        J[i][:, s + i * k : s + (i + 1) * k] = rng.normal(size=(8, k))
    dense = NormalEquations.of(J.reshape(-1, s + b * k), rng.normal(size=b * 8))
    own = [slice(s + i * k, s + (i + 1) * k) for i in range(b)]
    blocks = BlockEquations(
        dense.H[:s, :s],
        dense.g[:s],
        np.stack([dense.H[o, o] for o in own]),
        np.stack([dense.g[o] for o in own]),
        np.stack([dense.H[:s, o] for o in own]),
    )
    shared, rest = blocks.step(damping)
    np.testing.assert_allclose(np.concatenate([shared, rest.ravel()]), dense.step(damping), rtol=1e-7, atol=1e-9)
    assert blocks.decrement() == pytest.approx(dense.decrement(), rel=1e-7)
    np.testing.assert_allclose(blocks.covariance(), dense.covariance()[:s, :s], rtol=1e-7, atol=1e-9)
    shared = rng.normal(size=s)
    follow = blocks.blocks_after(shared) - blocks.blocks_after(np.zeros(s))
    np.testing.assert_allclose(follow, -blocks.slopes() @ shared, rtol=1e-6, atol=1e-9)
    best = np.linalg.solve(dense.H[s:, s:], -(dense.g[s:] + dense.H[s:, :s] @ shared))
    np.testing.assert_allclose(blocks.blocks_after(shared).ravel(), best, rtol=1e-6, atol=1e-9)


def test_a_weak_unknown_of_a_block_stays_as_uncertain_as_it_is():
    """One direction of the block is known a trillion times worse than the other, and the shared unknown hangs on it."""
    H, coupling = np.diag([1e12, 1.0]), np.array([[[0.0, 1.0]]])
    blocks = BlockEquations(np.array([[1.0001]]), np.zeros(1), H[None], np.zeros((1, 2)), coupling)
    assert blocks.covariance()[0, 0] == pytest.approx(1e4, rel=1e-6)


@given(st.floats(0, 50))
def test_the_kernels_weight_and_curvature_are_its_derivatives(squared):
    h = 1e-5 * (1 + squared)
    slope = (geman_mcclure_cost(squared + h) - geman_mcclure_cost(max(squared - h, 0))) / (h + min(squared, h))
    assert slope == pytest.approx(geman_mcclure_weight(squared), rel=1e-3, abs=1e-7)

    def plane(x, y):
        return geman_mcclure_cost(x * x + y * y)

    x, d = np.sqrt(squared), 1e-3
    laplacian = (plane(x + d, 0) + plane(x - d, 0) + plane(x, d) + plane(x, -d) - 4 * plane(x, 0)) / d**2
    assert laplacian / 4 == pytest.approx(geman_mcclure_curvature(squared), abs=1e-4)


def test_the_kernel_may_follow_the_noise_as_it_falls():
    """Outliers of every size leave no trace although the kernel begins as wide as the largest."""
    rng, truth, width = np.random.default_rng(4), np.array([2.0, 1.0, 0.5]), np.inf
    data = curve(truth) + rng.normal(0, 0.01, len(T))
    data[::5] += rng.uniform(0.2, 5, len(data[::5]))

    def residuals(x):
        return curve(x) - data

    def narrow(x):
        nonlocal width
        width = min(width, 3 * float(np.median(np.abs(residuals(x)))))

    found = minimise(
        truth * 1.5,
        lambda x: NormalEquations.of(derivatives(x), residuals(x), geman_mcclure_weight((residuals(x) / width) ** 2)),
        lambda x, step: x + step,
        lambda x: 0.5 * width**2 * float(geman_mcclure_cost((residuals(x) / width) ** 2).sum()),
        narrow=narrow,
    )
    assert found.converged and width < 0.05
    np.testing.assert_allclose(found.state, truth, atol=0.03)
