"""The camera's focal length from all frames, and with what the camera stated."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.relative_pose.camera_focal import FrameOfCamera, estimate_camera_focal
from sl_nerfstudio.relative_pose.estimation import estimate_relative_pose
from tests.relative_pose.two_views import PROJECTORS, view

OFFSETS = ((1.0, 0.25, 0.1), (-0.9, 0.5, 0.3), (0.3, -1.1, -0.2))


def frames_with(factor, noise=0.0, projector="pinhole"):
    """Frames with the poses that a focal length `factor` times the true one gives, that camera, and the true one."""
    found, wrong, true = [], None, None
    for k, offset in enumerate(OFFSETS):
        frame = view(projector, offset=offset, count=300, seed=k, roll_deg=40 * k).noisy(noise, seed=k)
        true = frame.camera
        wrong = replace(true, fl_x=true.fl_x * factor, fl_y=true.fl_y * factor)
        pose = estimate_relative_pose(frame.uv_camera, frame.uv_projector, wrong, PROJECTORS[projector])
        T = pose.T_camera_projector
        keep = pose.inliers
        found.append(FrameOfCamera(frame.uv_camera[keep], frame.uv_projector[keep], (T[:3, :3], T[:3, 3])))
    return found, wrong, true


@pytest.mark.parametrize("projector", ["pinhole", "DOE"])
@pytest.mark.parametrize("factor", [0.97, 1.04])
def test_the_true_focal_length_is_found_from_exact_coordinates(projector, factor):
    frames, wrong, true = frames_with(factor, projector=projector)
    found = estimate_camera_focal(frames, wrong, PROJECTORS[projector], 0.04)
    assert wrong.fl_x * found.from_frames == pytest.approx(true.fl_x, rel=1e-6)
    assert found.factor == pytest.approx(found.from_frames, rel=1e-4)


def test_noise_moves_it_by_about_its_sigma_and_the_stated_value_holds_it():
    frames, stated, _ = frames_with(1.0, noise=0.5)
    loose, tight = (estimate_camera_focal(frames, stated, PROJECTORS["pinhole"], sigma) for sigma in (10.0, 1e-4))
    assert abs(loose.factor - 1) < 3 * loose.sigma and 1e-5 < loose.sigma < 0.02
    assert tight.factor == pytest.approx(1, abs=1e-4) and tight.sigma < 1.001e-4
    assert tight.from_frames == loose.from_frames
    both = 1 / np.hypot(1 / 0.01, 1 / loose.sigma_from_frames)
    assert estimate_camera_focal(frames, stated, PROJECTORS["pinhole"], 0.01).sigma == pytest.approx(both, rel=0.02)


def test_no_frame_is_an_error():
    with pytest.raises(ValueError, match="no frames"):
        estimate_camera_focal([], PROJECTORS["pinhole"], PROJECTORS["pinhole"], 0.04)
