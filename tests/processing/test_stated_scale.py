"""The known length on the command line becomes data in the scan."""

import pytest

from sl_nerfstudio.processing.scan_poses import stated_scale
from sl_nerfstudio.registration.result import KnownLength
from sl_nerfstudio.scan import PickedPixel, Scale


def test_a_baseline_is_stated_by_the_name_of_its_frame():
    found = stated_scale(KnownLength(0.085, "mm", ("IMG 7",)))
    assert found == Scale(True, "baseline of frame IMG 7", baseline_of="IMG 7")


@pytest.mark.parametrize(("unit", "length"), [("m", 0.05), ("cm", 5.0), ("mm", 50.0), ("um", 50_000.0)])
def test_a_scale_bar_is_stated_by_its_pixels_and_its_length_in_the_unit(unit, length):
    found = stated_scale(KnownLength(0.05, unit, ("a", "b"), ((410.5, 200.0), (35.0, 80.0))))
    ends = (PickedPixel("a", (410.5, 200.0)), PickedPixel("b", (35.0, 80.0)))
    assert found.known and found.baseline_of is None and found.bar is not None
    assert found.bar.ends == ends and found.bar.length == pytest.approx(length, rel=1e-12)
