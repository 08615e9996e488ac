"""A start for the camera from EXIF data: focal length in pixels with its doubt, or what is missing."""

import math

import numpy as np
import pillow_heif
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sl_nerfstudio.calibration.stated import camera_from_exif
from sl_nerfstudio.errors import UserError

SIZE = (120, 90)


def photograph(path, orientation=1, **tags):
    """A picture whose Exif part has the tags, by their names."""
    codes = {"focal": 0x920A, "film": 0xA405, "plane": 0xA20E, "unit": 0xA210, "width": 0xA002, "zoom": 0xA404}
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update({codes[name]: value for name, value in tags.items()})
    image = Image.fromarray(np.full((90, 120, 3), 90, np.uint8))
    if path.suffix == ".heic":
        pillow_heif.from_pillow(image).save(path, exif=exif.tobytes())
    else:
        image.save(path, exif=exif)
    return path


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.heic"])
def test_the_35_mm_equivalent_is_taken_by_the_diagonal(tmp_path, name):
    start = camera_from_exif([photograph(tmp_path / name, film=26, focal=IFDRational(42, 10))], SIZE)
    assert start.camera.fl_x == start.camera.fl_y == pytest.approx(26 * 150 / math.hypot(36, 24))
    assert (start.camera.cx, start.camera.cy, start.camera.k1) == (60, 45, 0)
    assert 0.03 < start.sigma < 0.04 and start.source == "26 mm (35 mm equivalent)"


def test_the_focal_length_and_the_sensors_resolution(tmp_path):
    """50 mm and 4000 pixels on 36 mm, for an image reduced from 4000 to 120 pixels and turned."""
    path = photograph(tmp_path / "a.jpg", 6, focal=50, plane=IFDRational(40000, 36), unit=3, width=4000)
    start = camera_from_exif([path], SIZE[::-1])
    assert start.camera.fl_x == pytest.approx(50 * 4000 / 36 * 120 / 4000, rel=1e-6)
    assert (start.camera.w, start.camera.h) == (90, 120) and start.sigma == pytest.approx(0.03)


def test_a_digital_zoom_adds_to_the_doubt(tmp_path):
    plain = camera_from_exif([photograph(tmp_path / "a.jpg", film=26)], SIZE)
    zoomed = camera_from_exif([photograph(tmp_path / "b.jpg", film=26, zoom=2.0)], SIZE)
    assert zoomed.sigma > 0.1 > plain.sigma and "digital zoom 2" in zoomed.source


def test_what_is_not_stated_or_changes_is_refused(tmp_path):
    first = photograph(tmp_path / "a.jpg", film=26)
    with pytest.raises(UserError, match=r"several focal lengths \(26 mm, 52 mm\)(.*\n)*.*one lens and one zoom"):
        camera_from_exif([first, photograph(tmp_path / "b.jpg", film=52)], SIZE)
    for tags in ({}, {"focal": 4.2}, {"film": 0}, {"focal": 50, "plane": 100, "unit": 9}):
        with pytest.raises(UserError, match=r"c.jpg: does not say with which focal length(.*\n)*.*sl-calibrate"):
            camera_from_exif([photograph(tmp_path / "c.jpg", **tags)], SIZE)
