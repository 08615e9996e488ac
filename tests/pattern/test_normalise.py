"""Local normalisation: the pattern is recovered under any light, albedo and exposure."""

import numpy as np
import pytest

from sl_nerfstudio.pattern.grid import GridPattern, normalise_locally


@pytest.fixture(scope="module")
def pattern():
    return GridPattern(w=240, h=240, seed=1).render()


def _disc(pattern):
    y, x = np.mgrid[: pattern.shape[0], : pattern.shape[1]]
    return (x - 120) ** 2 + (y - 110) ** 2 < 90**2


def test_albedo_shading_and_room_light_are_taken_out(pattern):
    y, x = np.mgrid[:240, :240] / 240
    shading = 0.15 + 0.8 * x * (0.6 + 0.4 * np.cos(9 * y))
    mask = _disc(pattern)
    out = normalise_locally(0.03 + shading * pattern, mask, 16.0, float(pattern.mean()), float(pattern.std()))
    inner = mask & np.roll(mask, 8, 0) & np.roll(mask, -8, 0) & np.roll(mask, 8, 1) & np.roll(mask, -8, 1)
    a, b = out[inner], pattern[inner]
    assert np.corrcoef(a, b)[0, 1] > 0.97
    assert (a @ b) / np.linalg.norm(a) / np.linalg.norm(b) > 0.985
    assert np.corrcoef(shading[inner] * b, b)[0, 1] < 0.93  # what there was to be taken out


def test_gain_and_offset_change_nothing(pattern):
    mask = _disc(pattern)
    once = normalise_locally(pattern, mask, 12.0)
    np.testing.assert_allclose(normalise_locally(0.2 * pattern + 0.1, mask, 12.0), once, atol=2e-3)


def test_outside_is_zero_and_does_not_leak_in(pattern):
    mask = _disc(pattern)
    noise = np.random.default_rng(0).uniform(0, 100, pattern.shape)
    out = normalise_locally(np.where(mask, pattern, noise), mask, 12.0)
    assert (out[~mask] == 0).all()
    assert np.array_equal(out, normalise_locally(np.where(mask, pattern, 0), mask, 12.0))
    assert out.min() >= 0 and out.max() <= 1


def test_an_empty_mask_and_a_flat_image():
    flat = np.full((20, 20), 0.4)
    assert (normalise_locally(flat, np.zeros((20, 20), bool), 3.0) == 0).all()
    np.testing.assert_allclose(normalise_locally(flat, np.ones((20, 20), bool), 3.0, mean=0.3), 0.3, atol=1e-3)
