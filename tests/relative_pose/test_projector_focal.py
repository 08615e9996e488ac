from dataclasses import replace

import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.relative_pose.estimation import estimate_relative_pose
from sl_nerfstudio.relative_pose.projector_focal import PosedFrame, refine_projector_focal
from tests.relative_pose.two_views import PROJECTORS, view

OFFSETS = ((1.0, 0.25, 0.1), (-0.9, 0.5, 0.3), (0.3, -1.1, -0.2))


def views_with(projector: str, factor: float, noise: float = 0.0):
    """Frames with the relative poses that a focal length `factor` times the true one gives, and that projector."""
    wrong = replace(PROJECTORS[projector], fl_x=PROJECTORS[projector].fl_x * factor,
                    fl_y=PROJECTORS[projector].fl_y * factor)  # fmt: skip
    views = []
    for k, offset in enumerate(OFFSETS):
        frame = view(projector, offset=offset, count=300, seed=k, roll_deg=40 * k).noisy(noise, seed=k)
        pose = estimate_relative_pose(frame.uv_camera, frame.uv_projector, frame.camera, wrong)
        views.append(PosedFrame(frame.uv_camera, frame.uv_projector, frame.camera, pose))
    return views, wrong


@pytest.mark.parametrize("projector", ["pinhole", "DOE"])
def test_the_true_focal_length_is_found_exactly_from_exact_coordinates(projector):
    views, wrong = views_with(projector, 1.03)
    found = refine_projector_focal(views, wrong)
    assert found.projector.fl_x == pytest.approx(PROJECTORS[projector].fl_x, rel=1e-6)
    assert found.projector.fl_y == pytest.approx(PROJECTORS[projector].fl_y, rel=1e-6)
    assert found.significant
    assert found.residual_px[1] < 0.05 * found.residual_px[0]


def test_noise_moves_it_by_about_its_sigma_and_a_right_one_is_left_alone():
    views, stated = views_with("pinhole", 1.0, noise=0.3)
    found = refine_projector_focal(views, stated)
    assert abs(found.factor - 1) < 3 * found.sigma
    assert not found.significant
    assert 1e-5 < found.sigma < 0.02


def test_no_frame_is_an_error():
    with pytest.raises(UserError, match="there is no frame with a relative pose"):
        refine_projector_focal([], PROJECTORS["pinhole"])
