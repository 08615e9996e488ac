"""Ray casting and rendering, piece by piece: hits, shadows and light against formulas."""

import numpy as np
import pytest
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.synthesis.appearance import Appearance, corner_fall_off, make_appearance
from sl_nerfstudio.synthesis.devices import DevicePair
from sl_nerfstudio.synthesis.render import FrameGeometry, RayCaster, render_capture
from sl_nerfstudio.synthesis.sdf import Scene

CAMERA = Device(64, 48, 100.0, 100.0, 32.0, 24.0)
PROJECTOR = Device(200, 160, 300.0, 300.0, 100.0, 80.0)
DEVICES = DevicePair(CAMERA, PROJECTOR)


def square(half: float, z: float) -> tuple[ndarray, ndarray]:
    """A horizontal square, seen from above."""
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def scene_of(*parts: tuple[ndarray, ndarray]) -> Scene:
    offsets = np.cumsum([0, *(len(v) for v, _ in parts)])
    faces = [f + o for (_, f), o in zip(parts, offsets[:-1], strict=True)]
    return Scene("test", np.concatenate([v for v, _ in parts]), np.concatenate(faces))


def above(x: float, z: float) -> ndarray:
    """A device at (x, 0, z) that looks straight down."""
    T = np.eye(4)
    T[:3, 3] = x, 0.0, z
    return T


T_CAMERA, T_PROJECTOR = above(0.0, 300.0), above(60.0, 300.0)


def test_light_follows_the_cosine_and_distance_laws():
    scene = scene_of(square(80.0, 0.0))
    plain = Appearance(300.0, lambda p: p[:, 0], albedo_contrast=0.0, corner_loss=0.0, blur=1e-6)
    pattern = np.ones((PROJECTOR.h, PROJECTOR.w), dtype=np.float32)
    shown = render_capture(FrameGeometry(RayCaster(scene), DEVICES, T_CAMERA, T_PROJECTOR), pattern, plain, 1)
    x = 3.0 * (np.arange(CAMERA.w) + 0.5 - 32)
    for column in (20, 32, 50):
        distance = np.hypot(x[column] - 60, 300)
        cosine = 300 / distance
        y = 3.0 * 0.5
        distance = np.sqrt(distance**2 + y**2)
        expected = plain.mean_albedo * (plain.room_light + (300 / distance) ** 2 * (300 / distance))
        assert shown.radiance[24, column] == pytest.approx(expected, rel=1e-4), cosine
    assert shown.mask[24, 20:50].all() and np.isfinite(shown.coords[shown.mask]).all()
    assert np.isnan(shown.coords[~shown.mask]).all()


def test_the_background_is_where_nothing_is_hit():
    small = scene_of(square(20.0, 0.0))
    look = make_appearance(small, 300.0, np.random.default_rng(0))
    pattern = np.zeros((PROJECTOR.h, PROJECTOR.w), dtype=np.float32)
    shown = render_capture(FrameGeometry(RayCaster(small), DEVICES, T_CAMERA, T_PROJECTOR), pattern, look, 1)
    assert shown.radiance[0, 0] == pytest.approx(look.background, rel=1e-5)
    assert not shown.mask[:10].any() and shown.mask[24, 32]


def test_appearance_is_within_physical_limits_and_random_by_its_seed():
    scene = scene_of(square(50.0, 0.0))
    look, again, other = (make_appearance(scene, 225.0, np.random.default_rng(seed)) for seed in (1, 1, 2))
    p = np.random.default_rng(0).uniform(-50, 50, (5000, 3))
    albedo = look.albedo(p)
    assert np.array_equal(albedo, again.albedo(p)) and not np.array_equal(albedo, other.albedo(p))
    assert albedo.min() >= 0.25 and albedo.max() <= 1.0
    assert albedo.mean() == pytest.approx(look.mean_albedo, abs=0.05)
    middle, corner = corner_fall_off(np.array([[100.0, 80.0], [0.0, 0.0]]), PROJECTOR, look.corner_loss)
    assert (middle, corner) == (1.0, pytest.approx(1 - look.corner_loss))
    assert look.projected(np.array([0.0, 1.0], dtype=np.float32)) == pytest.approx([look.dark_leak, 1.0])
    up = look.ambient(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=np.float32))
    assert up[0] == pytest.approx(look.room_light) and up[1] == pytest.approx(look.room_light / 2)
