"""The camera's intrinsics from all frames, and with what was known before."""

from dataclasses import replace

import pytest

from sl_nerfstudio.relative_pose.epipolar import CAMERA_ESTIMATE_DEFAULTS
from sl_nerfstudio.relative_pose.estimation import estimate_relative_pose
from sl_nerfstudio.relative_pose.intrinsics import FrameOfCamera, estimate_camera
from tests.relative_pose.two_views import PROJECTORS, view

OFFSETS = ((1.0, 0.25, 0.1), (-0.9, 0.5, 0.3), (0.3, -1.1, -0.2))


def frames_with(factor, noise=0.0, projector="pinhole", moved=0.0):
    """Frames with the poses that a focal length `factor` times the true one gives, that camera, and the true one."""
    found, wrong, true = [], None, None
    for k, offset in enumerate(OFFSETS):
        frame = view(projector, offset=offset, count=300, seed=k, roll_deg=40 * k).noisy(noise, seed=k)
        true = frame.camera
        wrong = replace(true, fl_x=true.fl_x * factor, fl_y=true.fl_y * factor, cx=true.cx + moved)
        pose = estimate_relative_pose(frame.uv_camera, frame.uv_projector, wrong, PROJECTORS[projector])
        T = pose.T_camera_projector
        keep = pose.inliers
        found.append(FrameOfCamera(frame.uv_camera[keep], frame.uv_projector[keep], (T[:3, :3], T[:3, 3])))
    return found, wrong, true


@pytest.mark.parametrize(("projector", "factor", "moved"), [("pinhole", 1.04, 3.0), ("DOE", 0.97, 0.0)])
def test_the_true_camera_is_found_from_exact_coordinates(projector, factor, moved):
    frames, wrong, true = frames_with(factor, projector=projector, moved=moved)
    found = estimate_camera(frames, wrong, PROJECTORS[projector], 0.04).camera
    assert (found.fl_x, found.fl_y) == pytest.approx((true.fl_x, true.fl_y), rel=1e-4)
    assert (found.cx, found.cy) == pytest.approx((true.cx, true.cy), abs=0.05)
    assert found.k1 == pytest.approx(true.k1, abs=1e-3)


def test_noise_moves_it_by_about_its_sigma_and_what_was_known_before_holds_it():
    frames, stated, true = frames_with(1.0, noise=0.5)
    found = estimate_camera(frames, stated, PROJECTORS["pinhole"], 0.04)
    assert abs(found.camera.fl_x - true.fl_x) < 3 * found.sigma_focal_px < 0.12 * true.fl_x
    for got, exact, sigma in zip((found.camera.cx, found.camera.cy), (true.cx, true.cy), found.sigma_centre_px,
                                 strict=True):  # fmt: skip
        assert abs(got - exact) < 3 * sigma and sigma < 1.001 * CAMERA_ESTIMATE_DEFAULTS.sigma_centre * max(
            true.w, true.h
        )
    # What was known before holds it.
    tight = estimate_camera(frames, stated, PROJECTORS["pinhole"], 1e-5)
    assert tight.camera.fl_x == pytest.approx(stated.fl_x, rel=1e-5)
    assert tight.sigma_focal_px < 1.001e-5 * stated.fl_x


def test_no_frame_is_an_error():
    with pytest.raises(ValueError, match="no frames"):
        estimate_camera([], PROJECTORS["pinhole"], PROJECTORS["pinhole"], 0.04)
