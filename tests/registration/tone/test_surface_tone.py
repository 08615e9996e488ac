"""The tone of a surface: what of an image's brightness belongs to the surface, not to light and view."""

import numpy as np
import pytest

from sl_nerfstudio.registration.settings import ToneSettings
from sl_nerfstudio.registration.surfaces import surface_tone

SIZE = 120
CAMERA = np.array([0.0, 0.0, 4.0])  # the ball's centre is the origin; axes as the camera's
SETTINGS = ToneSettings()


def ball() -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a ball of radius one, NaN beside it; camera axes."""
    x, y = np.meshgrid(np.linspace(-1.1, 1.1, SIZE), np.linspace(1.1, -1.1, SIZE))
    with np.errstate(invalid="ignore"):
        normal = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], -1)
    normal[~np.isfinite(normal[..., 2])] = np.nan
    return normal - CAMERA, normal


def texture(p: np.ndarray) -> np.ndarray:
    return np.exp(0.2 * np.cos(24 * p[..., 0]) * np.cos(21 * p[..., 1] + 2) * np.cos(9 * p[..., 2]))


def returned(albedo: np.ndarray, projector: np.ndarray, gloss: float = 0.0) -> np.ndarray:
    """Light of a matte ball with a highlight (Blinn and Phong)."""
    point, normal = ball()
    ray = projector - point
    distance = np.linalg.norm(ray, axis=-1, keepdims=True)
    half = ray / distance - point / np.linalg.norm(point, axis=-1, keepdims=True)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    matte = albedo * (normal * ray / distance).sum(-1)
    return (matte + gloss * (normal * half).sum(-1).clip(0) ** 40) / distance[..., 0] ** 2


def tone(light: np.ndarray, projector: np.ndarray) -> np.ndarray:
    point, normal = (np.nan_to_num(part) for part in ball())
    return surface_tone(light, point, normal, projector, SETTINGS)


LEFT, RIGHT = np.array([-1.5, 0.5, 0.0]), np.array([1.2, -0.3, -0.5])


def alike(a: np.ndarray, b: np.ndarray) -> float:
    both = np.isfinite(a) & np.isfinite(b)
    assert both.sum() > 1000
    return float(np.corrcoef(a[both], b[both])[0, 1])


@pytest.mark.parametrize("gloss", [0.0, 0.5])
def test_the_tone_is_that_of_the_texture_wherever_the_light_comes_from(gloss):
    albedo = texture(ball()[1])
    found = [tone(returned(albedo, at, gloss), at) for at in (LEFT, RIGHT)]
    assert alike(*found) > (0.93 if gloss == 0 else 0.75)
    assert alike(found[0], np.log(albedo)) > 0.9


def test_a_highlight_is_not_a_tone():
    """A surface without texture, under light and gloss, is nearly even."""
    even, textured = (tone(returned(a, LEFT, 0.5), LEFT) for a in (np.ones((SIZE, SIZE)), texture(ball()[1])))
    assert np.nanstd(even) < 0.1 * np.nanstd(textured)


def test_exposure_and_unit_do_not_matter():
    light = returned(texture(ball()[1]), LEFT)
    once = tone(light, LEFT)
    np.testing.assert_allclose(tone(7 * light, LEFT), once, atol=1e-5)
    point, normal = (np.nan_to_num(part) for part in ball())
    np.testing.assert_allclose(surface_tone(light, 1e3 * point, normal, 1e3 * LEFT, SETTINGS), once, atol=1e-5)


def test_what_is_dark_oblique_or_small_has_no_tone():
    light = returned(texture(ball()[1]), RIGHT)
    found = tone(light, RIGHT)
    point, normal = ball()
    with np.errstate(invalid="ignore"):
        oblique = (normal * (RIGHT - point)).sum(-1) / np.linalg.norm(RIGHT - point, axis=-1) < SETTINGS.least_cosine
    assert np.isnan(found[oblique]).all() and np.isfinite(found).sum() > 3000
    light[:, :60] = 0.0  # shadow
    light[70, 90] = np.nan
    found = tone(light, RIGHT)
    assert np.isnan(found[:, :60]).all() and np.isnan(found[70, 90]) and np.isfinite(found[76, 84])
    light[5:, 60:] = np.nan
    assert np.isnan(tone(light, RIGHT)).all()
