"""Triangles drawn into an image: every pixel inside one has its weights."""

import numpy as np
import pytest

from sl_nerfstudio.meshing.texture import draw_triangles


def weights_of(corners, p):
    """Barycentric weights by solving the linear system."""
    return np.linalg.solve(np.vstack([corners.T, np.ones(3)]), np.append(p, 1.0))


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0)], ids=["clockwise", "anticlockwise"])
def test_pixels_of_a_triangle_have_its_weights_and_its_gutter_is_two_pixels_wide(order):
    size = 40
    corners = np.array([[0.2, 0.25], [0.8, 0.3], [0.45, 0.9]])[list(order)]
    triangle, weights = draw_triangles(corners[None], size)
    beside = []
    for row in range(size):
        for column in range(size):
            p = np.array([column + 0.5, row + 0.5]) / size
            expected = weights_of(corners, p)
            if expected.min() >= 0:
                assert triangle[row, column] == 0
            if triangle[row, column] == 0:
                np.testing.assert_allclose(weights[row, column], expected, atol=1e-4)
                edges = [(corners[(k + 1) % 3], corners[(k + 2) % 3]) for k in range(3)]
                height = [
                    abs(np.cross(b - a, corners[k] - a)) / np.linalg.norm(b - a) for k, (a, b) in enumerate(edges)
                ]
                beside.append(max(0.0, *(-expected * height * size)))
    assert 1.0 < max(beside) <= 2.0 + 1e-6


def test_a_pixel_inside_one_triangle_is_not_taken_by_the_gutter_of_another():
    first, second = [[0.0, 0.0], [0.5, 0.0], [0.0, 1.0]], [[0.5, 0.0], [0.5, 1.0], [0.0, 1.0]]
    for pair in ([first, second], [second, first]):
        corners = np.array(pair)
        triangle, weights = draw_triangles(corners, 16)
        inside = weights.min(-1) >= 0
        for row, column in zip(*np.nonzero(triangle >= 0), strict=True):
            p = np.array([column + 0.5, row + 0.5]) / 16
            if any(weights_of(c, p).min() >= 0 for c in corners):
                assert inside[row, column]


def test_degenerate_triangles_cover_nothing():
    corners = np.array([[[0.1, 0.1], [0.5, 0.5], [0.9, 0.9]], [[0.3, 0.3]] * 3])
    assert (draw_triangles(corners, 8)[0] == -1).all()
