"""Mesh and point files: what is written comes back, other programs read it, and what is broken says why."""

import json
from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pytest
import trimesh

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.meshing.files import (
    SUFFIXES,
    files_of,
    observed_points,
    read_mesh,
    read_quality,
    write_mesh,
    write_points,
)
from sl_nerfstudio.meshing.mesh import Mesh, VertexProperties, VertexQuality

from .solids import mesh_of

BALL = mesh_of(trimesh.creation.icosphere(subdivisions=2), 40.0)
MESH = Mesh(BALL.vertices + [100.0, -20.0, 3.0], BALL.faces)
EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".PLY"])
def test_round_trip_keeps_the_surface_its_orientation_and_its_place(suffix, tmp_path):
    path = tmp_path / "größe 物" / f"mesh{suffix}"
    write_mesh(path, MESH)
    back = read_mesh(path)
    solid = trimesh.Trimesh(back.vertices, back.faces, process=False)
    assert solid.is_watertight and len(back.faces) == len(MESH.faces) and len(back.vertices) == len(MESH.vertices)
    corners, expected = (np.sort(m.vertices[m.faces].mean(1), axis=0) for m in (back, MESH))
    np.testing.assert_allclose(corners, expected, atol=2e-5)
    assert solid.volume == pytest.approx(trimesh.Trimesh(MESH.vertices, MESH.faces).volume, rel=1e-5)
    assert set(path.parent.iterdir()) == set(files_of(path))  # nothing temporary is left


def test_what_cannot_be_written_or_is_no_file_is_refused(tmp_path):
    bad = MESH.vertices.copy()
    bad[7] = np.nan
    choices = r"suffix(.|\n)*\.ply, \.obj, \.stl, \.glb"
    (tmp_path / "folder.ply").mkdir()
    for act, message in (
        (lambda: write_mesh(tmp_path / "m.stp", MESH), choices),
        (lambda: read_mesh(tmp_path / "m"), choices),
        (lambda: write_mesh(tmp_path / "m.ply", EMPTY), r"has no triangles(.|\n)*remedy(.|\n)*--keep-unobserved"),
        (lambda: write_mesh(tmp_path / "m.ply", Mesh(bad, MESH.faces)), "1 vertices are not numbers"),
        (lambda: read_mesh(tmp_path / "folder.ply"), "is not a file"),
    ):
        with pytest.raises(UserError, match=message):
            act()
    assert [path.name for path in tmp_path.iterdir()] == ["folder.ply"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_broken_files(suffix, tmp_path):
    good, path = tmp_path / f"good{suffix}", tmp_path / f"bad{suffix}"
    with pytest.raises(UserError, match=r"is missing"):
        read_mesh(path)
    path.write_bytes(b"")
    with pytest.raises(UserError, match=r"is empty \(0 bytes\)"):
        read_mesh(path)
    path.write_bytes(b"no mesh at all\n" * 9)
    with pytest.raises(UserError, match=r"cannot be read as|has no triangles"):
        read_mesh(path)
    write_mesh(good, MESH)
    path.write_bytes(good.read_bytes()[:3000])
    with pytest.raises(UserError, match=r"(cannot be read as|has no triangles)(.|\n)*truncated"):
        read_mesh(path)


def ply(vertices: str, faces: str, n_vertices: int, n_faces: int) -> str:
    return (
        f"ply\nformat ascii 1.0\nelement vertex {n_vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {n_faces}\nproperty list uchar int vertex_indices\nend_header\n{vertices}{faces}"
    )


THREE, FACE = "0 0 0\n1 0 0\n0 1 0\n", "3 0 1 2\n"
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("suffix", "content", "message"),
    [
        ("ply", ply(THREE, "", 3, 0), r"has no triangles: it holds 3 points only(.|\n)*point cloud"),
        ("ply", ply("0 0 0\n1 0 nan\n0 1 0\n", FACE, 3, 1), r"1 vertices that are not numbers, the first is number 1"),
        ("ply", ply("0 0 0\n1 0 0\n0 1e30 0\n", FACE, 3, 1), r"reaches out to 1e\+30 units"),
        ("ply", ply(THREE, "3 0 1 7\n", 3, 1), r"triangles at vertices that do not exist|cannot be read"),
        ("ply", ply(THREE, "3 0 1 -1\n", 3, 1), r"triangles at vertices that do not exist"),
        ("ply", ply(THREE, FACE, 3, 10**9), r"should hold 3 vertices and 1000000000 faces, but 3 and 1 were read"),
        ("ply", ply(THREE, FACE, -3, 1), r"should hold 0 vertices"),
        ("ply", ply(THREE, "2 0 1\n", 3, 1), r"should hold 3 vertices and 1 faces, but 3 and 0 were read"),
        ("ply", ply("0 0 0\n" * 3, FACE, 3, 1), r"has no triangle with an area"),
        ("ply", "ply\nformat ascii 1.0\nend_header\n", r"has no triangles: it holds nothing"),
        ("obj", OBJ + "f 1 2 9\n", r"cannot be read as OBJ"),
        ("obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", r"has vertices that are not three numbers each"),
        ("stl", "\0" * 80 + "\xff\xff\xff\x7f" + "\0" * 50, r"has no triangles"),
        ("stl", "solid x\nfacet normal a b c\n", r"has no triangles"),
        ("glb", "glTF\2\0\0\0\0\0\0\x7f\xff\xff\xff\x7fJSON", r"cannot be read as GLB"),
    ],
)
def test_contents_that_are_no_mesh(suffix, content, message, tmp_path):
    path = tmp_path / f"m.{suffix}"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(UserError, match=rf"m\.{suffix}: (.|\n)*{message}"):
        read_mesh(path)


def test_polygons_and_several_parts_are_read(tmp_path):
    (tmp_path / "quad.ply").write_text(ply("0 0 0\n1 0 0\n1 1 0\n0 1 0\n", "4 0 1 2 3\n", 4, 1))
    assert read_mesh(tmp_path / "quad.ply").face_areas().sum() == pytest.approx(1.0)
    beside = trimesh.creation.box(transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    parts = trimesh.Scene([trimesh.creation.box(), beside])
    (tmp_path / "parts.glb").write_bytes(parts.export(file_type="glb"))
    both = read_mesh(tmp_path / "parts.glb")
    assert len(both.faces) == 24 and both.vertices[:, 0].max() == pytest.approx(5.5)


def test_normals_and_cutting():
    normals = MESH.vertex_normals()
    assert ((normals * BALL.vertices / 40).sum(1) > 0.99).all()
    expected = (MESH.vertices[MESH.faces][..., 2] > 3.0).all(1)
    upper = MESH.with_faces(expected)
    assert (upper.vertices[:, 2] > 3.0).all() and set(np.unique(upper.faces)) == set(range(len(upper.vertices)))
    assert upper.face_areas().sum() == pytest.approx(MESH.face_areas()[expected].sum())


# A corner with three unequal legs along the axes: no turn or mirror image of it is the same. It is 82 mm long.
VERTICES = np.array([[0.0, 0, 0], [82, 0, 0], [0, 30, 0], [0, 0, 11]]) + [5.0, -3.0, 2.0]
CORNER = Mesh(VERTICES, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
COLOUR = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [188, 188, 188]], dtype=np.uint8)
VIEWS = np.array([3, 0, 2, 7])
SIGMA = np.array([0.05, np.nan, 0.02, 0.03])
PROPERTIES = VertexProperties(VertexQuality(SIGMA, SIGMA / 2, VIEWS, SIGMA * 10, SIGMA * 100), VIEWS == 0, COLOUR)
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "um": 1e-6, "arbitrary": 1.0}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_mesh(tmp_path / "mesh.ply", CORNER, PROPERTIES, "mm")
    return tmp_path / "mesh.ply"


def test_ply_keeps_everything_for_us_and_for_other_programs(file: Path):
    found, mesh = read_quality(file), read_mesh(file)
    assert found is not None and np.array_equal(found.views, VIEWS)
    for name in ("sigma", "sigma_independent", "residual", "ray_angle"):
        np.testing.assert_allclose(getattr(found, name), getattr(PROPERTIES.quality, name), rtol=1e-6)
    assert np.array_equal(mesh.vertices, VERTICES) and np.array_equal(mesh.faces, CORNER.faces)
    loaded = trimesh.load(file, process=False)
    rows = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(rows["sigma"], SIGMA, rtol=1e-6)
    assert np.array_equal(rows["views"], VIEWS) and np.array_equal(rows["invented"], PROPERTIES.invented)
    assert np.array_equal(loaded.visual.vertex_colors[:, :3], COLOUR)
    other = o3d.io.read_triangle_mesh(str(file))
    np.testing.assert_allclose(np.asarray(other.vertices), VERTICES)
    np.testing.assert_allclose(np.asarray(other.vertex_normals), CORNER.vertex_normals(), atol=1e-7)
    np.testing.assert_allclose(np.asarray(other.vertex_colors) * 255, COLOUR, atol=1e-6)
    assert b"comment lengths in mm" in file.read_bytes()[:400]
    write_mesh(file, Mesh(VERTICES + 4.5e6, CORNER.faces))
    assert np.array_equal(read_mesh(file).vertices, VERTICES + 4.5e6)  # exact far from the origin, too


def test_files_without_properties_have_none(file: Path, tmp_path: Path):
    (tmp_path / "cut.ply").write_bytes(file.read_bytes()[:600])
    write_mesh(tmp_path / "mesh.obj", CORNER, PROPERTIES)
    write_mesh(tmp_path / "plain.ply", CORNER)
    trimesh.Trimesh(CORNER.vertices, CORNER.faces, process=False).export(tmp_path / "text.ply", encoding="ascii")
    assert [read_quality(tmp_path / name) for name in ("plain.ply", "text.ply", "cut.ply", "mesh.obj")] == [None] * 4


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
    write_mesh(path, CORNER, PROPERTIES, units)
    expected = in_gltf(VERTICES, METRES[units])
    np.testing.assert_allclose(in_order(o3d.io.read_triangle_mesh(str(path)), expected)[0], expected, rtol=1e-6)
    np.testing.assert_allclose(trimesh.load_scene(path, process=False).to_geometry().vertices, expected, rtol=1e-6)
    np.testing.assert_allclose(read_mesh(path, units).vertices, VERTICES, rtol=1e-5)
    assert trimesh.load_mesh(path).volume == pytest.approx(82 * 30 * 11 / 6 * METRES[units] ** 3, rel=1e-5)  # outward


def test_glb_states_its_own_box_and_its_colours_are_linear(tmp_path):
    write_mesh(tmp_path / "mesh.glb", CORNER, PROPERTIES, "mm")
    content = (tmp_path / "mesh.glb").read_bytes()
    document = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    position = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert position["max"][0] - position["min"][0] == pytest.approx(0.082, rel=1e-6)
    assert int.from_bytes(content[8:12], "little") == len(content)
    found = in_order(o3d.io.read_triangle_mesh(str(tmp_path / "mesh.glb")), in_gltf(VERTICES, 1e-3))[1]
    np.testing.assert_allclose(found[:3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(found[3], ((188 / 255 + 0.055) / 1.055) ** 2.4, atol=1e-4)
    write_mesh(tmp_path / "grey.glb", CORNER, None, "mm")
    material = trimesh.load_mesh(tmp_path / "grey.glb").visual.material
    assert material.baseColorFactor[0] == pytest.approx(255 * 0.2158, abs=1)


@pytest.mark.parametrize(("units", "factor"), [("mm", 1), ("cm", 10), ("m", 1000), ("arbitrary", 1)])
def test_stl_is_in_millimetres_in_the_scans_axes(units, factor, tmp_path):
    path = tmp_path / "mesh.stl"
    write_mesh(path, CORNER, PROPERTIES, units)
    found = o3d.io.read_triangle_mesh(str(path))
    np.testing.assert_allclose(found.get_min_bound(), VERTICES.min(0) * factor, rtol=1e-6)
    np.testing.assert_allclose(found.get_max_bound(), VERTICES.max(0) * factor, rtol=1e-6)
    assert trimesh.load_mesh(path).volume == pytest.approx(82 * 30 * 11 / 6 * factor**3, rel=1e-5)
    np.testing.assert_allclose(read_mesh(path, units).vertices.max(0), VERTICES.max(0), rtol=1e-6)
    unit = b"arbitrary units" if units == "arbitrary" else b"mm"
    assert path.read_bytes()[:80].rstrip() == b"binary STL, lengths in " + unit


@pytest.mark.parametrize("properties", [None, PROPERTIES], ids=["grey", "coloured"])
def test_obj_keeps_unit_and_axes_and_names_its_material(properties, tmp_path):
    write_mesh(tmp_path / "a mesh.obj", CORNER, properties, "mm")
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
    return observed_points(CORNER, PROPERTIES)


def test_a_point_cloud_has_what_frames_confirm_with_normals_sigma_and_views(cloud, tmp_path):
    path: Path = tmp_path / "cloud.ply"
    assert write_points(path, *cloud, "mm") == 3
    found = o3d.t.io.read_point_cloud(str(path)).point
    np.testing.assert_allclose(found["positions"].numpy(), VERTICES[VIEWS > 0])
    np.testing.assert_allclose(found["normals"].numpy(), CORNER.vertex_normals()[VIEWS > 0], atol=1e-7)
    np.testing.assert_allclose(found["sigma"].numpy()[:, 0], SIGMA[VIEWS > 0], rtol=1e-6)
    assert found["views"].numpy()[:, 0].tolist() == [3, 2, 7]
    assert np.array_equal(found["colors"].numpy(), COLOUR[VIEWS > 0])


@pytest.mark.parametrize("units", ["mm", "m", "arbitrary"])
def test_las_is_in_metres_with_normals_sigma_and_views(cloud, units, tmp_path):
    write_points(tmp_path / "cloud.las", *cloud, units)
    found = laspy.read(tmp_path / "cloud.las")
    np.testing.assert_allclose(found.xyz, VERTICES[VIEWS > 0] * METRES[units], rtol=1e-7)
    decimals = np.log10(found.header.scales)
    np.testing.assert_allclose(decimals, np.round(decimals), atol=1e-9)  # what other programs show in full
    normals = np.stack([found["nx"], found["ny"], found["nz"]], 1)
    np.testing.assert_allclose(normals, CORNER.vertex_normals()[VIEWS > 0], atol=1e-7)
    np.testing.assert_allclose(found["sigma"], SIGMA[VIEWS > 0] * METRES[units], rtol=1e-6)
    assert np.asarray(found["views"]).tolist() == [3, 2, 7] and found.header.version == "1.4"
    assert np.array_equal(np.stack([found.red, found.green, found.blue], 1) >> 8, COLOUR[VIEWS > 0])
