import numpy as np
import pytest

from sl_nerfstudio.evaluation.completeness import find_openings
from sl_nerfstudio.meshing.mesh import Mesh

from ..shapes import sphere


def cut_sphere(*heights: float, radius: float = 1.0) -> Mesh:
    """A sphere without the caps beyond the given signed heights."""
    mesh = sphere(radius, resolution=80)
    z = mesh.vertices[mesh.faces].mean(1)[:, 2]
    keep = np.ones(len(z), bool)
    for height in heights:
        keep &= z < height if height > 0 else z > height
    return mesh.with_faces(keep)


def test_a_closed_surface_has_no_openings():
    found = find_openings(sphere())
    assert len(found) == 0 and len(found.fan) == 0 and found.normal.shape == (0, 3)


def test_two_caps_are_two_openings_with_the_circles_area_length_and_axis():
    found = find_openings(cut_sphere(0.8, -0.3, radius=1.0))
    assert len(found) == 2
    for k, height in enumerate((-0.3, 0.8)):  # the largest first
        r = np.sqrt(1 - height**2)
        assert found.area[k] == pytest.approx(np.pi * r**2, rel=0.03)
        assert found.length[k] == pytest.approx(2 * np.pi * r, rel=0.15)  # jagged
        np.testing.assert_allclose(found.normal[k], [0, 0, np.sign(height)], atol=0.02)
        np.testing.assert_allclose(found.centre[k], [0, 0, height], atol=0.05)


def test_the_closing_triangles_close_the_mesh():
    """The divergence theorem: the vector areas of a closed surface add up to zero."""
    mesh = cut_sphere(0.6, -0.1)
    found = find_openings(mesh)
    corners = np.concatenate([mesh.vertices[mesh.faces], found.fan])
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(0)
    np.testing.assert_allclose(area, 0, atol=1e-9)
