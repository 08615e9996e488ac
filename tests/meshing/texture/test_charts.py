"""A mesh laid out flat: inside the square, nothing over anything else, one scale, room between the charts."""

import numpy as np
import pytest
import trimesh
from scipy.ndimage import distance_transform_edt

from sl_nerfstudio.geometry.numerics import component_labels
from sl_nerfstudio.meshing import texture as module
from sl_nerfstudio.meshing.mesh import Charts, Mesh
from sl_nerfstudio.meshing.texture import square_charts

KNOT = trimesh.creation.torus(30.0, 11.0, major_sections=64, minor_sections=32)
BOX = trimesh.creation.box((30, 20, 10)).subdivide_to_size(4.0)
SOLIDS = {"torus": KNOT, "box": BOX}


def mesh_of(solid: trimesh.Trimesh, scale: float = 1.0) -> Mesh:
    return Mesh(np.asarray(solid.vertices, dtype=float) * scale, np.asarray(solid.faces, dtype=np.int64))


def drawn(charts: Charts, size: int) -> tuple[np.ndarray, np.ndarray]:
    """How many triangles the centre of each pixel is inside of, and the chart there; -1 where there is none."""
    number = component_labels(charts.corners[:, :2].ravel(), charts.corners[:, 1:].ravel(), len(charts.uv))
    count, chart = np.zeros((size, size), int), np.full((size, size), -1)
    for triangle in charts.corners:
        corners = charts.uv[triangle].astype(float) * size
        (left, top), (right, bottom) = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
        x, y = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
        sides = [
            (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
            for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)
        ]
        inside = (np.array(sides) > 1e-4).all(0) | (np.array(sides) < -1e-4).all(0)
        count[top:bottom, left:right] += inside
        chart[top:bottom, left:right][inside] = number[triangle[0]]
    return count, chart


def areas(points: np.ndarray) -> np.ndarray:
    """Of triangles (f, 3, 2 or 3), by Heron's formula."""
    a, b, c = (np.linalg.norm(points[:, k] - points[:, k - 1], axis=1) for k in range(3))
    s = (a + b + c) / 2
    return np.sqrt(np.maximum(s * (s - a) * (s - b) * (s - c), 0))


@pytest.mark.parametrize("pieces", ["whole", "in pieces"])
@pytest.mark.parametrize("name", SOLIDS)
def test_charts_lie_inside_the_square_and_not_over_each_other(name, pieces, monkeypatch):
    monkeypatch.setattr(module, "_PIECE", 700 if pieces == "in pieces" else 10**9)
    mesh, size = mesh_of(SOLIDS[name]), 512
    charts = square_charts(mesh, size)
    assert charts.uv.min() >= 0 and charts.uv.max() <= 1
    assert np.array_equal(charts.vertex[charts.corners], mesh.faces)
    count, chart = drawn(charts, 2 * size)
    flat = areas(charts.uv[charts.corners].astype(float))
    assert count.max() == 1 and count.mean() == pytest.approx(flat.sum(), rel=0.02)
    assert 0.25 < flat.sum() < 1 and (flat > 0).all()
    # every triangle at about the same scale
    scale = np.sqrt(flat / areas(mesh.vertices[mesh.faces]))
    assert np.percentile(scale, 99) / np.percentile(scale, 1) < 1.5
    # two pixels of the texture between charts, so that a filter of two by two pixels never sees another one
    for one in np.unique(chart[chart >= 0])[:20]:
        away = distance_transform_edt(chart != one)
        assert away[(chart >= 0) & (chart != one)].min() >= 2 * 2
    assert len(np.unique(chart[chart >= 0])) == charts.count


def test_the_unit_and_the_place_of_a_mesh_do_not_matter():
    plain, tiny = (square_charts(mesh_of(KNOT, scale), 256) for scale in (1.0, 1e-5))
    far = square_charts(Mesh(mesh_of(KNOT).vertices + 1e4, mesh_of(KNOT).faces), 256)
    for other in (tiny, far):
        assert np.array_equal(plain.corners, other.corners)
        np.testing.assert_allclose(plain.uv, other.uv, atol=0.02)


def test_a_small_texture_has_few_charts():
    counts = [square_charts(mesh_of(KNOT), size).count for size in (64, 512)]
    assert counts[0] < 30 < counts[1]
