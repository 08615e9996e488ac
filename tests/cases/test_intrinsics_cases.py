"""Intrinsics files that people have: what they hold is read, or the terms that cannot be are named."""

from pathlib import Path

import pytest

from sl_nerfstudio.calibration.formats import read_device_file
from sl_nerfstudio.errors import UserError

CASES = Path(__file__).parents[3] / "shared" / "cases" / "opencv_14_terms"
SIZE = (1136, 1046)


@pytest.fixture(autouse=True)
def _cases():
    if not CASES.is_dir():
        pytest.skip(f"no cases at {CASES}")


def test_fourteen_coefficients_of_which_nine_to_fourteen_are_zero():
    camera, projector = (read_device_file(CASES / "stereo14_zero.yml", role, SIZE) for role in ("camera", "projector"))
    assert (camera.fl_x, camera.cx) == (3173.5470908336333, 568.0544331842342 + 0.5)
    assert (camera.k1, camera.k2, camera.p1) == (-0.18827534553754133, 2.7711625543207616, 0)
    assert (projector.cx, projector.k1) == pytest.approx((567.17323067777738 + 0.5, -0.24851802551104779), abs=1e-6)


@pytest.mark.parametrize(("role", "term"), [("camera", "k6 = -50.8"), ("projector", "k6 = -29.1")])
def test_a_rational_model_that_a_scan_cannot_express_is_named(role, term):
    with pytest.raises(
        UserError, match=rf"stereo\.yml: {role}: the lens model has terms beyond .*\({term}\)"
    ) as caught:
        read_device_file(CASES / "stereo.yml", role, SIZE)
    assert "CALIB_RATIONAL_MODEL" in str(caught.value)
