"""Intrinsics of a projector from all frames: exact from exact coordinates, within their sigma otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.geometry.devices import Device, DeviceChange
from sl_nerfstudio.relative_pose import unknown_projector
from sl_nerfstudio.relative_pose.joint_fit import LOG_ASPECT, device_with, values_of
from sl_nerfstudio.relative_pose.unknown_projector import NoProjector, estimate_projector
from tests.relative_pose.two_views import PROJECTORS, SHIFTED, frames_of

pytestmark = pytest.mark.slow

BLANK = Device(SHIFTED.w, SHIFTED.h, 1.5 * SHIFTED.w, 1.5 * SHIFTED.w, SHIFTED.w / 2, SHIFTED.h / 2)


@pytest.fixture(autouse=True)
def few_starts(monkeypatch):
    monkeypatch.setattr(unknown_projector, "STARTS", 2)


def test_exact_coordinates_give_the_intrinsics_exactly_whatever_the_start():
    """The principal point lies 1.2 heights below the middle of the image; nothing but the image's size is known."""
    exact = frames_of(SHIFTED, 6)
    for start, stated in ((BLANK, False), (replace(BLANK, fl_x=1.2 * SHIFTED.fl_x, fl_y=1.2 * SHIFTED.fl_x), True)):
        found = estimate_projector(exact, start, stated, 0)
        assert not isinstance(found, NoProjector) and found.cause is None and not found.centre_kept
        np.testing.assert_allclose(values_of(found.projector), values_of(SHIFTED), atol=1e-6)
        assert found.noise_px < 2e-3 and found.free == (0, 2, 3)


def test_stated_sigma_covers_the_errors():
    found = estimate_projector(frames_of(SHIFTED, 6, noise=0.3), BLANK, False, 0)
    assert not isinstance(found, NoProjector)
    error = values_of(found.projector) - values_of(SHIFTED)
    known = found.sigma > 0
    assert known.sum() >= 3 and (np.abs(error[known]) < 3.5 * found.sigma[known]).all()
    assert 1e-4 < found.sigma[0] < 0.02
    assert found.noise_px == pytest.approx(0.3, rel=0.15)


def test_the_aspect_is_free_where_left_out_squares_demand_it():
    squeezed = replace(SHIFTED, fl_y=0.9 * SHIFTED.fl_x)
    found = estimate_projector(frames_of(squeezed, 6, noise=0.1, points=200), BLANK, False, 0)
    assert not isinstance(found, NoProjector) and LOG_ASPECT in found.free
    assert values_of(found.projector)[LOG_ASPECT] == pytest.approx(np.log(0.9), abs=0.02)


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"count": 2}, "few frames"),
        ({"count": 4, "alike": True}, "similar frames"),
        ({"count": 3, "relief": 0.0}, "flat"),
    ],
    ids=["two frames", "one relative pose", "a plane"],
)
def test_frames_that_do_not_determine_it_are_refused_with_what_was_measured(changes, cause):
    found = estimate_projector(frames_of(SHIFTED, **changes, noise=0.3), BLANK, False, 0)
    assert isinstance(found, NoProjector)
    assert found.cause == cause


def test_a_stated_principal_point_is_kept_where_only_the_focal_length_can_be_found():
    start = device_with(SHIFTED, values_of(SHIFTED) + [np.log(1.05), 0, 0, 0, 0])
    found = estimate_projector(frames_of(SHIFTED, 3, noise=0.3, alike=True), start, True)
    assert not isinstance(found, NoProjector)
    assert found.centre_kept and found.free == (0,)
    assert abs(np.log(found.projector.fl_x / SHIFTED.fl_x)) < 4 * found.sigma[0]


def test_a_diffractive_projector_is_refined_from_a_stated_one():
    true = PROJECTORS["DOE"]
    start = replace(true, fl_x=1.03 * true.fl_x, fl_y=1.03 * true.fl_y)
    found = estimate_projector(frames_of(true, 5), start, True)
    assert not isinstance(found, NoProjector)
    np.testing.assert_allclose(values_of(found.projector)[[0, 2, 3]], values_of(true)[[0, 2, 3]], atol=1e-5)
    assert isinstance(estimate_projector(frames_of(true, 5), start, False), NoProjector)


DOUBT = (0.004, 0.003, 0.005)  # of the camera, shares of its focal length


def test_an_uncertain_camera_makes_the_projector_as_uncertain_as_it_moves_it():
    """Exact coordinates, so that nothing else moves it: within what three values of 1 sigma each can do together."""
    change = DeviceChange(-DOUBT[0], DOUBT[1], DOUBT[2])
    frames = [replace(f, camera=change.applied(f.camera)) for f in frames_of(SHIFTED, 4, points=200)]
    found = estimate_projector(frames, SHIFTED, True, 0, DOUBT)
    certain = estimate_projector(frames, SHIFTED, True, 0)
    assert not isinstance(found, NoProjector) and not isinstance(certain, NoProjector)
    assert found.projector == certain.projector
    index = [0, 2, 3]
    error = np.abs(values_of(found.projector) - values_of(SHIFTED))[index]
    assert (error < 2 * found.sigma[index]).all()
    assert (error > 3 * certain.sigma[index]).any()
