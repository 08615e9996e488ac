"""Mesh files: what is written comes back; what is broken says why."""

import os

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.meshing.files import (
    SUFFIXES,
    files_of,
    read_mesh,
    write_mesh,
)
from sl_nerfstudio.meshing.mesh import Mesh

SOLID = trimesh.creation.icosphere(subdivisions=2)
MESH = Mesh(
    np.asarray(SOLID.vertices, dtype=np.float64) * 40 + [100.0, -20.0, 3.0], np.asarray(SOLID.faces, dtype=np.int64)
)
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


def test_ply_is_exact_far_from_the_origin(tmp_path):
    far = Mesh(MESH.vertices + 4.5e6, MESH.faces)
    write_mesh(tmp_path / "m.ply", far)
    assert np.array_equal(read_mesh(tmp_path / "m.ply").vertices, far.vertices)
    assert np.array_equal(read_mesh(tmp_path / "m.ply").faces, far.faces)


@pytest.mark.parametrize("name", ["mesh.stp", "mesh"])
def test_unknown_suffix_names_the_choices(name, tmp_path):
    for act in (lambda p: write_mesh(p, MESH), read_mesh):
        with pytest.raises(UserError, match=r"suffix(.|\n)*\.ply, \.obj, \.stl, \.glb"):
            act(tmp_path / name)


def test_nothing_is_written_for_an_empty_mesh_or_one_with_nan(tmp_path):
    with pytest.raises(UserError, match=r"has no triangles(.|\n)*cause(.|\n)*remedy(.|\n)*--keep-unobserved"):
        write_mesh(tmp_path / "m.ply", EMPTY)
    bad = MESH.vertices.copy()
    bad[7] = np.nan
    with pytest.raises(UserError, match=r"1 vertices are not numbers"):
        write_mesh(tmp_path / "m.ply", Mesh(bad, MESH.faces))
    assert list(tmp_path.iterdir()) == []


def test_a_place_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match=r"cannot be written(.|\n)*choose another output"):
        write_mesh(tmp_path / "file" / "m.ply", MESH)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write into read-only folders")
def test_a_read_only_folder(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match=r"cannot be written \(Permission denied\)"):
        write_mesh(tmp_path / "m.ply", MESH)


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


def test_a_folder_is_no_mesh(tmp_path):
    (tmp_path / "m.ply").mkdir()
    with pytest.raises(UserError, match="is not a file"):
        read_mesh(tmp_path / "m.ply")


def ply(vertices: str, faces: str, n_vertices: int, n_faces: int) -> str:
    return (
        f"ply\nformat ascii 1.0\nelement vertex {n_vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {n_faces}\nproperty list uchar int vertex_indices\nend_header\n{vertices}{faces}"
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ply("0 0 0\n1 0 0\n0 1 0\n", "", 3, 0), r"has no triangles: it holds 3 points only(.|\n)*point cloud"),
        (
            ply("0 0 0\n1 0 nan\n0 1 0\n", "3 0 1 2\n", 3, 1),
            r"has 1 vertices that are not numbers, the first is number 1",
        ),
        (ply("0 0 0\n1 0 0\n0 1e30 0\n", "3 0 1 2\n", 3, 1), r"reaches out to 1e\+30 units"),
        (ply("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 7\n", 3, 1), r"triangles at vertices that do not exist|cannot be read"),
        (ply("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 2\n", 4_000_000_000, 1), r"should hold 4000000000 vertices"),
        (ply("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 2\n", 3, 2), r"should hold 3 vertices and 2 faces, but 3 and 1 were read"),
    ],
)
def test_contents_that_are_no_mesh(content, message, tmp_path):
    (tmp_path / "m.ply").write_text(content)
    with pytest.raises(UserError, match=message):
        read_mesh(tmp_path / "m.ply")


def test_polygons_and_several_parts_are_read(tmp_path):
    (tmp_path / "quad.ply").write_text(ply("0 0 0\n1 0 0\n1 1 0\n0 1 0\n", "4 0 1 2 3\n", 4, 1))
    assert read_mesh(tmp_path / "quad.ply").face_areas().sum() == pytest.approx(1.0)
    parts = trimesh.Scene(
        [trimesh.creation.box(), trimesh.creation.box(transform=trimesh.transformations.translation_matrix([5, 0, 0]))]
    )
    (tmp_path / "parts.glb").write_bytes(parts.export(file_type="glb"))
    both = read_mesh(tmp_path / "parts.glb")
    assert len(both.faces) == 24 and both.vertices[:, 0].max() == pytest.approx(5.5)


def test_normals_and_cutting():
    normals = MESH.vertex_normals()
    outward = (MESH.vertices - [100.0, -20.0, 3.0]) / 40
    assert ((normals * outward).sum(1) > 0.99).all()
    upper = MESH.with_vertices(MESH.vertices[:, 2] > 3.0)
    assert (upper.vertices[:, 2] > 3.0).all() and set(np.unique(upper.faces)) == set(range(len(upper.vertices)))
    expected = (MESH.vertices[MESH.faces][..., 2] > 3.0).all(1)
    assert upper.face_areas().sum() == pytest.approx(MESH.face_areas()[expected].sum())


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "three numbers each|cannot be read"),
        ("a.obj", "v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "no triangle with an area"),
    ],
)
def test_meshes_without_a_surface(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=message):
        read_mesh(tmp_path / name)
