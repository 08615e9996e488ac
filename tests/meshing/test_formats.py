"""Mesh and point files in other programs' units and axes, opened by readers that are not this package's."""

import json
import struct
from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pytest
import trimesh

from sl_nerfstudio.meshing.files import observed_points, read_mesh, write_mesh, write_points
from sl_nerfstudio.meshing.mesh import Mesh, VertexProperties, VertexQuality

# A corner with three unequal legs along the axes: no turn or mirror image of it is the same. It is 82 mm long.
VERTICES = np.array([[0.0, 0, 0], [82, 0, 0], [0, 30, 0], [0, 0, 11]]) + [5.0, -3.0, 2.0]
MESH = Mesh(VERTICES, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
COLOUR = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [188, 188, 188]], dtype=np.uint8)
VIEWS = np.array([3, 0, 2, 7])
SIGMA = np.array([0.05, np.nan, 0.02, 0.03])
PROPERTIES = VertexProperties(VertexQuality(SIGMA, SIGMA, VIEWS, SIGMA, SIGMA), VIEWS == 0, COLOUR)
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "um": 1e-6, "arbitrary": 1.0}


def in_gltf(p: np.ndarray, metres: float) -> np.ndarray:
    """The scan's z is glTF's y, its y is glTF's -z."""
    return np.stack([p[:, 0], p[:, 2], -p[:, 1]], 1) * metres


def in_order(found: o3d.geometry.TriangleMesh, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and colours that open3d read, in the order of the vertices that are expected; it sorts them."""
    vertices, colours = np.asarray(found.vertices), np.asarray(found.vertex_colors)
    order = np.linalg.norm(vertices[None] - expected[:, None], axis=2).argmin(1)
    return vertices[order], colours[order] if len(colours) else colours


@pytest.mark.parametrize("units", METRES)
def test_glb_is_in_metres_with_y_up(units, tmp_path):
    path = tmp_path / "mesh.glb"
    write_mesh(path, MESH, PROPERTIES, units)
    expected = in_gltf(VERTICES, METRES[units])
    np.testing.assert_allclose(in_order(o3d.io.read_triangle_mesh(str(path)), expected)[0], expected, rtol=1e-6)
    np.testing.assert_allclose(trimesh.load_scene(path, process=False).to_geometry().vertices, expected, rtol=1e-6)
    np.testing.assert_allclose(read_mesh(path, units).vertices, VERTICES, rtol=1e-5)
    assert trimesh.load_mesh(path).volume == pytest.approx(82 * 30 * 11 / 6 * METRES[units] ** 3, rel=1e-5)  # outward


def test_an_object_of_82_mm_is_0_082_m_and_0_082_is_said_by_the_files_own_box(tmp_path):
    write_mesh(tmp_path / "mesh.glb", MESH, None, "mm")
    content = (tmp_path / "mesh.glb").read_bytes()
    magic, version, total, size, kind = struct.unpack("<4sII I4s", content[:20])
    assert (magic, version, total, kind) == (b"glTF", 2, len(content), b"JSON")
    document = json.loads(content[20 : 20 + size])
    position = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert position["max"][0] - position["min"][0] == pytest.approx(0.082, rel=1e-6)
    assert "matrix" not in document["nodes"][0]
    assert document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"][0] == pytest.approx(0.2158, abs=1e-3)


def test_colours_of_glb_are_linear(tmp_path):
    write_mesh(tmp_path / "mesh.glb", MESH, PROPERTIES, "mm")
    found = in_order(o3d.io.read_triangle_mesh(str(tmp_path / "mesh.glb")), in_gltf(VERTICES, 1e-3))[1]
    np.testing.assert_allclose(found[:3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(found[3], ((188 / 255 + 0.055) / 1.055) ** 2.4, atol=1e-4)


@pytest.mark.parametrize(("units", "factor"), [("mm", 1), ("cm", 10), ("m", 1000), ("arbitrary", 1)])
def test_stl_is_in_millimetres_in_the_scans_axes(units, factor, tmp_path):
    path = tmp_path / "mesh.stl"
    write_mesh(path, MESH, PROPERTIES, units)
    found = o3d.io.read_triangle_mesh(str(path))
    np.testing.assert_allclose(found.get_min_bound(), VERTICES.min(0) * factor, rtol=1e-6)
    np.testing.assert_allclose(found.get_max_bound(), VERTICES.max(0) * factor, rtol=1e-6)
    assert trimesh.load_mesh(path).volume == pytest.approx(82 * 30 * 11 / 6 * factor**3, rel=1e-5)
    np.testing.assert_allclose(read_mesh(path, units).vertices.max(0), VERTICES.max(0), rtol=1e-6)
    unit = b"arbitrary units" if units == "arbitrary" else b"mm"
    assert path.read_bytes()[:80].rstrip() == b"binary STL, lengths in " + unit


@pytest.mark.parametrize("properties", [None, PROPERTIES], ids=["grey", "coloured"])
def test_obj_keeps_unit_and_axes_and_names_its_material(properties, tmp_path):
    write_mesh(tmp_path / "a mesh.obj", MESH, properties, "mm")
    loaded = trimesh.load_mesh(tmp_path / "a mesh.obj", process=False)
    np.testing.assert_allclose(loaded.vertices, VERTICES, atol=1e-8)
    seen, colours = in_order(o3d.io.read_triangle_mesh(str(tmp_path / "a mesh.obj")), VERTICES)
    np.testing.assert_allclose(seen, VERTICES, atol=1e-5)
    material = dict(line.split(" ", 1) for line in (tmp_path / "a mesh.mtl").read_text().splitlines())
    text = (tmp_path / "a mesh.obj").read_text()
    assert "mtllib a mesh.mtl" in text and f"usemtl {material['newmtl']}" in text
    if properties is None:
        assert float(material["Kd"].split()[0]) == pytest.approx(0.502, abs=1e-3)
    else:
        np.testing.assert_allclose(colours, COLOUR / 255, atol=1e-4)
        assert material["Kd"] == "1 1 1"


@pytest.fixture
def cloud() -> tuple[np.ndarray, np.ndarray, VertexProperties]:
    return observed_points(MESH, PROPERTIES)


def test_a_point_cloud_has_what_frames_confirm_with_normals_sigma_and_views(cloud, tmp_path):
    path: Path = tmp_path / "cloud.ply"
    assert write_points(path, *cloud, "mm") == 3
    found = o3d.t.io.read_point_cloud(str(path)).point
    np.testing.assert_allclose(found["positions"].numpy(), VERTICES[VIEWS > 0])
    np.testing.assert_allclose(found["normals"].numpy(), MESH.vertex_normals()[VIEWS > 0], atol=1e-7)
    np.testing.assert_allclose(found["sigma"].numpy()[:, 0], SIGMA[VIEWS > 0], rtol=1e-6)
    assert found["views"].numpy()[:, 0].tolist() == [3, 2, 7]
    assert np.array_equal(found["colors"].numpy(), COLOUR[VIEWS > 0])


@pytest.mark.parametrize("units", ["mm", "m", "arbitrary"])
def test_las_is_in_metres_with_normals_sigma_and_views(cloud, units, tmp_path):
    write_points(tmp_path / "cloud.las", *cloud, units)
    found = laspy.read(tmp_path / "cloud.las")
    np.testing.assert_allclose(found.xyz, VERTICES[VIEWS > 0] * METRES[units], rtol=1e-7)
    normals = np.stack([found["nx"], found["ny"], found["nz"]], 1)
    np.testing.assert_allclose(normals, MESH.vertex_normals()[VIEWS > 0], atol=1e-7)
    np.testing.assert_allclose(found["sigma"], SIGMA[VIEWS > 0] * METRES[units], rtol=1e-6)
    assert np.asarray(found["views"]).tolist() == [3, 2, 7] and found.header.version == "1.4"
    assert np.array_equal(np.stack([found.red, found.green, found.blue], 1) >> 8, COLOUR[VIEWS > 0])
