"""Gray code: neighbours differ in one bit, and the sequence shows the bits."""

import json

import numpy as np
import pytest

from sl_nerfstudio.pattern.files import read_layout, read_pattern
from sl_nerfstudio.pattern.graycode import GrayCode, gray, ungray


def test_neighbours_differ_in_one_bit_and_indices_are_recovered():
    cells = np.arange(1 << 11)
    codes = gray(cells)
    assert {int(x).bit_count() for x in codes[1:] ^ codes[:-1]} == {1}
    assert np.array_equal(ungray(codes, 11), cells)


@pytest.mark.parametrize("layout", [GrayCode(40, 30, 2), GrayCode(37, 21, 4), GrayCode(1024, 16, 1)])
def test_the_sequence_encodes_the_cell_of_every_pixel(layout):
    images = list(layout.sequence())
    assert len(images) == layout.images and images[0].min() == 255 and images[1].max() == 0
    for axis, size in ((0, layout.w), (1, layout.h)):
        code = np.zeros((layout.h, layout.w), dtype=np.int64)
        for direct, inverse in layout.bit_images(axis):
            assert (images[direct].astype(int) + images[inverse] == 255).all()
            code = 2 * code + (images[direct] > 0)
        cell = np.arange(size) // layout.cell
        expected = np.broadcast_to(cell if axis == 0 else cell[:, None], code.shape)
        assert np.array_equal(ungray(code, layout.bits[axis]), expected)
    picture = layout.render()
    assert picture.shape == (layout.h, layout.w) and np.array_equal(picture, layout.render(4))
    finest = [images[layout.bit_images(axis)[-1][0]] / 255 for axis in (0, 1)]
    np.testing.assert_allclose(picture, (finest[0] + finest[1]) / 2)


def test_full_hd_in_cells_of_two_pixels_is_42_images():
    layout = GrayCode(1920, 1080, 2)
    assert (layout.columns, layout.rows, layout.bits, layout.images) == (960, 540, (10, 10), 42)


def test_the_description_is_read_back(tmp_path):
    path = tmp_path / "pattern.json"
    path.write_bytes(GrayCode(1280, 720, 4).encode())
    assert read_layout(path) == GrayCode(1280, 720, 4)
    image, layout = read_pattern(path)
    assert layout == GrayCode(1280, 720, 4) and np.array_equal(image, layout.render())
    assert layout.lattice is None


def test_the_sequence_is_listed_in_the_description():
    document = json.loads(GrayCode(8, 4, 2).encode())
    assert document["sequence"] == [
        "white", "black", "x bit 1", "x bit 1 inverse", "x bit 0", "x bit 0 inverse", "y bit 0", "y bit 0 inverse",
    ]  # fmt: skip


def test_sizes_that_cannot_make_a_sequence():
    with pytest.raises(ValueError, match="at least 2 x 2 cells"):
        GrayCode(3, 100, 2)
