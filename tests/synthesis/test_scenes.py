"""Scenes: closed surfaces of the stated sizes; mesh files; the builder of free forms; symmetric parts."""

from typing import Any

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.synthesis.parts import PARTS, turned
from sl_nerfstudio.synthesis.scenes import BUILT_IN, encode_ply, make_scene
from sl_nerfstudio.synthesis.sdf import capsule, carve, cylinder, ellipsoid, half_space, mesh_of, mirrored, union


def _mesh(scene):
    return trimesh.Trimesh(scene.vertices, scene.faces, process=False)


@pytest.fixture(scope="module")
def scenes():
    coarse: dict[str, Any] = {
        "head": {"cell": 4.0},
        "frog": {"cell": 1.5},
        "dog": {"cell": 1.5},
        "medal": {"cell": 1.0},
    }
    coarse |= {name: {"cell": 2.0} for name in ("staircase", "bottle", "spheres", "bump", "relief")}
    return {name: make(**coarse.get(name, {})) for name, make in BUILT_IN.items()}


@pytest.mark.parametrize("name", BUILT_IN)
def test_surfaces_are_closed_oriented_outwards_and_of_a_hand_s_size(scenes, name):
    mesh = _mesh(scenes[name])
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert mesh.body_count == 1
    holes = (2 - mesh.euler_number) // 2
    assert holes == 17 if name == "chair" else holes == 0  # between legs, rungs, slats and spindles
    assert mesh.area_faces.min() > 0
    assert abs(mesh.vertices[:, 2].min()) < 0.5 and 75 < mesh.extents.max() < 205  # on the ground, in millimetres


def test_the_cone_and_the_cylinder_have_their_volume_and_size(scenes):
    scene = scenes["cone-and-cylinder"]
    expected = 80 * 56 * 6 + np.pi * 19**2 * 46 / 3 + np.pi * 14**2 * 34
    assert _mesh(scene).volume == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(np.ptp(scene.vertices, axis=0), (80, 56, 52), atol=1e-9)
    assert scene.size == pytest.approx(80)


@pytest.mark.parametrize("name", ["head", "frog", "chair", "leaf", "dog", "vase", "medal", "bottle", "spheres", "rod"])
def test_normals_of_free_forms_point_outwards(scenes, name):
    scene = scenes[name]
    agree = (scene.vertex_normals[scene.faces].mean(1) * scene.face_normals).sum(1)
    assert np.quantile(agree, 0.02) > 0.5 and np.median(agree) > 0.98
    np.testing.assert_allclose(np.linalg.norm(scene.vertex_normals, axis=1), 1, atol=1e-9)


def test_a_sphere_from_its_field():
    scene = mesh_of("ball", ellipsoid((1, 2, 3), (10, 10, 10)), (-12, -12, -12), (14, 14, 16), 1.0)
    radius = np.linalg.norm(scene.vertices - (1, 2, 3), axis=1)
    np.testing.assert_allclose(radius, 10, atol=1e-3)
    np.testing.assert_allclose(scene.vertex_normals, (scene.vertices - (1, 2, 3)) / radius[:, None], atol=5e-3)
    assert _mesh(scene).volume == pytest.approx(4 / 3 * np.pi * 1000, rel=0.01)


def test_a_form_that_leaves_its_box_is_refused():
    with pytest.raises(ValueError, match="the surface of ball leaves its box"):
        mesh_of("ball", ellipsoid((0, 0, 0), (10, 10, 10)), (-8, -12, -12), (12, 12, 12), 1.0)


def test_joining_and_carving():
    a, b = ellipsoid((0, 0, 0), (2, 2, 2)), ellipsoid((3, 0, 0), (2, 2, 2))
    p = np.array([[0.0, 0, 0], [3, 0, 0], [1.5, 0, 0], [1.5, 1.5, 0], [9, 0, 0]])
    assert (union(0.0, a, b)(p) < 0).tolist() == [True, True, True, False, False]
    assert (union(2.0, a, b)(p) < 0).tolist() == [True, True, True, True, False], "the blend fills the groove"
    assert (carve(0.0, a, b)(p) < 0).tolist() == [True, False, False, False, False]
    assert (carve(0.0, a, half_space((0, 0, 1), 0.5))(p) < 0).tolist() == [False] * 5
    far = capsule((0, 0, 0), (0, 0, 5), 1.0, 1.0)(np.array([[3.0, 0, 2], [0, 0, 8], [0, 4, -3]]))
    np.testing.assert_allclose(far, [2, 2, 4])
    disc = cylinder((0, 0, 0), (0, 0, 4), 5.0)(np.array([[0.0, 0, 1], [7, 0, 2], [8, 0, 8], [0, 0, -3]]))
    np.testing.assert_allclose(disc, [-1, 2, 5, 3])
    assert mirrored(b)(np.array([[-3.0, 0, 0]]))[0] == pytest.approx(-2, abs=1e-6)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".glb"])
def test_mesh_files_in_their_unit(tmp_path, suffix):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    path = tmp_path / f"box{suffix}"
    box.export(path)
    scene = make_scene(str(path), file_unit=1000.0)
    np.testing.assert_allclose(sorted(np.ptp(scene.vertices, axis=0)), (100, 200, 300), atol=1e-4)
    assert scene.name == "box"


def test_a_written_mesh_comes_back_exactly(tmp_path, scenes):
    scene = scenes["frog"]
    (tmp_path / "m.ply").write_bytes(encode_ply(scene.vertices, scene.faces))
    back = make_scene(str(tmp_path / "m.ply"))
    assert np.array_equal(back.vertices, scene.vertices) and np.array_equal(back.faces, scene.faces)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cube", None, "neither a built-in scene .cone-and-cylinder, head, .*rod, flange, .*labelled-bottle. nor"),
        ("absent.ply", None, "there is no such file"),
        ("text.ply", b"hello", "cannot be read as a mesh"),
        ("points.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
                       b"property float z\nend_header\n0 0 0\n", "points.ply"),
    ],
)  # fmt: skip
def test_scenes_that_are_none(tmp_path, monkeypatch, name, content, message):
    monkeypatch.chdir(tmp_path)
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=message):
        make_scene(name)


# Parts that look the same from several sides but for one feature.

BORED = ("flange", "gear")


@pytest.fixture(scope="module", params=[(name, seed) for name in PARTS for seed in (1, 2)], ids=str)
def made(request):
    """A part, and points on its surface."""
    name, seed = request.param
    part = PARTS[name](np.random.default_rng(seed))
    r = part.radius + 4
    scene = mesh_of(name, part.solid, (-r, -r, -4), (r, r, part.height + 4), 1.5)
    return name, part, trimesh.Trimesh(scene.vertices, scene.faces, process=False)


def _anywhere(part, count=20_000):
    r = 1.5 * part.radius
    return np.random.default_rng(0).uniform((-r, -r, -0.5 * part.height), (r, r, 1.5 * part.height), (count, 3))


def test_a_part_is_one_closed_solid_that_stands_within_its_cylinder(made):
    name, part, mesh = made
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 1
    assert mesh.euler_number == (0 if name in BORED else 2)
    low, high = mesh.bounds
    assert abs(low[2]) < 0.1 and high[2] == pytest.approx(part.height, abs=0.1)
    p, r = _anywhere(part), np.linalg.norm(mesh.vertices[:, :2], axis=1)
    assert 0.9 * part.radius < r.max() <= part.radius + 0.1
    outside = (np.hypot(p[:, 0], p[:, 1]) > part.radius) | (p[:, 2] < 0) | (p[:, 2] > part.height)
    assert (part.solid(p)[outside] > 0).all()
    inside = float((part.solid(p) < 0).mean()) * 9 * part.radius**2 * 2 * part.height
    assert inside == pytest.approx(mesh.volume, rel=0.05)


def test_values_grow_no_faster_than_distance(made):
    """Else cells that hold the surface would be taken for empty ones when it is meshed."""
    _, part, _ = made
    rng, p = np.random.default_rng(1), _anywhere(part)
    for reach in (0.1, 3.0, 30.0):
        q = p + rng.normal(size=p.shape) * reach / 3
        for field in (part.body, part.solid):
            assert (np.abs(field(p) - field(q)) <= 1.01 * np.linalg.norm(p - q, axis=1) + 1e-9).all()


def test_the_feature_alone_breaks_the_symmetry_and_by_the_stated_depth(made):
    _, part, mesh = made
    p, inside_faces = _anywhere(part), trimesh.sample.sample_surface(mesh, 20_000, seed=0)[0]
    v = np.concatenate([mesh.vertices, inside_faces])
    assert np.abs(part.body(v)).max() == pytest.approx(part.depth, rel=0.05, abs=0.05)
    turns = np.arange(1, part.turns) * 360 / part.turns if part.turns else np.arange(30.0, 360, 30)
    for turn in turns:
        np.testing.assert_allclose(turned(part.body, turn)(p), part.body(p), atol=1e-9)
        assert np.abs(turned(part.solid, turn)(v)).max() > 0.5 * part.depth, turn
    if part.turns:
        assert np.abs(turned(part.body, 180 / part.turns)(p) - part.body(p)).max() > 1, "no more turns than stated"


def test_a_seed_is_another_part_of_its_kind():
    first, again, other = (make_scene("box", seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(first.vertices, again.vertices)
    assert np.abs(np.ptp(first.vertices, axis=0) - np.ptp(other.vertices, axis=0)).max() > 0.5
