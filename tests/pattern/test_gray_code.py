"""Gray code: neighbours differ in one bit, and the sequence shows the bits."""

import json
from typing import get_args

import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.files import read_layout, read_pattern
from sl_nerfstudio.pattern.gray_code import GrayCode, gray, ungray
from sl_nerfstudio.pattern.layout import SequenceName, ShownImage


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


def test_the_sequence_is_listed_in_the_description():
    document = json.loads(GrayCode(8, 4, 2).encode())
    assert document["sequence"] == [
        "white", "black", "x bit 1", "x bit 1 inverse", "x bit 0", "x bit 0 inverse", "y bit 0", "y bit 0 inverse",
    ]  # fmt: skip


@pytest.mark.parametrize("name", get_args(SequenceName))
def test_the_orders_of_other_programs_are_written_and_read_back(tmp_path, name):
    layout = GrayCode.in_order(name, 64, 48, 4)
    path = tmp_path / "pattern.json"
    path.write_bytes(layout.encode())
    image, back = read_pattern(path)
    assert back == layout and np.array_equal(image, layout.render()) and name in layout.order.split(", ")
    images = list(layout.sequence())
    assert len(images) == layout.images and all(image.shape == (48, 64) for image in images)
    assert [str(ShownImage.of(str(shown))) for shown in layout.shown] == json.loads(layout.encode())["sequence"]


def test_the_orders_are_those_of_the_programs():
    """By the formulas of the programs: bit k of column j is lit where bits k and k + 1 of j differ."""
    opencv = list(GrayCode.in_order("opencv", 16, 8).sequence())
    j = np.arange(16)
    for k in range(4):  # OpenCV writes bit k at 2 n - 2 k - 2, and its inverse behind it
        lit = ((j >> k) ^ (j >> (k + 1))) & 1
        assert (opencv[2 * 4 - 2 * k - 2] == 255 * lit).all() and (opencv[2 * 4 - 2 * k - 1] == 255 * (1 - lit)).all()
    assert opencv[-2].min() == 255 and opencv[-1].max() == 0
    slstudio = list(GrayCode.in_order("slstudio", 60, 40, 1, (12.0, 8.0)).sequence())
    for i in range(3):
        wave = 127.5 * (1 + np.cos(2 * np.pi * np.arange(60) / 12 - 2 * np.pi * i / 3))
        assert np.abs(slstudio[i] - wave).max() <= 0.51
    assert len(slstudio) == 12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: [n for n in s if n[0] != "y"], "shows columns only .*show the other stripes, too"),
        (lambda s: s[2:], "no image white and no image black"),
        (lambda s: [*s, s[3]], "lists x bit 1 inverse more than once"),
        (lambda s: [n for n in s if n != "x bit 0"], "2 bits of x; missing or too many: x bit 0"),
        (lambda s: [*s[:-1], "y bot 0"], "'y bot 0' is no image of a sequence"),
        (lambda s: [*s, "x phase 0 of 3, period 8"], "sines of x with period 8 must have 3 or more steps, all listed"),
        (lambda s: "white", "no list"),
    ],
)
def test_lists_that_do_not_determine_the_pixel(tmp_path, change, message):
    document = json.loads(GrayCode(8, 4, 2).encode())
    path = tmp_path / "pattern.json"
    path.write_text(json.dumps(document | {"sequence": change(document["sequence"])}))
    with pytest.raises(UserError, match=message):
        read_layout(path)
