"""Means in wide windows are those of the window itself, written as a sum."""

import numpy as np
import pytest

from sl_nerfstudio.pattern.grid import gaussian_window


def direct(values, sigma):
    """By the definition, one axis after the other, in float64."""
    for axis, size in enumerate(values.shape[:2]):
        at = np.arange(size)
        weight = np.exp(-((at[:, None] - at) ** 2) / (2 * sigma**2)) / (np.sqrt(2 * np.pi) * sigma)
        values = np.moveaxis(np.tensordot(weight, values, (1, axis)), 0, axis)
    return values


@pytest.mark.parametrize("sigma", [2.0, 5.9, 6.0, 11.3, 28.0])
@pytest.mark.parametrize("shape", [(97, 130), (131, 96, 3)])
def test_means_are_those_of_the_definition(sigma, shape):
    """A step, a corner and noise: also across the border of the image, where it continues with zeros."""
    rng = np.random.default_rng(0)
    values = rng.normal(0.5, 0.3, shape).astype(np.float32)
    values[:40, 60:] += 1
    found, expected = gaussian_window(values, sigma), direct(values.astype(float), sigma)
    assert found.shape == shape and found.dtype == np.float32
    assert np.abs(found - expected).max() < 0.03 * np.ptp(expected)
    assert np.abs(found - expected).mean() < 0.004 * np.ptp(expected)


@pytest.mark.parametrize("sigma", [4.0, 19.0])
def test_a_linear_image_keeps_its_values_inside(sigma):
    y, x = np.mgrid[:300, :300].astype(np.float32)
    found = gaussian_window(np.dstack([2 * x + y, np.ones_like(x)]), sigma)
    inner = np.s_[100:200, 100:200]
    np.testing.assert_allclose(found[..., 0][inner], (2 * x + y)[inner], rtol=1e-3)
    np.testing.assert_allclose(found[..., 1][inner], 1, rtol=1e-3)


def test_quotients_are_means_over_a_part():
    inside = np.zeros((120, 120), dtype=np.float32)
    inside[30:90, 30:90] = 1
    means = gaussian_window(np.dstack([inside, 7 * inside]), 15.0)
    np.testing.assert_allclose((means[..., 1] / means[..., 0])[25:95, 25:95], 7, rtol=1e-5)
