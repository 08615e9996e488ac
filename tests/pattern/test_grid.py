"""The coded grid: nodes where they should be, gaps as the symbols say, and nothing else."""

import numpy as np
import pytest

from sl_nerfstudio.pattern.codes import rotate_codes
from sl_nerfstudio.pattern.grid import GridPattern

_PERIOD, _GAP, _WIDTH = 20.0, 6.0, 4.0


def _grid(symbol):
    """A 7 x 7 grid of plain crossings but for `symbol` in the middle."""
    codes = np.zeros((7, 7), dtype=np.int8)
    codes[3, 3] = symbol
    return GridPattern(w=140, h=140, period=_PERIOD, line_width=_WIDTH, gap=_GAP, codes=codes)


def _centre_of_light(grid, uv):
    light = grid.intensity(uv)
    return (light[:, None] * uv).sum(0) / light.sum()


def _height_of_horizontal_line(grid, x, node):
    y = np.linspace(node[1] - 8, node[1] + 8, 321)
    return _centre_of_light(grid, np.stack([np.full_like(y, x), y], -1))[1] - node[1]


def _place_of_vertical_line(grid, y, node):
    x = np.linspace(node[0] - 8, node[0] + 8, 321)
    return _centre_of_light(grid, np.stack([x, np.full_like(x, y)], -1))[0] - node[0]


@pytest.mark.parametrize(
    ("symbol", "left", "right", "above", "below"),
    [(0, 0, 0, 0, 0), (1, -1, 1, 0, 0), (2, 1, -1, 0, 0), (3, 0, 0, 1, -1), (4, 0, 0, -1, 1)],
)
def test_each_symbol_shifts_its_segments_by_half_a_gap(symbol, left, right, above, below):
    grid, at = _grid(symbol), 9.0  # places off the crossing, where only one line is seen
    node = grid.nodes()[3, 3]
    shrink = 1 - at / _PERIOD  # a segment returns to the next node, which has no gap
    expected = np.array([left, right, above, below]) * _GAP / 2 * shrink
    measured = [
        _height_of_horizontal_line(grid, node[0] - at, node),
        _height_of_horizontal_line(grid, node[0] + at, node),
        _place_of_vertical_line(grid, node[1] - at, node),
        _place_of_vertical_line(grid, node[1] + at, node),
    ]
    np.testing.assert_allclose(measured, expected, atol=0.02)


def test_lines_have_their_width_and_the_rest_is_dark():
    grid = _grid(0)
    x = np.linspace(20.0, 40.0, 4001)[:-1]  # one period, away from crossings
    light = grid.intensity(np.stack([x, np.full_like(x, 60.0)], -1))
    assert light.mean() * _PERIOD == pytest.approx(_WIDTH, abs=0.01)
    assert light.max() == 1 and light.min() == 0


def test_nodes_of_the_default_pattern():
    grid = GridPattern()
    nodes = grid.nodes()
    assert (grid.rows, grid.columns) == (40, 40)
    np.testing.assert_allclose(nodes[0, 0], (10, 10))
    np.testing.assert_allclose(nodes[-1, -1], (790, 790))
    np.testing.assert_allclose(nodes[2, 5], (110, 50))
    assert (grid.intensity(nodes[grid.codes == 0]) == 1).all()


def test_turning_the_picture_is_turning_the_codes():
    grid = GridPattern(w=200, h=200, seed=2)
    turned = GridPattern(w=200, h=200, codes=rotate_codes(grid.codes, 1))
    np.testing.assert_allclose(np.rot90(grid.render(), -1), turned.render(), atol=1e-6)


def test_pictures_are_reproducible_and_in_range():
    image = GridPattern(seed=4).render()
    assert image.shape == (800, 800) and image.dtype == np.float32
    assert image.min() >= 0 and image.max() <= 1
    assert np.array_equal(image, GridPattern(seed=4).render())
    assert not np.array_equal(image, GridPattern(seed=5).render())


def test_dark_level():
    image = GridPattern(w=100, h=100, dark=0.25).render()
    assert image.min() == pytest.approx(0.25) and image.max() == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"line_width": 0.0}, "line_width 0"),
        ({"line_width": 25.0}, "line_width 25"),
        ({"gap": 17.0}, "gap 17"),
        ({"w": 50}, "fewer than 3 x 3 nodes"),
        ({"codes": np.zeros((3, 3), np.int8)}, "must be 40 x 40, got 3 x 3"),
    ],
)
def test_grids_that_cannot_be_drawn(options, message):
    with pytest.raises(ValueError, match=message):
        GridPattern(**options)
