"""The parts of a photograph, each against a formula: textures, materials, light, lens, sensor."""

import cv2
import numpy as np
import pytest

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.synthesis.appearance import (
    LUMA,
    RANGES,
    REALISTIC,
    TEXTURES,
    Lamp,
    Lens,
    Material,
    Room,
    make_material,
    make_pattern,
    moved,
    tint,
)
from sl_nerfstudio.synthesis.photograph import Sensor, decode_jpeg


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_depend_on_the_place_alone(name):
    p = np.random.default_rng(0).uniform(-60, 60, (4000, 3)).astype(np.float32)
    one, again, other = (TEXTURES[name](120.0, np.random.default_rng(seed)) for seed in (3, 3, 4))
    value = one(p)
    assert value.dtype == np.float32 and value.min() >= 0 and value.max() <= 1
    assert value.std() > 0.05, "a texture that is nowhere visible"
    np.testing.assert_array_equal(value, again(p))
    np.testing.assert_allclose(value[::7], one(p[::7]), atol=2e-5)
    assert np.abs(value - other(p)).mean() > 0.05


def test_a_tint_keeps_the_luma_and_materials_stay_physical():
    rng = np.random.default_rng(1)
    assert tint(0.3, rng) @ LUMA == pytest.approx(1, rel=1e-5)
    p = rng.uniform(-60, 60, (500, 3))
    for ranges in RANGES.values():
        for seed in range(8):
            material = make_material(np.zeros(3), 120.0, ranges, ranges.texture_layers[1], np.random.default_rng(seed))
            albedo = material.albedo(p)
            assert albedo.min() >= 0.04 and albedo.max() <= 0.95
            low, high = ranges.texture_layers
            assert low <= len(material.layers) <= high


@pytest.mark.parametrize("exponent", [8.0, 30.0, 90.0])
def test_a_highlight_is_strongest_at_the_half_way_direction_and_returns_about_the_same_energy(exponent):
    material = Material(np.zeros(3), np.ones(3, dtype=np.float32), (), 0.2, exponent)
    cosine = np.linspace(0, 1, 4001).astype(np.float32)
    lobe = material.highlight(cosine)
    assert (np.diff(lobe) >= 0).all() and lobe[0] == 0
    # light from above is mirrored into half-way directions h; the outgoing solid angle is 4 cos(h) that of h
    mirrored = 2 * cosine**2 - 1
    energy = np.trapezoid if hasattr(np, "trapezoid") else np.trapz
    share = energy(lobe * np.maximum(mirrored, 0) * 4 * cosine * 2, cosine)
    assert share == pytest.approx(0.2, rel=0.12)


def test_the_projected_pattern_is_blurred_as_its_distance_demands():
    """The width of an edge is the blur's sigma: in focus, off the focal plane, and between two levels."""
    edge = np.zeros((40, 200), dtype=np.float32)
    edge[:, 100:] = 1
    pattern = make_pattern(edge, 500.0, 120.0, REALISTIC, np.random.default_rng(2))
    x = np.linspace(80, 120, 4001)
    uv = np.stack([x, np.full_like(x, 20.0)], 1)
    for distance in (pattern.focus, pattern.focus - 40, pattern.focus + 60):
        off = (pattern.focus / distance - 1) * pattern.focus / 60
        expected = np.hypot(pattern.in_focus, pattern.out_of_focus * off)
        assert pattern.sigma(np.array([distance]))[0] == pytest.approx(min(expected, 3.2), rel=1e-5)
        slope = np.diff(pattern.sample(uv, np.full(len(x), distance)))
        slope /= slope.sum()
        middle = (x[1:] + x[:-1]) / 2
        mean = slope @ middle
        assert mean == pytest.approx(100, abs=0.02)
        # between pixel centres a sharp step is a ramp one pixel wide
        assert slope @ (middle - mean) ** 2 == pytest.approx(expected**2 + 1 / 12, rel=0.1)


def test_the_lamp_follows_the_inverse_square_law_and_fades_to_the_corners():
    lamp = Lamp(np.ones(3, np.float32), 0.05, 0.3, 500.0)
    projector = Device(200, 160, 300.0, 300.0, 100.0, 80.0)
    uv = np.array([[100.0, 80.0], [100.0, 80.0], [0.0, 0.0]])
    np.testing.assert_allclose(lamp.strength(uv, np.array([500.0, 1000.0, 500.0]), projector), [1, 0.25, 0.7])
    np.testing.assert_allclose(lamp.through_pattern(np.array([0.0, 1.0], np.float32)), [0.05, 1])


def test_room_light_comes_from_above_and_its_lamp_throws_shadows():
    up = np.array([0.0, 0.0, 1.0], np.float32)
    room = Room(np.full(3, 0.1, np.float32), np.full(3, 0.2, np.float32), up, np.zeros(3, np.float32))
    normal = np.stack([up, up, -up, np.array([1.0, 0, 0], np.float32)])
    light = room.diffuse(normal, np.array([1, 0, 1, 1], np.float32))
    np.testing.assert_allclose(light[:, 0], [0.3, 0.1, 0.05, 0.075], rtol=1e-6)


def test_each_pixel_is_blurred_as_its_depth_demands():
    """Left half in focus, right half behind: each side is that of the image blurred by its own sigma."""
    image = np.random.default_rng(0).random((80, 120, 3)).astype(np.float32)
    depth = np.full((80, 120), 500.0)
    depth[:, 60:] = 450.0
    lens = Lens(0.6, 0.9, 500.0, 60.0, 3.5)
    out = lens.blurred(image, depth)
    for part, sigma in ((np.s_[:, :60], 0.6), (np.s_[:, 60:], np.hypot(0.6, 0.9 * (500 / 450 - 1) * 500 / 60))):
        np.testing.assert_allclose(out[part], cv2.GaussianBlur(image, (0, 0), sigma)[part], atol=2e-3)
    assert lens.sigma(np.full((1, 1), np.nan))[0, 0] == np.float32(3.5), "what is nowhere is far away"


@pytest.mark.parametrize("angle", [0.0, 0.7, 1.57])
def test_motion_spreads_a_point_along_its_path(angle):
    image = np.zeros((41, 41, 3), dtype=np.float32)
    image[20, 20] = 1
    out = moved(image, 8.0, angle)[..., 0]
    assert out.sum() == pytest.approx(1, rel=1e-5)
    y, x = np.mgrid[:41, :41] - 20.0
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    assert (out * along).sum() == pytest.approx(0, abs=0.02) and (out * across).sum() == pytest.approx(0, abs=0.02)
    assert (out * along**2).sum() == pytest.approx(8**2 / 12, rel=0.08)
    assert (out * across**2).sum() < 0.3
    assert moved(image, 0.0, angle) is image


def test_the_sensor_exposes_saturates_and_encodes():
    light = np.broadcast_to(np.linspace(0, 1.5, 400, dtype=np.float32)[None, :, None], (300, 400, 3))
    exact = Sensor(0.8, 0.0, 2.2, 100).develop(light, np.random.default_rng(0))
    expected = np.rint(255 * np.clip(0.8 * light, 0, 1) ** (1 / 2.2))
    np.testing.assert_allclose(exact, expected, atol=1)
    assert exact.max() == 255
    noisy = Sensor(0.8, 0.03, 1.0, 100).develop(light, np.random.default_rng(0))
    column = np.abs(0.8 * light[0, :, 0] - 0.5).argmin()
    measured = noisy[:, column].astype(float).std() / 255
    assert measured == pytest.approx(0.03 * np.sqrt(0.15 + 0.85 * 0.5), rel=0.1)
    smooth = cv2.GaussianBlur(exact, (0, 0), 2)
    sensor = Sensor(1.0, 0.0, 1.0, 90)
    decoded = decode_jpeg(sensor.encode(smooth))
    assert decoded.shape == smooth.shape and np.abs(decoded.astype(int) - smooth).mean() < 3
