"""Bilinear look-up: exact for what bilinear functions are, by the scan's pixel convention."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.pattern.grid import sample_bilinear


@given(st.integers(0, 10_000))
def test_a_bilinear_image_is_reproduced_between_its_pixels(seed):
    rng = np.random.default_rng(seed)
    h, w = rng.integers(2, 12, 2)
    a, b, c, d = rng.uniform(-1, 1, 4)

    def value(x, y):
        return a + b * x + c * y + d * x * y

    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    uv = rng.uniform((0.5, 0.5), (w - 0.5, h - 0.5), (50, 2))
    image = value(x, y).astype(np.float32)
    np.testing.assert_allclose(sample_bilinear(image, uv), value(*uv.T), atol=2e-4)


def test_pixel_centres_are_at_one_half_and_rims_are_kept():
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    uv = np.array([[0.5, 0.5], [3.5, 2.5], [1.0, 0.5], [-5.0, 0.5], [99.0, 99.0]])
    assert sample_bilinear(image, uv).tolist() == [0, 11, 0.5, 0, 11]


def test_unknown_places_stay_unknown_and_shapes_are_kept():
    uv = np.full((2, 3, 2), 1.0)
    uv[0, 1, 0] = np.nan
    out = sample_bilinear(np.ones((4, 4), np.float32), uv)
    assert out.shape == (2, 3)
    assert np.isnan(out[0, 1]) and np.isfinite(out).sum() == 5
