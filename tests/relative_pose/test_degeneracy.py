"""Each degeneracy is found in a scene built for it, and none in a good one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.candidates import plane_relief, rotation_relief
from sl_nerfstudio.relative_pose.epipolar import (
    DegeneracyLimits,
    EpipolarFit,
    PatternBlocks,
    RelativePoseSettings,
    block_count,
    blocks_of,
    ray_pairs,
)
from sl_nerfstudio.relative_pose.estimation import estimate_relative_pose, find_degeneracies
from tests.relative_pose.two_views import PROJECTORS, View, pose_of, view

NOISE = 0.3


def found_in(frame: View, settings: RelativePoseSettings | None = None) -> dict[str, tuple[float, ...]]:
    pose = estimate_relative_pose(*frame.arguments, settings=settings or RelativePoseSettings())
    return {degeneracy.kind: degeneracy.figures for degeneracy in pose.degeneracies}


def part_of(frame: View, keep: np.ndarray) -> View:
    return replace(frame, **{k: getattr(frame, k)[keep] for k in ("uv_camera", "uv_projector", "p_camera")})


# ------------------------------------------------------------------ good frames


@pytest.mark.parametrize("projector", PROJECTORS)
@pytest.mark.parametrize("offset", [(1.0, 0.25, 0.1), (-0.8, 0.6, 0.3), (0.2, -1.0, -0.2)])
def test_a_good_frame_has_no_degeneracy(projector, offset):
    assert found_in(view(projector, offset=offset).noisy(NOISE, seed=0, wrong=0.02)) == {}


# ------------------------------------------------------------------ one scene for each kind


@pytest.mark.parametrize("projector", PROJECTORS)
def test_a_plane(projector):
    found = found_in(view(projector, relief=0.0).noisy(NOISE, seed=0))
    assert "planar" in found
    assert "pure rotation" not in found
    assert "small parallax" not in found
    assert 0 < found["planar"][0] < 6 * NOISE


@pytest.mark.parametrize("projector", PROJECTORS)
def test_a_pure_rotation(projector):
    found = found_in(view(projector, offset=(0.004, 0.0, 0.0)).noisy(NOISE, seed=0))
    assert "pure rotation" in found
    assert "planar" not in found
    assert "small parallax" not in found
    assert 0 < found["pure rotation"][0] < 6 * NOISE


def test_a_small_parallax():
    """More than a pure rotation, because the noise is small; but rays meet at an angle below two degrees."""
    found = found_in(view(offset=(0.1, 0.03, 0.0)).noisy(0.05, seed=0))
    assert "small parallax" in found
    assert "pure rotation" not in found
    expected = np.degrees(np.hypot(0.1, 0.03) / 4.5)
    assert found["small parallax"][0] == pytest.approx(expected, rel=0.2)


@pytest.mark.parametrize("offset", [(0.05, 0.04, -2.0), (-0.1, 0.05, 1.5)], ids=["before", "behind"])
def test_an_epipole_in_view(offset):
    found = found_in(view(offset=offset).noisy(NOISE, seed=0))
    assert found["epipole in view"] == ()


def test_few_points_in_a_corner():
    frame = view().noisy(NOISE, seed=0)
    corner = np.flatnonzero((frame.uv_projector - frame.uv_projector.min(0) < 200).all(1))[:60]
    found = found_in(part_of(frame, corner))
    assert {"few points", "small part of the pattern"} <= found.keys()
    assert 40 < found["few points"][0] <= 60
    covered, whole = found["small part of the pattern"]
    assert whole == 625
    assert 1 < covered < 30


def test_many_points_in_a_corner_are_not_few():
    frame = view(count=40000).noisy(NOISE, seed=0)
    corner = (frame.uv_projector - frame.uv_projector.min(0) < 150).all(1)
    found = found_in(part_of(frame, corner))
    assert "small part of the pattern" in found
    assert "few points" not in found


def test_many_wrong_coordinates():
    found = found_in(view(seed=1).noisy(NOISE, seed=1, wrong=0.45))
    assert 0.3 < found["many outliers"][0] < 0.5


def test_a_poor_fit():
    found = found_in(view().noisy(3.0, seed=0))
    assert found["poor fit"][0] == pytest.approx(3.0, rel=0.2)


def test_an_uncertain_pose():
    """A thin object under strong noise."""
    frame = part_of(view(count=3000), slice(None))
    narrow = (np.abs(frame.uv_camera - [320, 240]) < 40).all(1)
    found = found_in(part_of(frame, narrow).noisy(1.0, seed=0))
    rotation, direction = found["uncertain"]
    assert rotation > 0.5 or direction > 1.5


def test_a_second_solution():
    """A plane has two; what the second best one explains, and what this one does, are the figures."""
    pose = estimate_relative_pose(*view(relief=0.0).noisy(NOISE, seed=0).arguments)
    (figures,) = (d.figures for d in pose.degeneracies if d.kind == "ambiguous")
    assert figures == (pose.alternatives[0].explained, pose.explained)
    assert 0.5 < figures[0] <= figures[1] < 1
    alone = estimate_relative_pose(*view().noisy(NOISE, seed=0).arguments)
    assert alone.alternatives == () and "ambiguous" not in {d.kind for d in alone.degeneracies}


def test_limits_are_those_of_the_settings():
    frame = view().noisy(NOISE, seed=0)
    strict = DegeneracyLimits(
        least_points=10**6, least_block_share=0.99, least_relief_sigmas=1e9, largest_outlier_share=-1.0,
        largest_noise_px=0.0, largest_sigma_rotation_deg=0.0,
    )  # fmt: skip
    found = found_in(frame, RelativePoseSettings(degeneracy=strict))
    assert {"few points", "small part of the pattern", "pure rotation", "many outliers", "poor fit",
            "uncertain"} <= found.keys()  # fmt: skip


# ------------------------------------------------------------------ the pattern's squares


@pytest.mark.parametrize(
    ("w", "h", "count"), [(800, 800, 625), (1280, 720, 375), (1920, 1080, 375), (1080, 1920, 375), (1000, 400, 250)]
)
def test_squares_are_those_that_the_pattern_has(w, h, count):
    projector = Device(w, h, 1000.0, 1000.0, w / 2, h / 2)
    assert block_count(projector, PatternBlocks()) == count
    row, column = np.mgrid[0:h:2, 0:w:2]
    uv = np.stack([column, row], -1).reshape(-1, 2) + 0.5
    assert len(np.unique(blocks_of(uv, projector, PatternBlocks()))) == count
    assert block_count(projector, PatternBlocks(along_longer_side=1)) == 1


@pytest.mark.parametrize(("w", "h"), [(800, 800), (1280, 720), (1920, 1080)])
def test_the_part_of_the_pattern_is_judged_by_its_own_squares(w, h):
    """The same share of the squares is enough for every pattern, and the number of all is the pattern's own."""
    projector = Device(w, h, 1.4 * w, 1.4 * w, w / 2, h / 2)
    whole = block_count(projector, PatternBlocks())
    side = max(w, h) / 25
    rng = np.random.default_rng(0)
    for squares, expected in ((0.9 * 0.048 * whole, True), (1.15 * 0.048 * whole, False)):
        columns = max(1, round(squares / 5))
        low = np.array([w, h]) / 2 - np.array([columns, 5]) * side / 2
        low = np.floor(low / side) * side
        uv = rng.uniform(low + 0.05 * side, low + np.array([columns, 5]) * side - 0.05 * side, (6000, 2))
        frame = lit_from(uv, projector)
        found = found_in(frame)
        assert ("small part of the pattern" in found) is expected, (squares, whole)
        if expected:
            covered, total = found["small part of the pattern"]
            assert total == whole
            assert covered == pytest.approx(5 * columns)
            assert covered / total < 0.048


def lit_from(uv_projector: np.ndarray, projector: Device) -> View:
    """A bumpy surface where rays of given projector pixels meet it, and what a camera sees of it."""
    x, y = ((uv_projector - [projector.cx, projector.cy]) / [projector.fl_x, -projector.fl_y]).T
    depth = 4.5 - 0.3 * np.sin(25 * x) * np.cos(31 * y)
    p = np.stack([x, y, -np.ones_like(x)], -1) * depth[:, None]
    T = pose_of((1.0, 0.25, 0.1), (0.0, 0.0, -4.5), 10.0)
    p_camera = p @ T[:3, :3].T + T[:3, 3]
    camera = Device(640, 480, 800.0, 790.0, 322.0, 238.0)
    uv = p_camera[:, :2] / -p_camera[:, 2:] * [camera.fl_x, -camera.fl_y] + [camera.cx, camera.cy]
    return View(camera, projector, T, uv, uv_projector, p_camera)


# ------------------------------------------------------------------ relief


@settings(max_examples=10)
@given(st.sampled_from(sorted(PROJECTORS)), st.integers(0, 10**6))
def test_what_a_plane_and_a_rotation_explain_leaves_no_relief(projector, seed):
    flat, _ = ray_pairs(*view(projector, relief=0.0, count=300, seed=seed).arguments)
    assert plane_relief(flat) < 1e-6
    assert rotation_relief(flat) > 3
    turned, _ = ray_pairs(*view(projector, offset=(1e-9, 0.0, 0.0), count=300, seed=seed).arguments)
    assert rotation_relief(turned) < 1e-4
    bumpy, _ = ray_pairs(*view(projector, count=300, seed=seed).arguments)
    assert plane_relief(bumpy) > 2
    assert rotation_relief(bumpy) > 3


def test_relief_grows_with_the_surface_and_ignores_a_tenth_of_wrong_coordinates():
    values = [plane_relief(ray_pairs(*view(relief=r).arguments)[0]) for r in (0.1, 0.2, 0.4)]
    assert values[0] < values[1] < values[2]
    assert values[1] == pytest.approx(2 * values[0], rel=0.2)
    flat = view(relief=0.0).noisy(0.0, seed=0, wrong=0.08)
    assert plane_relief(ray_pairs(*flat.arguments)[0]) < 0.1


def test_the_angle_between_rays_is_in_the_figures_of_a_known_geometry():
    """Two devices side by side at distance one from each other, the object at four and a half: 12.5 degrees."""
    frame = view(offset=(1.0, 0.0, 0.0))
    rays, _ = ray_pairs(*frame.arguments)
    T = frame.T_camera_projector
    fit = EpipolarFit(T[:3, :3], T[:3, 3], np.zeros(len(rays)), 0.01, 0.0)
    limits = DegeneracyLimits(least_parallax_deg=90.0)
    everything = np.full(len(rays), True)
    found = {d.kind: d.figures for d in find_degeneracies(fit, rays, everything, (0.0, 0.0), None, 625, limits)}
    assert found["small parallax"][0] == pytest.approx(np.degrees(np.arctan(1 / 4.5)), rel=0.1)
