"""Ray casting and rendering against formulas: hits, shadows, light, one bounce; tables and walls around the object."""

import numpy as np
import pytest
import trimesh
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.images import read_image
from sl_nerfstudio.synthesis.appearance import Appearance, make_appearance
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import DevicePair
from sl_nerfstudio.synthesis.photograph import SmallLamps, interpolate_vectors, light_vectors
from sl_nerfstudio.synthesis.render import FrameGeometry, RayCaster, above_the_table, make_surroundings, render_capture
from sl_nerfstudio.synthesis.scenes import BUILT_IN
from sl_nerfstudio.synthesis.sdf import Scene
from sl_nerfstudio.synthesis.synthesise import make_setup, synthesise

CAMERA = Device(64, 48, 100.0, 100.0, 32.0, 24.0)
PROJECTOR = Device(200, 160, 300.0, 300.0, 100.0, 80.0)
DEVICES = DevicePair(CAMERA, PROJECTOR)


def square(half: float, z: float, up: int = 1) -> tuple[ndarray, ndarray]:
    """A horizontal square, seen from above; with `up` -1 from below."""
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])[:, ::up]


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


# One bounce of light.


def _lit_disc(radius, n=60):
    """A disc at z = 0 that shines upwards with radiosity 1, as small lamps."""
    step = 2 * radius / n
    x, y = np.meshgrid(*[(np.arange(n) + 0.5) * step - radius] * 2)
    inside = np.hypot(x, y) < radius
    p = np.stack([x[inside], y[inside], np.zeros(inside.sum())], 1)
    return SmallLamps(p, np.tile([0.0, 0, 1], (len(p), 1)), np.full((len(p), 3), step**2), np.full(len(p), step))


def test_bounced_light_of_a_disc_is_the_textbook_form_factor():
    """Irradiance on the axis of a disc of radius r at height h under radiosity 1: r^2 / (r^2 + h^2)."""
    caster = RayCaster(scene_of(square(50.0, 0.0), square(50.0, 30.0, -1)))
    eye = np.array([[0.0, 0.0, 30.0]])
    down = np.array([[0.0, 0.0, -1.0]])
    vectors = light_vectors(caster, _lit_disc(20.0, 36), eye, down)
    assert vectors[0, 1] @ down[0] == pytest.approx(20**2 / (20**2 + 30**2), rel=0.01)
    assert not light_vectors(caster, _lit_disc(20.0, 36), eye, -down).any(), "nothing reaches the side that looks away"


def test_bounced_light_does_not_pass_through_surfaces():
    between = square(49.0, 15.0)
    caster = RayCaster(scene_of(square(50.0, 0.0), square(50.0, 30.0, -1), between))
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


# Tables and walls.

SCENES = {name: BUILT_IN[name]() for name in ("cone-and-cylinder", "leaf", "vase")}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("seed", range(5))
def test_surroundings_stand_beside_the_object_and_below_it(name, seed):
    scene = above_the_table(SCENES[name])
    around = make_surroundings(scene, "walls", np.random.default_rng(seed))
    assert around is not None
    mesh = trimesh.Trimesh(around.vertices, around.faces)
    assert mesh.is_watertight and mesh.volume > 0 and 3 <= mesh.body_count <= 4
    bottom, reach = scene.vertices[:, 2].min(), np.linalg.norm((scene.vertices - scene.centre)[:, :2], axis=1).max()
    table, *boards = sorted(mesh.split(), key=lambda part: part.bounds[1, 2])
    assert table.bounds[1, 2] < bottom < table.bounds[1, 2] + 0.001 * scene.size
    assert (np.ptp(table.bounds, axis=0)[:2] > 3 * scene.size).all()
    low = np.tan(np.radians(scene.elevation_deg[0]))
    for board in boards:
        assert board.bounds[0, 2] == pytest.approx(table.bounds[1, 2])
        middle = board.bounds.mean(0)
        distance = np.linalg.norm(middle[:2] - scene.centre[:2])
        assert distance > reach
        assert board.bounds[1, 2] < scene.centre[2] + distance * low, "the lowest cameras look over it"
    np.testing.assert_allclose(around.vertex_normals[around.faces[:, 0]], around.face_normals, atol=1e-12)


def test_the_object_stays_what_it_is_among_its_surroundings():
    scene = SCENES["vase"]
    around = make_surroundings(scene, "table", np.random.default_rng(0))
    caster = RayCaster(scene, around)
    assert np.array_equal(caster.scene.face_normals[: len(scene.faces)], scene.face_normals)
    down = np.array([[0.0, 0.0, -1.0]])
    eyes = scene.centre + np.array([[0.0, 0, 300], [0.9 * scene.size, 0, 300], [9 * scene.size, 0, 300]])
    faces = np.concatenate([caster.first_hits(eye, down)[0] for eye in eyes])
    assert caster.on_object(faces).tolist() == [True, False, False] and (faces >= 0).tolist() == [True, True, False]


@pytest.mark.parametrize("background", ["table", "walls"])
@pytest.mark.parametrize("path", ["hand-held", "rigid-rig", "static-projector"])
def test_no_device_is_below_the_table(background, path):
    setup = make_setup(SynthConfig(frames=40, resolution=16, background=background, path=path, seed=2))
    for T in (setup.truth.T_world_camera, setup.truth.T_world_projector):
        assert (T[:, 2, 3] > setup.scene.size).all()


@pytest.mark.parametrize("images_only", [False, True])
def test_the_truth_tells_object_and_surroundings_apart(tmp_path, images_only):
    """The table is in coordinates and mask, the object mask holds the object alone, and mesh.ply too."""
    config = SynthConfig(frames=2, resolution=90, seed=1, clean=True, images_only=images_only)
    for background in ("none", "table"):
        synthesise(SynthConfig(**{**config.__dict__, "background": background}), tmp_path / background)
    plain, table = (tmp_path / name / "ground_truth" for name in ("none", "table"))
    assert (plain / "mesh.ply").read_bytes() == (table / "mesh.ply").read_bytes()
    assert not (plain / "surroundings.ply").exists()
    assert trimesh.load(table / "surroundings.ply").is_watertight
    for background in ("none", "table"):
        root = tmp_path / background
        scan = read_scan(root / "ground_truth" if images_only else root)
        for frame in scan.frames:
            shown = read_image(root / "ground_truth" / "object_masks" / f"{frame.name}.png") > 0
            lit = frame.read_mask()
            assert (lit & ~shown).any() == (background == "table")
            assert (lit & shown).sum() > 0.5 * shown.sum() and np.isfinite(frame.read_coords()[lit]).all()
