"""Depth along camera rays, a camera from all frames, and stated intrinsics that the frames contradict."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.calibration.stated import StatedSigma
from sl_nerfstudio.geometry.devices import Device, DeviceChange, Intrinsics, project
from sl_nerfstudio.geometry.triangulation import closest_approach
from sl_nerfstudio.relative_pose.epipolar import moved
from sl_nerfstudio.relative_pose.estimation import estimate_relative_pose
from sl_nerfstudio.relative_pose.intrinsics import (
    SIGMA_CENTRE,
    camera_depth,
    camera_depth_by_pose,
    check_intrinsics,
    estimate_camera,
)
from sl_nerfstudio.relative_pose.joint_fit import FrameMatches
from tests.relative_pose.two_views import CAMERA, PROJECTORS, SHIFTED, frames_of, view


@given(st.integers(0, 2**20))
def test_depth_is_where_the_rays_come_closest_with_derivatives_by_the_pose(seed):
    """A projector beside a camera, and rays of both to points that lie near the ones they see."""
    rng = np.random.default_rng(seed)
    R, t = Rotation.from_rotvec(rng.normal(0, 0.4, 3)).as_matrix(), rng.normal(size=3)
    t /= np.linalg.norm(t)
    p = rng.normal(size=(40, 3)) + [0, 0, -5]
    beside = (p + rng.normal(0, 0.02, p.shape) - t) @ R
    rays = [q / np.linalg.norm(q, axis=1, keepdims=True) for q in (p, beside)]
    zero, d = torch.zeros(3, dtype=torch.float64), torch.from_numpy(rays[0])
    expected, _ = closest_approach(zero, d, torch.from_numpy(t), torch.from_numpy(rays[1] @ R.T))
    assert camera_depth(R, t, *rays) == pytest.approx(expected.numpy(), rel=1e-9)
    h = 1e-6
    slopes = [
        (camera_depth(*moved(R, t, step), *rays) - camera_depth(*moved(R, t, -step), *rays)) / (2 * h)
        for step in h * np.eye(5)
    ]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    for projector in PROJECTORS.values():
        depth, by_pixel, found = camera_depth_by_pose(T, projector, *rays)
        assert depth == pytest.approx(expected.numpy(), rel=1e-9)
        near, far = (torch.from_numpy(((depth + step)[:, None] * rays[0] - t) @ R) for step in (-h, h))
        (low, seen), (high, _) = (project(Intrinsics.of(projector, torch.float64), point) for point in (near, far))
        slope = (high - low).norm(dim=-1).numpy() / (2 * h)
        assert by_pixel[seen] == pytest.approx(1 / slope[seen], rel=1e-4) and seen.any()
    scale = np.abs(found).max(0)
    np.testing.assert_allclose(found / scale, np.stack(slopes, 1) / scale, rtol=1e-4, atol=1e-7)


# ------------------------------------------------------------------ a rough camera


def estimated(factor=1.0, noise=0.0, projector="pinhole", shift=0.0, sigma=0.04):
    """The camera from frames with the poses that a focal length `factor` times the true one gives, and the stated."""
    stated = replace(CAMERA, fl_x=CAMERA.fl_x * factor, fl_y=CAMERA.fl_y * factor, cx=CAMERA.cx + shift)
    frames, poses = [], []
    for k, offset in enumerate(((1.0, 0.25, 0.1), (-0.9, 0.5, 0.3), (0.3, -1.1, -0.2))):
        frame = view(projector, offset=offset, count=300, seed=k, roll_deg=40 * k).noisy(noise, seed=k)
        found = estimate_relative_pose(frame.uv_camera, frame.uv_projector, stated, PROJECTORS[projector])
        keep, T = found.inliers, found.T_camera_projector
        frames.append(FrameMatches(f"{k}", frame.uv_camera[keep], frame.uv_projector[keep], stated))
        poses.append((T[:3, :3], T[:3, 3]))
    return estimate_camera(frames, poses, stated, PROJECTORS[projector], sigma), stated


@pytest.mark.parametrize(("projector", "factor", "shift"), [("pinhole", 1.04, 3.0), ("DOE", 0.97, 0.0)])
def test_the_true_camera_is_found_from_exact_coordinates(projector, factor, shift):
    found = estimated(factor, projector=projector, shift=shift)[0].camera
    assert (found.fl_x, found.fl_y) == pytest.approx((CAMERA.fl_x, CAMERA.fl_y), rel=1e-4)
    assert (found.cx, found.cy) == pytest.approx((CAMERA.cx, CAMERA.cy), abs=0.05)
    assert found.k1 == pytest.approx(CAMERA.k1, abs=1e-3)


def test_noise_moves_it_by_about_its_sigma_and_what_was_known_before_holds_it():
    found, _ = estimated(noise=0.5)
    assert abs(found.camera.fl_x - CAMERA.fl_x) < 3 * found.sigma_focal_px < 0.12 * CAMERA.fl_x
    for name, sigma in zip(("cx", "cy"), found.sigma_centre_px, strict=True):
        assert abs(getattr(found.camera, name) - getattr(CAMERA, name)) < 3 * sigma
        assert sigma < 1.001 * SIGMA_CENTRE * CAMERA.w
    tight, stated = estimated(noise=0.5, sigma=1e-5)
    assert tight.camera.fl_x == pytest.approx(stated.fl_x, rel=1e-5)
    assert tight.sigma_focal_px < 1.001e-5 * stated.fl_x
    with pytest.raises(ValueError, match="no frames"):
        estimate_camera([], [], CAMERA, PROJECTORS["pinhole"], 0.04)


# ------------------------------------------------------------------ stated intrinsics


@pytest.fixture(scope="module")
def noisy():
    return frames_of(SHIFTED, 6, noise=0.3)


def evidence(frames: list[FrameMatches], projector: Device):
    found = [estimate_relative_pose(f.uv_camera, f.uv_projector, f.camera, projector) for f in frames]
    T = [pose.T_camera_projector for pose in found]
    return check_intrinsics(frames, [(t[:3, :3], t[:3, 3]) for t in T], projector)


def test_right_intrinsics_are_not_contradicted(noisy):
    found = evidence(noisy, SHIFTED)
    assert not found.contradicts()
    assert found.projector.chi_square < 20 and found.camera.chi_square < 20


@pytest.mark.parametrize(
    ("role", "part", "wrong"),
    [
        ("projector", "focal length", DeviceChange(0.03, 0.0, 0.0)),
        ("camera", "focal length", DeviceChange(0.03, 0.0, 0.0)),  # in the other device it would need its centre, too
        ("projector", "principal point", DeviceChange(0.0, 0.0, -0.04)),
    ],
)
def test_a_wrong_part_of_a_device_is_named_with_its_value(noisy, role, part, wrong):
    frames = [replace(f, camera=wrong.applied(f.camera)) if role == "camera" else f for f in noisy[:5]]
    found = evidence(frames, wrong.applied(SHIFTED) if role == "projector" else SHIFTED)
    assert found.contradicts()
    first = found.explanations()[0]
    assert (first.role, first.part) == (role, part)
    k = 0 if part == "focal length" else 2
    true = 1 / 1.03 - 1 if k == 0 else 0.04
    assert abs(first.change[k] - true) < 4 * first.sigma[k] < 0.03


def test_errors_within_what_a_calibration_states_are_no_contradiction(noisy):
    """A camera off by its stated 1 sigma; a projector off by many is one all the same."""
    doubt = StatedSigma(camera=(0.015, 0.015, 0.015)).either
    change = DeviceChange(0.015, 0.015, -0.015)
    moved = evidence([replace(f, camera=change.applied(f.camera)) for f in noisy], SHIFTED)
    assert moved.contradicts() and not moved.allowing(doubt).contradicts()
    wrong = evidence(noisy, replace(SHIFTED, fl_x=1.2 * SHIFTED.fl_x, fl_y=1.2 * SHIFTED.fl_y))
    assert wrong.allowing(doubt).contradicts()
