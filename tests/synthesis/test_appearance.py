"""The parts of a photograph, each against a formula: textures, materials, light, lens, sensor, interreflection."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

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
from sl_nerfstudio.synthesis.photograph import Sensor, SmallLamps, decode_jpeg, interpolate_vectors, light_vectors
from sl_nerfstudio.synthesis.render import RayCaster
from sl_nerfstudio.synthesis.sdf import Scene


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


def test_a_surface_of_one_depth_is_blurred_evenly():
    image = np.random.default_rng(0).random((60, 50, 3)).astype(np.float32)
    lens = Lens(0.6, 0.9, 500.0, 60.0, 3.5)
    for depth in (500.0, 450.0):
        sigma = float(lens.sigma(np.full((60, 50), depth))[0, 0])
        assert sigma == pytest.approx(np.hypot(0.6, 0.9 * (500 / depth - 1) * 500 / 60), rel=1e-5)
        expected = cv2.GaussianBlur(image, (0, 0), sigma)
        np.testing.assert_allclose(lens.blurred(image, np.full((60, 50), depth)), expected, atol=2e-3)
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


def _square(half, z, up=1):
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]], dtype=float)
    return corners, np.array([[0, 1, 2], [0, 2, 3]])[:, ::up]


def _scene(*parts):
    offset = np.cumsum([0, *(len(v) for v, _ in parts)])
    faces = np.concatenate([f + o for (_, f), o in zip(parts, offset[:-1], strict=True)])
    return Scene("test", np.concatenate([v for v, _ in parts]), faces)


def _lit_disc(radius, n=60):
    """A disc at z = 0 that shines upwards with radiosity 1, as small lamps."""
    step = 2 * radius / n
    x, y = np.meshgrid(*[(np.arange(n) + 0.5) * step - radius] * 2)
    inside = np.hypot(x, y) < radius
    p = np.stack([x[inside], y[inside], np.zeros(inside.sum())], 1)
    return SmallLamps(p, np.tile([0.0, 0, 1], (len(p), 1)), np.full((len(p), 3), step**2), np.full(len(p), step))


def test_bounced_light_of_a_disc_is_the_textbook_form_factor():
    """Irradiance on the axis of a disc of radius r at height h under radiosity 1: r^2 / (r^2 + h^2)."""
    caster = RayCaster(_scene(_square(50.0, 0.0), _square(50.0, 30.0, -1)))
    eye = np.array([[0.0, 0.0, 30.0]])
    down = np.array([[0.0, 0.0, -1.0]])
    vectors = light_vectors(caster, _lit_disc(20.0, 36), eye, down)
    assert vectors[0, 1] @ down[0] == pytest.approx(20**2 / (20**2 + 30**2), rel=0.01)
    assert not light_vectors(caster, _lit_disc(20.0, 36), eye, -down).any(), "nothing reaches the side that looks away"


def test_bounced_light_does_not_pass_through_surfaces():
    between = _square(49.0, 15.0)
    caster = RayCaster(_scene(_square(50.0, 0.0), _square(50.0, 30.0, -1), between))
    eye, down = np.array([[0.0, 0.0, 30.0]]), np.array([[0.0, 0.0, -1.0]])
    assert not light_vectors(caster, _lit_disc(20.0, 20), eye, down).any()


def test_vectors_between_grid_places_are_interpolated_and_unknown_ones_left_out():
    h, w, stride = 24, 36, 6
    known = np.ones((4, 6), dtype=bool)
    known[0, 0] = False
    row, column = np.mgrid[:4, :6]
    value = (3.0 * row + column)[known].astype(np.float32)
    vectors = np.broadcast_to(value[:, None, None], (len(value), 3, 3)).copy()
    full = interpolate_vectors(vectors, known, stride, (h, w))
    assert full.shape == (h, w, 3, 3)
    assert full[3 + 6 * 2, 3 + 6 * 3, 1, 2] == pytest.approx(3 * 2 + 3, rel=1e-3)
    assert full[3 + 6 * 2 + 3, 3 + 6 * 3, 0, 0] == pytest.approx(3 * 2.5 + 3, rel=1e-3)
    assert full[3, 3 + 3, 0, 0] == pytest.approx(1, rel=1e-2), "only the known neighbour counts"


def test_a_blurred_image_has_the_blur_of_its_place():
    """Left half in focus, right half far behind: each side is sharp or soft as its depth says."""
    image = np.random.default_rng(0).random((80, 120, 3)).astype(np.float32)
    depth = np.full((80, 120), 500.0)
    depth[:, 60:] = 420.0
    lens = Lens(0.5, 1.2, 500.0, 60.0, 3.5)
    out = lens.blurred(image, depth)
    soft = float(lens.sigma(depth)[0, -1])
    for part, sigma in ((slice(10, 45), 0.5), (slice(75, 110), soft)):
        expected = np.stack([gaussian_filter(image[..., k], sigma, truncate=4) for k in range(3)], -1)
        assert np.corrcoef(out[10:70, part].ravel(), expected[10:70, part].ravel())[0, 1] > 0.995
