"""Properties of vertices in PLY files: read by this package, by trimesh and by open3d."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh

from sl_nerfstudio.meshing.files import encode_ply, read_mesh, read_quality, write_mesh
from sl_nerfstudio.meshing.mesh import VertexProperties, VertexQuality

from .test_visibility import plate

MESH = plate(5.0, 1.0)
COUNT = len(MESH.vertices)
SIGMA = np.where(np.arange(COUNT) < 7, np.nan, np.linspace(0.01, 0.1, COUNT))
QUALITY = VertexQuality(SIGMA, SIGMA / 2, np.arange(COUNT), SIGMA * 10, SIGMA * 100)
COLOUR = np.stack([np.arange(COUNT), 255 - np.arange(COUNT), np.full(COUNT, 7)], 1).astype(np.uint8)
PROPERTIES = VertexProperties(QUALITY, np.arange(COUNT) % 3 == 0, COLOUR)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_mesh(tmp_path / "mesh.ply", MESH, PROPERTIES, "mm")
    return tmp_path / "mesh.ply"


def test_all_properties_come_back(file: Path):
    found = read_quality(file)
    assert found is not None and np.array_equal(found.views, QUALITY.views)
    for name in ("sigma", "sigma_independent", "residual", "ray_angle"):
        np.testing.assert_allclose(getattr(found, name), getattr(QUALITY, name), rtol=1e-6)
    mesh = read_mesh(file)
    assert np.array_equal(mesh.vertices, MESH.vertices) and np.array_equal(mesh.faces, MESH.faces)


def test_other_programs_read_positions_normals_and_properties(file: Path):
    loaded = trimesh.load(file, process=False)
    rows = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(rows["sigma"], SIGMA, rtol=1e-6)
    assert np.array_equal(rows["views"], QUALITY.views)
    assert np.array_equal(rows["invented"], PROPERTIES.invented)
    assert np.array_equal(loaded.visual.vertex_colors[:, :3], COLOUR)
    mesh = o3d.io.read_triangle_mesh(str(file))
    np.testing.assert_allclose(np.asarray(mesh.vertices), MESH.vertices)
    np.testing.assert_allclose(np.asarray(mesh.vertex_normals), np.tile([0.0, 0.0, 1.0], (COUNT, 1)), atol=1e-7)
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors) * 255, COLOUR, atol=1e-6)
    assert b"comment lengths in mm" in file.read_bytes()[:400]


def test_files_without_properties_have_none(file: Path, tmp_path: Path):
    plain = tmp_path / "plain.ply"
    plain.write_bytes(encode_ply(MESH))
    text = tmp_path / "text.ply"
    trimesh.Trimesh(MESH.vertices, MESH.faces, process=False).export(text, encoding="ascii")
    cut = tmp_path / "cut.ply"
    cut.write_bytes(file.read_bytes()[:700])
    write_mesh(tmp_path / "mesh.obj", MESH, PROPERTIES)
    assert [read_quality(path) for path in (plain, text, cut, tmp_path / "mesh.obj")] == [None] * 4
