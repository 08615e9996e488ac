"""The relative pose of a frame, and its degeneracies: each in a scene built for it, and none in a good one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose import estimation
from sl_nerfstudio.relative_pose.epipolar import NOISE_FLOOR_PX, block_count, ray_pairs
from sl_nerfstudio.relative_pose.estimation import (
    RelativePoseError,
    estimate_relative_pose,
    plane_relief,
    relative_pose_near,
    rotation_relief,
)
from tests.relative_pose.two_views import CAMERA, PROJECTORS, View, errors_deg, pose_of, view

NOISE = 0.3


def estimate(frame: View, seed: int = 0):
    return estimate_relative_pose(*frame.arguments, seed=seed)


@settings(max_examples=9)
@given(st.integers(0, 10**6), st.sampled_from(sorted(PROJECTORS)), st.floats(-180, 180), st.floats(0, 2 * np.pi))
def test_exact_coordinates_give_the_exact_pose_on_any_side_with_any_roll(seed, projector, roll, bearing):
    offset = (1.2 * np.cos(bearing), 1.2 * np.sin(bearing), -0.1)
    frame = view(projector, offset=offset, count=300, seed=seed, roll_deg=roll)
    found = estimate(frame, seed)
    assert max(errors_deg(found.T_camera_projector, frame.T_camera_projector)) < 1e-6
    assert np.linalg.norm(found.T_camera_projector[:3, 3]) == pytest.approx(1, abs=1e-12)
    assert found.inliers.all() and found.residual_px == NOISE_FLOOR_PX


@pytest.mark.parametrize("projector", PROJECTORS)
def test_noise_and_wrong_coordinates_leave_the_pose_within_a_fifth_of_a_degree(projector):
    frame = view(projector).noisy(NOISE, seed=3, wrong=0.2)
    found = estimate(frame)
    assert max(errors_deg(found.T_camera_projector, frame.T_camera_projector)) < 0.2
    assert 0.75 < found.inliers.mean() < 0.85
    assert found.residual_px == pytest.approx(NOISE, rel=0.35)  # a fifth of wrong ones widens the median
    again = estimate(frame)  # the seed alone decides
    assert np.array_equal(found.T_camera_projector, again.T_camera_projector)
    assert np.array_equal(found.covariance, again.covariance)
    near = relative_pose_near(frame.T_camera_projector, *frame.arguments)
    assert max(errors_deg(near.T_camera_projector, found.T_camera_projector)) < 1e-3


def test_pixels_without_a_ray_are_no_inliers_and_do_no_harm():
    frame = view("DOE", count=300)
    uv = frame.uv_projector.copy()
    uv[:20] = 5000.0  # beyond 90 degrees
    uv[20:30] = np.nan
    found = estimate(replace(frame, uv_projector=uv))
    assert max(errors_deg(found.T_camera_projector, frame.T_camera_projector)) < 1e-6
    assert not found.inliers[:30].any() and found.inliers[30:].all()


def test_what_has_no_relative_pose_is_refused_with_cause_and_remedy(monkeypatch):
    with pytest.raises(RelativePoseError, match=r"12 decoded pixels are too few(.|\n)*remedy: more light"):
        estimate(view(count=12))
    frame = view(count=1000)
    uv = np.random.default_rng(99).uniform(0, 800, frame.uv_projector.shape)
    with pytest.raises(RelativePoseError, match=r"(.|\n)*pattern file is not the one(.|\n)*remedy: check pattern"):
        estimate(replace(frame, uv_projector=uv))
    monkeypatch.setattr(estimation, "LEAST_INLIER_SHARE", 1.1)
    with pytest.raises(RelativePoseError, match="best relative pose fits"):
        estimate(frame)


# ------------------------------------------------------------------ degeneracies


def kinds(frame: View) -> dict[str, tuple[float, ...]]:
    return {degeneracy.kind: degeneracy.figures for degeneracy in estimate(frame).degeneracies}


def part_of(frame: View, keep: np.ndarray) -> View:
    return replace(frame, **{k: getattr(frame, k)[keep] for k in ("uv_camera", "uv_projector", "p_camera")})


def test_of_a_small_object_the_points_are_few_and_the_pose_is_uncertain():
    frame = view(count=3000)
    narrow = part_of(frame, (np.abs(frame.uv_camera - [320, 240]) < 40).all(1))
    rotation, direction = kinds(narrow.noisy(1.0, seed=0))["uncertain"]
    assert rotation > 0.5 or direction > 1.5
    few = kinds(part_of(frame, np.arange(60)).noisy(NOISE, seed=0))["few points"][0]
    assert 40 < few <= 60


@pytest.mark.parametrize("projector", PROJECTORS)
@pytest.mark.parametrize("offset", [(1.0, 0.25, 0.1), (-0.8, 0.6, 0.3), (0.2, -1.0, -0.2)])
def test_a_good_frame_has_no_degeneracy(projector, offset):
    assert kinds(view(projector, offset=offset).noisy(NOISE, seed=0, wrong=0.02)) == {}


@pytest.mark.parametrize("projector", PROJECTORS)
@pytest.mark.parametrize(
    ("kind", "scene"), [("planar", {"relief": 0.0}), ("pure rotation", {"offset": (0.004, 0.0, 0.0)})]
)
def test_a_plane_and_a_pure_rotation_are_told_apart(projector, kind, scene):
    found = kinds(view(projector, **scene).noisy(NOISE, seed=0))
    assert {"planar", "pure rotation", "small parallax"} & found.keys() == {kind}
    assert 0 < found[kind][0] < 6 * NOISE
    if kind == "planar":  # two poses explain it: the figures are what the second best one explains, and this one
        second, best = found["ambiguous"]
        assert 0.5 < second <= best < 1


@pytest.mark.parametrize(
    ("kind", "scene", "noise", "wrong", "figure"),
    [
        # More than a pure rotation, because the noise is small; but rays meet at an angle below two degrees.
        ("small parallax", {"offset": (0.1, 0.03, 0.0)}, 0.05, 0.0, np.degrees(np.hypot(0.1, 0.03) / 4.5)),
        ("epipole in view", {"offset": (0.05, 0.04, -2.0)}, NOISE, 0.0, None),
        ("epipole in view", {"offset": (-0.1, 0.05, 1.5)}, NOISE, 0.0, None),  # the mirror image behind
        ("many outliers", {"seed": 1}, NOISE, 0.45, 0.4),
        ("poor fit", {}, 3.0, 0.0, 3.0),
    ],
)
def test_a_degeneracy_is_named_with_its_figure(kind, scene, noise, wrong, figure):
    found = kinds(view(**scene).noisy(noise, seed=0, wrong=wrong))
    assert kind != "small parallax" or "pure rotation" not in found
    assert found[kind] == (() if figure is None else (pytest.approx(figure, rel=0.25),))


@pytest.mark.parametrize(("w", "h"), [(800, 800), (1280, 720), (1920, 1080)])
def test_the_part_of_the_pattern_is_judged_by_its_own_squares(w, h):
    """The same share of the squares is enough for every pattern, and the number of all is the pattern's own."""
    projector = Device(w, h, 1.4 * w, 1.4 * w, w / 2, h / 2)
    whole, side, rng = block_count(projector), max(w, h) / 25, np.random.default_rng(0)
    for squares, small in ((0.9 * 0.048 * whole, True), (1.15 * 0.048 * whole, False)):
        columns = max(1, round(squares / 5))
        low = np.floor((np.array([w, h]) - np.array([columns, 5]) * side) / 2 / side) * side
        uv = rng.uniform(low + 0.05 * side, low + np.array([columns, 5]) * side - 0.05 * side, (6000, 2))
        found = kinds(lit_from(uv, projector))
        assert found.get("small part of the pattern") == ((5 * columns, whole) if small else None)


def lit_from(uv_projector: np.ndarray, projector: Device) -> View:
    """A bumpy surface where rays of given projector pixels meet it, and what a camera sees of it."""
    x, y = ((uv_projector - [projector.cx, projector.cy]) / [projector.fl_x, -projector.fl_y]).T
    p = np.stack([x, y, -np.ones_like(x)], -1) * (4.5 - 0.3 * np.sin(25 * x) * np.cos(31 * y))[:, None]
    T = pose_of((1.0, 0.25, 0.1), (0.0, 0.0, -4.5), 10.0)
    p = p @ T[:3, :3].T + T[:3, 3]
    uv = p[:, :2] / -p[:, 2:] * [CAMERA.fl_x, -CAMERA.fl_y] + [CAMERA.cx, CAMERA.cy]
    return View(CAMERA, projector, T, uv, uv_projector, p)


@settings(max_examples=10)
@given(st.sampled_from(sorted(PROJECTORS)), st.integers(0, 10**6))
def test_what_a_plane_and_a_rotation_explain_leaves_no_relief(projector, seed):
    def relief(**scene):
        rays, _ = ray_pairs(*view(projector, count=300, seed=seed, **scene).arguments)
        return plane_relief(rays), rotation_relief(rays)

    plane, rotation = relief(relief=0.0)
    assert plane < 1e-6 and rotation > 3
    assert relief(offset=(1e-9, 0.0, 0.0))[1] < 1e-4
    plane, rotation = relief()
    assert plane > 2 and rotation > 3
