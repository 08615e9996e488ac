"""pattern.json: what is written is read back, and faults are named."""

import json

import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.files import read_layout, read_pattern
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import encode_png

ABSENT = "no value: the key is left out"


@pytest.fixture
def grid():
    return GridPattern(w=160, h=120, period=16.0, line_width=3.0, gap=5.0, seed=9)


@pytest.fixture
def path(grid, tmp_path):
    path = tmp_path / "pattern.json"
    path.write_bytes(grid.encode())
    return path


@pytest.mark.parametrize("size", [{"w": 160, "h": 120}, {"w": 520, "h": 500, "seed": 4}])  # and one of a low margin
def test_a_grid_is_read_back(size, path):
    grid = GridPattern(**size)
    path.write_bytes(grid.encode())
    back = read_layout(path)
    assert np.array_equal(back.codes, grid.codes) and np.array_equal(back.render(), grid.render())


def test_every_row_of_the_codes_is_one_line(grid, path):
    """The format is fixed: decoded frames are found again by a digest of this text."""
    text = path.read_text()
    document = json.loads(text)
    codes = document.pop("codes")
    rows = ",\n  ".join("[" + ",".join(map(str, row)) + "]" for row in codes)
    assert text == json.dumps(document, indent=1)[:-2] + f',\n "codes": [\n  {rows}\n ]\n}}\n'
    assert list(document)[:5] == ["sl_pattern", "kind", "image", "w", "h"]
    assert codes == np.asarray(grid.codes).tolist()


def test_a_description_and_its_picture_are_the_same_pattern(grid, path, tmp_path):
    picture, described = tmp_path / "pattern.png", read_pattern(path)
    picture.write_bytes(encode_png(np.rint(255 * grid.render()).astype(np.uint8)))
    image, no_layout = read_pattern(picture)
    assert no_layout is None and described[1].kind == "grid"
    np.testing.assert_allclose(image, described[0], atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "dots"}, 'this describes no pattern: "kind" must be one of "grid", "gray-code"'),
        ({"kind": ["grid"]}, "this describes no pattern"),
        ({"sl_pattern": 2}, "sl_pattern, the version of the file's format, is 2; this version reads 1"),
        ({"period": None}, "contradicts itself"),
        ({"codes": [[0, 1], [2]]}, "contradicts itself"),
        ({"codes": [[9] * 10] * 7}, "codes must be rows of whole numbers from 0 to 4"),
        ({"codes": [[0] * 3] * 3}, "must be 7 x 10, got 3 x 3"),
        ({"gap": 100}, "gap 100"),
        ({"sl_pattern": ABSENT}, r'is missing; this version reads 1\n.*add "sl_pattern": 1'),
        ({"line_width": ABSENT}, "line_width is missing; write the file again"),
        ({"w": 160.5}, "w is 160.5, not a whole number"),
        ({"h": 10**400}, "h: holds|h is 1000"),
        ({"x0": 3}, "x0 is 3, but w, h and period make it"),
        ({"dark": 1}, "dark is 1"),
        ({"w": 10**7, "h": 10**7}, "too large"),
        ({"seed": 10}, "codes are not those of seed"),
        ({"codes": [[2] * 10] * 7}, "codes are not those of seed"),
        ({"hamming_margin": 2, "hamming_margin_turned": 0}, "codes are not those of seed"),
    ],
)
def test_faulty_descriptions(path, change, message):
    document = json.loads(path.read_text()) | change
    path.write_text(json.dumps({key: value for key, value in document.items() if value != ABSENT}))
    with pytest.raises(UserError, match=message) as caught:
        read_layout(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", ["pattern.png", "PATTERN.JPG"])
def test_a_picture_is_no_description(grid, tmp_path, name):
    (tmp_path / name).write_bytes(encode_png((255 * grid.render()).astype(np.uint8)))
    with pytest.raises(UserError, match=r"is a picture(.|\n)*give the pattern\.json"):
        read_layout(tmp_path / name)


def test_each_symbol_counts(grid, path):
    document, codes = json.loads(path.read_text()), np.asarray(grid.codes)
    for code in (1e308, 10**30, 0.5, -1, None, "1", True):
        rows = codes.tolist()
        rows[2][3] = code
        path.write_text(json.dumps(document | {"codes": rows}))
        with pytest.raises(UserError, match="contradicts itself: codes "):
            read_layout(path)
    for place in np.random.default_rng(0).choice(codes.size, 10, replace=False):
        other = codes.copy()
        other.flat[place] = (other.flat[place] + 1) % 5
        path.write_text(json.dumps(document | {"codes": other.tolist()}))
        with pytest.raises(UserError, match="codes are not those of seed 9"):
            read_layout(path)
