"""The fit of the model that tells right matches from wrong ones."""

import numpy as np

from training.matching import fit_logistic


def test_the_weights_that_made_the_data_are_found():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(200_000, 3)) * [1.0, 20.0, 0.1] + [0.0, 100.0, -2.0]
    constant, weights = -1.0, np.array([0.7, -0.05, 8.0])
    right = rng.random(len(x)) < 1 / (1 + np.exp(-(constant + 15 + x @ weights + 5)))
    found, slopes = fit_logistic(x, right)
    np.testing.assert_allclose(slopes, weights, rtol=0.05)
    assert abs(found - (constant + 20)) < 1.0
    p = 1 / (1 + np.exp(-(found + x @ slopes)))
    assert abs(p.mean() - right.mean()) < 1e-3  # a fit of the largest likelihood is calibrated
