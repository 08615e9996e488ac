"""Tables and walls: below and beside the object, never in it, lit by the same pattern, and kept apart in the truth."""

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.images import read_image
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.render import RayCaster, above_the_table, joined, make_surroundings
from sl_nerfstudio.synthesis.scenes import BUILT_IN
from sl_nerfstudio.synthesis.synthesise import make_setup, synthesise

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
    whole = joined(scene, around)
    assert np.array_equal(whole.face_normals[: len(scene.faces)], scene.face_normals)
    caster = RayCaster(scene, around)
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
