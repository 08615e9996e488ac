"""The other renderer against the pinhole formulas of docs/scan-format.md, written out."""

import ast
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from benchmarks.another_renderer import objects
from benchmarks.another_renderer.objects import ball, block, joined, meshed, without
from benchmarks.another_renderer.photograph import (
    Hits,
    Lens,
    Look,
    Paint,
    Projection,
    Scene,
    Sensor,
    View,
    _bounced,
    _scattered,
    into_device,
    looking,
    photograph,
    triangulated,
)
from benchmarks.common import measuring

CAMERA = Lens(96, 80, 150.0, 47.0, 41.0, -0.05, 0.02)
PROJECTOR = Lens(400, 300, 500.0, 190.0, 160.0)


def test_a_point_worked_out_by_hand():
    lens = Lens(640, 480, 500.0, 320.0, 240.0, k1=0.1)
    # normalised (0.2, -0.4): r2 = 0.2, factor 1.02
    assert lens.pixels(np.array([0.4, 0.8, -2.0])) == pytest.approx([320 + 500 * 0.204, 240 - 500 * 0.408])
    assert np.isnan(lens.pixels(np.array([0.4, 0.8, 2.0]))).all()


def test_a_device_looks_along_its_minus_z_with_y_up():
    T = looking(np.array([100.0, 0, 0]), np.zeros(3), 0.0)
    u, v = Lens(640, 480, 500.0, 320.0, 240.0).pixels(into_device(T, np.array([[0.0, 10, 0], [0, 0, 10]])))
    assert u == pytest.approx([320 + 50, 240])
    assert v == pytest.approx([320, 240 - 50])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_directions_invert_pixels():
    uv = np.random.default_rng(0).uniform(0, 80, (200, 2))
    assert CAMERA.pixels(CAMERA.directions(uv) * 7) == pytest.approx(uv, abs=1e-9)


@pytest.fixture(scope="module")
def taken():
    """A photograph of a ball before a plate, under a pattern of coarse random squares."""
    rng = np.random.default_rng(1)
    pattern = np.kron(rng.integers(0, 2, (15, 20)), np.ones((20, 20)))
    plate = trimesh.creation.box((90, 8, 90))
    plate.apply_translation((0, 60, 0))
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=14)
    scene = Scene(trimesh.util.concatenate([sphere, plate.subdivide_to_size(5)]), [])
    view = View(
        looking(np.array([10.0, -170, 20]), np.zeros(3), 0.1), looking(np.array([80.0, -160, -5]), np.zeros(3), -0.2),
        180.0, 180.0,
    )  # fmt: skip
    look = Look(room_light=0.0, projector_blur=0.4, projector_defocus=0.0, sensor=Sensor(blur_px=0.3))
    paint = Paint.random(0.0, False, False, rng)
    values, truth = photograph(scene, CAMERA, Projection(pattern, PROJECTOR, look), (paint, paint), view, rng)
    return pattern, view, values, truth


def test_truth_follows_the_formulas(taken):
    _, view, _, truth = taken
    row, column = np.nonzero(np.isfinite(truth.p_world[..., 0]))
    assert len(row) > 1500
    p, xy = truth.p_world[row, column], truth.uv_projector[row, column]
    centres = np.stack([column, row], 1) + 0.5
    assert CAMERA.pixels(into_device(view.T_camera, p)) == pytest.approx(centres, abs=1e-3)
    q = (p - view.T_projector[:3, 3]) @ view.T_projector[:3, :3]
    assert xy == pytest.approx(np.stack([190 - 500 * q[:, 0] / q[:, 2], 160 + 500 * q[:, 1] / q[:, 2]], 1), abs=1e-6)
    assert triangulated(CAMERA, view.T_camera, centres, PROJECTOR, view.T_projector, xy) == pytest.approx(p, abs=1e-2)
    on_sphere = p[:, 1] < 0
    assert on_sphere.any()
    assert np.linalg.norm(p[on_sphere], axis=1) == pytest.approx(14, abs=0.02)


def test_pixels_are_bright_where_the_pattern_is(taken):
    pattern, _, values, truth = taken
    row, column = np.nonzero(np.isfinite(truth.p_world[..., 0]))
    x, y = truth.uv_projector[row, column].T
    inner = cv2.erode(pattern, np.ones((13, 13))) + cv2.erode(1 - pattern, np.ones((13, 13))) > 0
    chosen = inner[y.astype(int), x.astype(int)]
    white = pattern[y.astype(int), x.astype(int)][chosen] > 0
    brightness = values[row, column, 1][chosen]
    assert chosen.sum() > 300
    assert np.quantile(brightness[white], 0.02) > np.quantile(brightness[~white], 0.98)


def test_what_the_projector_does_not_reach_is_dark(taken):
    """The ball's shadow on the plate: on the line from the projector through the ball's centre."""
    _, view, values, truth = taken
    eye = view.T_projector[:3, 3]
    on_plate = eye + (56 - eye[1]) / (0 - eye[1]) * (np.zeros(3) - eye)
    column, row = (CAMERA.pixels(into_device(view.T_camera, on_plate))).astype(int)
    assert truth.object_seen[row, column]
    assert np.isnan(truth.p_world[row, column]).all()
    assert values[row - 1 : row + 2, column - 1 : column + 2].max() < 40


def test_a_wall_lights_the_floor_by_its_form_factor():
    """E = albedo (1 - d / sqrt(d^2 + h^2)) / 2 at distance d from a lit wall of height h that is very wide."""
    floor, wall = trimesh.creation.box((400, 4000, 2)), trimesh.creation.box((2, 4000, 100))
    floor.apply_translation((200, 0, -1))
    wall.apply_translation((-1, 0, 50))
    lens = Lens(100, 100, 180.0, 50.0, 50.0)  # sees 5000 mm from afar
    projection = Projection(np.ones((100, 100)), lens, Look(bounces=True, contrast=1.0))
    paint = Paint(np.zeros((14, 3)), np.full(14, np.pi / 2), 0.0, np.full((2, 3), 0.6), False)
    looks_along_x = looking(np.array([9000.0, 0, 40]), np.array([0.0, 0, 40]), 0.0)
    far = View(looks_along_x, looks_along_x, 9000.0, 9000.0)
    distance = np.array([10.0, 40.0, 120.0])
    p = np.stack([np.repeat(distance, 4000), np.zeros(12000), np.zeros(12000)], 1)
    hits = Hits(np.ones(12000), p, np.tile([0.0, 0, 1], (12000, 1)), np.ones(12000, dtype=bool))
    got = _bounced(Scene(floor, [wall]), projection, (paint, paint), far, hits, np.random.default_rng(0))
    factor = (1 - distance / np.hypot(distance, 100)) / 2
    assert got.reshape(3, 4000, 3).mean((1, 2)) == pytest.approx(0.6 * factor, rel=0.04)


def test_light_inside_an_object_is_neither_made_nor_lost():
    """An evenly lit surface looks as before; a bright spot is darker, and what it lost is around it."""
    there = np.zeros((80, 80), dtype=bool)
    there[10:70, 10:70] = True
    hits = Hits(np.ones(6400), np.zeros((6400, 3)), np.zeros((6400, 3)), there.ravel())
    look = Look(translucent=0.5, scatter_px=3.0)
    assert _scattered(there.astype(np.float32), hits, look) == pytest.approx(0, abs=1e-4)
    spot = np.zeros((80, 80), dtype=np.float32)
    spot[40, 40] = 1
    change = _scattered(spot, hits, look)
    assert change[40, 40] == pytest.approx(1 / (2 * np.pi * 9) - 1, rel=0.01)
    assert change.sum() == pytest.approx(0, abs=1e-3)


def test_a_shifted_lens_looks_at_the_same_place():
    lens = Lens(920, 920, 1300.0, 460.0, 966.0, k1=0.0)
    T = looking(np.array([0.0, -300, 100]), np.zeros(3), 0.3)
    middle = lens.pixels(into_device(T @ lens.turned_to_middle(), np.zeros(3)))
    assert middle == pytest.approx([460, 460], abs=1e-6)
    assert Lens(920, 920, 1300.0, 470.0, 450.0).turned_to_middle() == pytest.approx(np.eye(4))


def test_solids_are_what_they_say():
    solid = without(joined(block((0, 0, 0), (40, 30, 20), 0.01), ball((0, 0, 12), 9)), ball((20, 0, 0), 6))
    mesh = meshed(solid, (26, 22, 26), 0.5)
    assert mesh.is_watertight
    # a cap of 11 mm on a sphere of 9, less half a ball
    cap = np.pi * 11**2 * (3 * 9 - 11) / 3
    assert mesh.volume == pytest.approx(40 * 30 * 20 + cap - 2 / 3 * np.pi * 6**3, rel=0.01)
    with pytest.raises(ValueError, match="does not fit into its box"):
        meshed(solid, (18, 22, 26))


def test_nothing_is_shared_with_the_package():
    """Else a mistake in both would be none; reading flags and printing figures is no part of what is measured."""
    files = [*sorted(Path(objects.__file__).parent.glob("*.py")), Path(measuring.__file__)]
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text()))]
    imported = {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    imported |= {name.name for node in nodes if isinstance(node, ast.Import) for name in node.names}
    own = {name for name in imported if name.startswith("benchmarks")}
    assert own and all(name.startswith("benchmarks.another_renderer") for name in own - {"benchmarks.common.measuring"})
    assert not any(name.startswith("sl_nerfstudio") for name in imported)
