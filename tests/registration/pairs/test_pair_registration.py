"""Two frames onto each other."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.agreement import Hypotheses
from sl_nerfstudio.registration.pairs import around_guess, register_pair, rotations, without_guess
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, Search
from sl_nerfstudio.registration.surfaces import build_surface_map
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, difference, on_a_ball, part_of, rolled, similarities_of
from tests.registration.shaped_clouds import with_wall

SIZE, FRAMES = 100, 18  # 20 degrees from frame to frame
RIG = rig_of(FRAMES, SIZE)
TRUE = similarities_of(RIG.T_world_camera.numpy(), RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy())
PAIR = REGISTRATION_DEFAULTS.pair


@pytest.fixture(scope="module")
def clouds():
    return clouds_of(RIG, SIZE, noise=0.1)


@pytest.fixture(scope="module")
def maps(clouds):
    return [build_surface_map(c) for c in clouds]


def between(i: int, j: int) -> Similarity:
    return TRUE[j].inverse() @ TRUE[i]


def with_rolled_frame(rig, frame: int, degrees: float):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(rolled(degrees))
    camera, relative = rig.T_world_camera.clone(), rig.T_camera_projector.clone()
    camera[frame] = camera[frame] @ T
    relative[frame] = T.T @ relative[frame]
    return replace(rig, T_world_camera=camera, T_camera_projector=relative)


@pytest.mark.parametrize(("i", "j"), [(0, 1), (4, 6), (9, 8)])
def test_neighbours_find_each_other(maps, i, j):
    found = register_pair((maps[i], maps[j]), (i, j), PAIR.neighbours, np.random.default_rng(0))
    angle, shift, scale = difference(found.S_target_source, between(i, j), maps[j].centroid)
    assert angle < 1
    assert shift < 0.02 * maps[j].radius
    assert scale < 0.02
    assert (found.source, found.target) == (i, j)
    assert found.fitness > 0.9
    assert found.fitness >= found.overlap > 0.4
    assert 0 < found.rms < 0.03
    assert found.second_best_ratio < REGISTRATION_DEFAULTS.edge.ambiguous_ratio
    assert found.rotation_sigma_deg < 1


def test_both_directions_of_a_pair_agree(maps):
    there, back = (register_pair((maps[i], maps[j]), (i, j), PAIR.neighbours, np.random.default_rng(0))
                   for i, j in ((2, 3), (3, 2)))  # fmt: skip
    angle, shift, scale = difference(there.S_target_source, back.between(2, 3), maps[3].centroid)
    assert angle < 0.5
    assert shift < 0.02 * maps[3].radius
    assert scale < 0.02


def test_a_rolled_camera_is_found_without_a_guess():
    """Frame 1 rotated about its line of sight by 130 degrees, as if held that way."""
    roll = Similarity(1.0, rolled(130), np.zeros(3))
    cloud = clouds_of(part_of(with_rolled_frame(RIG, 1, 130), [0, 1]), SIZE)
    pair = [build_surface_map(c) for c in cloud]
    found = register_pair((pair[0], pair[1]), (0, 1), PAIR.anywhere, np.random.default_rng(0))
    angle, _, scale = difference(found.S_target_source, roll.inverse() @ between(0, 1), pair[1].centroid)
    assert angle < 1
    assert scale < 0.02


def test_a_wrong_guess_is_corrected_within_its_reach(maps):
    S = between(2, 3)
    wrong = Similarity(1.1 * S.scale, rolled(12) @ S.R, rolled(12) @ S.t)
    found = register_pair((maps[2], maps[3]), (2, 3), PAIR.nearby, np.random.default_rng(0), wrong)
    assert difference(found.S_target_source, S, maps[3].centroid)[0] < 1


def test_the_scale_stays_within_its_bound(maps):
    """Without the prior a cloud would collapse onto a patch; the bound holds whatever the prior says."""
    S = between(2, 3)
    wrong = Similarity(3.0 * S.scale, S.R, S.t)
    loose = replace(PAIR, scale_sigma=100.0)
    found = register_pair((maps[2], maps[3]), (2, 3), PAIR.nearby, np.random.default_rng(0), wrong, loose)
    if found is not None:
        assert abs(np.log(found.S_target_source.scale / wrong.scale)) <= PAIR.largest_log_scale + 1e-9


def test_opposite_sides_of_the_object_are_no_good_match(maps):
    found = register_pair((maps[0], maps[9]), (0, 9), PAIR.neighbours, np.random.default_rng(0))
    assert found is None or found.fitness < 0.85 or found.overlap < 0.15


def test_a_frame_without_surface_matches_nothing(maps):
    empty = replace(maps[0], valid=np.zeros_like(maps[0].valid))
    for pair in ((empty, maps[1]), (maps[1], empty)):
        assert register_pair(pair, (0, 1), PAIR.neighbours, np.random.default_rng(0)) is None


def test_a_ball_leaves_the_rotation_open(clouds):
    """Its information about translation is as good as that of other surfaces."""
    balls = [build_surface_map(on_a_ball(clouds[k], 0.8, str(k))) for k in (0, 1)]
    found = register_pair((balls[0], balls[1]), (0, 1), PAIR.neighbours, np.random.default_rng(0))
    assert found.fitness > 0.9
    assert found.rotation_sigma_deg > 3
    eigenvalues = np.linalg.eigvalsh(found.information[:3, :3])
    assert eigenvalues[0] > 100 * np.radians(1 / found.rotation_sigma_deg) ** 2


@pytest.mark.parametrize("walled", [(True, False), (False, True)], ids=["source", "target"])
def test_a_wall_that_one_frame_alone_saw_does_not_move_the_alignment(clouds, walled):
    distance = 3 * np.linalg.norm(clouds[2].centroid)
    pair = tuple(build_surface_map(with_wall(clouds[k], distance) if w else clouds[k])
                 for k, w in zip((2, 3), walled, strict=True))  # fmt: skip
    found = register_pair((pair[0], pair[1]), (2, 3), PAIR.neighbours, np.random.default_rng(0))
    centre, radius = clouds[3].centroid, clouds[3].radius
    angle, shift, scale = difference(found.S_target_source, between(2, 3), centre)
    assert angle < 1
    assert shift < 0.02 * radius
    assert scale < 0.02


def test_the_result_does_not_depend_on_the_lengths_of_the_baselines(clouds):
    """One cloud ten times as large, the other a third: the same pair."""
    factors = 10.0, 1 / 3
    scaled = tuple(build_surface_map(in_unit(clouds[k], f)) for k, f in zip((2, 3), factors, strict=True))
    plain = tuple(build_surface_map(clouds[k]) for k in (2, 3))
    a, b = (register_pair((x, y), (2, 3), PAIR.neighbours, np.random.default_rng(0)) for x, y in (plain, scaled))
    S = Similarity.scaling(1 / factors[1]) @ b.S_target_source @ Similarity.scaling(factors[0])
    angle, shift, scale = difference(S, a.S_target_source, plain[1].centroid)
    assert angle < 0.05 and shift < 1e-3 * plain[1].radius and scale < 1e-3
    for key in ("overlap", "fitness", "rms", "rotation_sigma_deg"):
        assert getattr(b, key) == pytest.approx(getattr(a, key), rel=0.02, abs=5e-3)


def in_unit(cloud, factor: float):
    return replace(cloud, **{key: factor * getattr(cloud, key) for key in ("points", "sigma_noise", "pose_errors")})


# ------------------------------------------------------------------ starts


def test_searches_reach_as_far_as_they_say():
    near, anywhere = rotations(PAIR.nearby), rotations(PAIR.anywhere)
    np.testing.assert_allclose(near[0], np.eye(3))
    angle = np.degrees(np.arccos(np.clip((np.trace(near, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angle.max() == pytest.approx(20)
    assert len(anywhere) > 500
    np.testing.assert_allclose(
        anywhere @ anywhere.transpose(0, 2, 1), np.tile(np.eye(3), (len(anywhere), 1, 1)), atol=1e-12
    )


@settings(max_examples=20)
@given(st.floats(0, 20), st.integers(0, 10**6))
def test_every_rotation_within_reach_has_a_start_nearby(degrees, seed):
    """In a cubic lattice nothing is farther from a node than half the diagonal of a cell, plus its curvature."""
    axis = np.random.default_rng(seed).standard_normal(3)
    wanted = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
    search = Search(20.0, 5.0)
    away = (Rotation.from_matrix(rotations(search)) * wanted.inv()).magnitude()
    assert np.degrees(away.min()) < 5.0 * np.sqrt(3) / 2 + 2.5


def test_starts_keep_the_object_where_it_is(maps):
    S = between(2, 3)
    found = around_guess(maps[3], PAIR.nearby, S)
    count = len(rotations(PAIR.nearby))
    assert len(found) == count * len(maps[3].views)
    for k in range(len(found)):
        centre = maps[3].views[k // count].centre
        np.testing.assert_allclose(found.similarity(k).points(S.inverse().points(centre[None]))[0], centre, atol=1e-9)
    blind = without_guess(maps[2], maps[3], PAIR.neighbours, (0.5, 2.0))
    count = len(rotations(PAIR.neighbours))
    assert len(blind) == 2 * count * len(maps[2].views)
    for k in range(0, len(blind), 17):
        a, b = (m.views[k // (2 * count)] for m in (maps[2], maps[3]))
        S = blind.similarity(k)
        np.testing.assert_allclose(S.points(a.centre[None])[0], b.centre, atol=1e-9)
        assert S.scale * a.size / b.size == pytest.approx((0.5, 2.0)[k // count % 2])
    np.testing.assert_array_equal(blind.log_scale_prior, np.log(blind.scale))


def test_the_difference_of_hypotheses_is_that_of_their_similarities(maps):
    a, b, c = between(2, 3), between(1, 3), maps[3].centroid
    both = Hypotheses.joined([Hypotheses.of(S) for S in (a, b)])
    angle_deg, shift = both.difference(0, 1, c)
    expected = difference(a, b, c)
    assert angle_deg == pytest.approx(expected[0])
    assert shift == pytest.approx(expected[1])
    assert both[[1]].similarity(0).scale == b.scale
