"""Sets of photographs: what a name means, that photograph and truth belong together, shapes, and the sensor."""

import importlib.util

import numpy as np
import pytest
import trimesh

from benchmarks.path_traced import shapes
from benchmarks.path_traced.rendering import Quality
from benchmarks.path_traced.sensor import Sensor, developed
from benchmarks.path_traced.sets import CAMERAS, PhotographSet, photographed
from benchmarks.path_traced.shapes import FILES, MATTERS, OURS, body_of, shape_of
from benchmarks.photographs.scoring import read_truth
from benchmarks.photographs.sets import PATTERN, chosen_captures, note_of
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.grid import sample_bilinear
from sl_nerfstudio.scan.images import as_grey, read_photograph


def test_a_name_says_everything():
    found = PhotographSet.named("skull-and-vertebra-table-glossy-phone-3-half")
    assert found == PhotographSet("skull-and-vertebra", "table", "glossy", "phone", 3, "half")
    assert PhotographSet.named("knob-none-dark-long-12").order == ""


@pytest.mark.parametrize("name", ["teapot-none-dark-long-12", "knob-none-dark-long", "knob-lawn-dark-long-1", "knob"])
def test_a_name_that_says_nothing_is_refused_with_what_there_is(name):
    with pytest.raises(UserError, match=f"--sets {name}: a set is named SHAPE-AROUND-MATTER-CAMERA-SEED") as refused:
        PhotographSet.named(name)
    assert all(choice in str(refused.value) for choice in (*FILES, *OURS, *MATTERS, *CAMERAS))


def test_a_shape_of_a_package_that_is_missing_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setattr(shapes.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"BONEMergedSkull[\s\S]*pip install --no-deps dm_control"):
        shape_of("skull", 0)


@pytest.mark.skipif(importlib.util.find_spec("dm_control") is None, reason="dm_control's files are not installed")
def test_two_things_stand_beside_each_other():
    scene = shape_of("skull-and-vertebra", 0)
    parts = trimesh.Trimesh(scene.vertices, scene.faces, process=False)
    skull = shape_of("skull", 0)
    first, second = parts.vertices[: len(skull.vertices)], parts.vertices[len(skull.vertices) :]
    assert first[:, 2].min() == pytest.approx(second[:, 2].min())
    assert second[:, 1].max() < first[:, 1].min() - 0.05 * scene.size
    assert scene.size == pytest.approx(120)


def test_a_body_is_the_surface_of_its_scene():
    """Subdivided for its colours: the same area, the same box, no edge longer than the colours need."""
    cube = trimesh.creation.box((120, 60, 30))
    scene = shapes.Scene("cube", np.asarray(cube.vertices), np.asarray(cube.faces))
    body = body_of(scene, "textured", np.random.default_rng(0))
    assert body.mesh.area == pytest.approx(cube.area) and body.mesh.bounds == pytest.approx(cube.bounds)
    assert body.mesh.edges_unique_length.max() <= 2.2
    # creases stay sharp: every normal is that of a face
    assert np.abs(body.mesh.vertex_normals).max(1) == pytest.approx(1)
    assert body.matter.colour.shape == body.mesh.vertices.shape
    assert body.matter.colour.std(0).min() > 0.05 and body.matter.colour.min() > 0


def test_noise_is_that_of_photons_and_reading():
    sensor = Sensor(electrons=400, read_noise=0.02, grey=True, linear=True, stops=0.0, quality=100)
    light = np.full((200, 200, 3), 3.7, dtype=np.float32)
    picture, _ = developed(light, sensor, np.random.default_rng(1))
    values = picture.astype(float) / 255
    assert values.mean() == pytest.approx(0.85, abs=2e-3)  # whatever the unit of the light
    assert values.std() == pytest.approx(np.hypot(np.sqrt(0.85 / 400), 0.02), rel=0.03)


def test_the_file_shows_the_picture_in_the_order_of_its_colours(tmp_path):
    light = np.zeros((64, 64, 3), dtype=np.float32)
    light[:, :32, 0], light[:, 32:, 2] = 1.0, 0.5
    picture, encoded = developed(light, Sensor(1e6, 0.0, stops=0.0), np.random.default_rng(0))
    (tmp_path / "a.jpg").write_bytes(encoded)
    assert (read_photograph(tmp_path / "a.jpg") == picture).all()
    red, blue = picture[10, 10].astype(int), picture[10, 50].astype(int)
    assert red[0] > 200 > 30 > red[2] and blue[2] > 150 > 30 > blue[0]


@pytest.mark.skipif(importlib.util.find_spec("mitsuba") is None, reason="mitsuba is not installed: the extra [render]")
def test_each_photograph_shows_the_pattern_where_its_truth_says(tmp_path):
    """Names are in random order: the truth of another frame does not fit."""
    quality = Quality(moments=1, direct=9, indirect=1, room=4)
    said = []
    folder = photographed("knob-table-matte-machine-5-shuffled", 3, 400, quality, tmp_path, said.append)
    assert len(said) == 3
    assert chosen_captures([folder.name], 24, 600, tmp_path) == [folder]
    names = list(note_of(folder)["frames"])
    assert names != sorted(names)
    truth, pattern = read_truth(folder), PATTERN.render()
    fit = np.zeros((3, 3))
    for row, name in enumerate(truth.frames):
        grey = as_grey(read_photograph(folder / "images" / f"{name}.jpg"))
        for column, other in enumerate(truth.frames.values()):
            coords = other.object_coords()
            there = np.isfinite(coords[..., 0])
            expected = sample_bilinear(pattern, coords[there].astype(np.float64))
            fit[row, column] = np.corrcoef(expected, grey[there])[0, 1]
    assert np.diag(fit).min() > 0.6
    assert fit[~np.eye(3, dtype=bool)].max() < 0.3
