"""OpenCV's files, read without OpenCV: the same values, and an end to depth, size and tricks."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sl_nerfstudio.calibration.formats import read_device_file, read_file_storage
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan.document import FileError

SIZE = (640, 480)


def xml(content: str) -> str:
    return f'<?xml version="1.0"?>\n<opencv_storage>{content}</opencv_storage>'


def camera(matrix: str = "900. 0. 320. 0. 900. 240. 0. 0. 1.", width: str = "640") -> str:
    return xml(
        f"<image_width>{width}</image_width><image_height>480</image_height><camera_matrix>"
        f"<rows>3</rows><cols>3</cols><dt>d</dt><data>{matrix}</data></camera_matrix>"
    )


@pytest.mark.parametrize("suffix", ["xml", "yml", "yaml"])
@settings(max_examples=20)
@given(
    matrix=arrays.arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(1, 5)), elements=st.floats(-1e30, 1e30)),
    number=st.floats(allow_nan=False, allow_infinity=False),
    text=st.text("abc xyz", min_size=1),
)
def test_what_opencv_writes_is_read(tmp_path_factory, suffix, matrix, number, text) -> None:
    path = tmp_path_factory.getbasetemp() / f"ä.{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("matrix", matrix)
    file.write("small", matrix.astype(np.float32))
    file.write("number", number)
    file.write("text", "t" + text)
    file.release()
    found = read_file_storage(path)
    np.testing.assert_array_equal(found["matrix"], matrix)
    np.testing.assert_allclose(found["small"], matrix.astype(np.float32), rtol=1e-6, atol=1e-37)
    assert found["number"] == number and found["text"].split() == ("t" + text).split()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xml", xml("<a>" * 50_000), "nested too deeply"),
        ("a.xml", xml("<a>" * 50_000 + "</a>" * 50_000), "nested too deeply"),
        ("a.xml", '<!DOCTYPE a [<!ENTITY b "c">]>' + xml("<a>&b;</a>"), "document type"),
        ("a.xml", camera()[:-40], "no element found|mismatched|unclosed"),
        ("a.xml", xml("<a>1</a><a>2</a>"), "more than once"),
        ("a.xml", xml("<a>" + "1 " * 400_000 + "</a>"), "far more than a calibration"),
        ("a.yml", "%YAML:1.0\n---\na: " + "[" * 100_000, "nested too deeply"),
        ("a.yml", "%YAML:1.0\n---\na: &x [ *x ]", "an earlier part of itself"),
        ("a.yml", "%YAML:1.0\n---\na: 1\na: 2", "more than once"),
        ("a.yml", "%YAML:1.0\n---\n- 1", "no names with values"),
        ("a.yml", "a: 1", "does not start with %YAML"),
        ("a.xml", camera("1. 2. wide 4. 5. 6. 7. 8. 9."), "something that is not a number"),
        ("a.xml", camera("1. 2. 3."), "a matrix of 3 x 3 has 3 numbers"),
        ("a.xml", xml("<camera_matrix>none</camera_matrix>"), "is no 3 x 3 matrix of numbers"),
        ("a.xml", camera("900. 9. 320. 0. 900. 240. 0. 0. 1."), "has a skew of 9"),
        ("a.xml", camera("900. 0. 320. 0. 900. 240. 0. 0. 2."), "the last row 0, 0, 2"),
        ("a.xml", camera("900. 0. 0. 0. 900. 0. 320. 240. 1."), "the last row 320, 240, 1"),
        ("a.xml", camera(width="wide"), "the size of the image is not two whole numbers"),
        ("a.xml", camera(width="640.5"), "the size of the image is not two whole numbers"),
        ("a.json", '{"camera": {"w": 640, "h": 480, "fl_x": 900, "fl_y": 900, "cx": 320, "cy": 240, "k1": 50}}',
         "multiply distances from the principal point by"),
    ],
)  # fmt: skip
def test_what_is_refused(tmp_path: Path, name: str, content: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(UserError, match=message) as caught:
        read_device_file(path, "camera", SIZE)
    assert isinstance(caught.value, FileError) and "remedy:" in str(caught.value)


def test_what_is_right_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text(camera("900. 0.01 320. 0. 900. 240. 0. 0. 1."))  # a skew of a rounding
    assert read_device_file(path, "camera", SIZE).cx == 320.5
