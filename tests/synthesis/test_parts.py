"""Parts that look the same from several sides but for one feature: fields, symmetry of the body, the feature's size."""

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.synthesis.parts import PARTS, turned
from sl_nerfstudio.synthesis.scenes import make_scene
from sl_nerfstudio.synthesis.sdf import mesh_of

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
