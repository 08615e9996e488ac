from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sl_nerfstudio.bundle_adjustment.registered_frames import adjust_registered
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pair_registration import ANYWHERE, NEARBY, NEIGHBOURS, register_pair, rotations
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.surface_agreement import Side, agreement
from sl_nerfstudio.registration.surface_map import build_surface_map
from tests.registration.analytic_clouds import clouds_of, errors_against, part_of, rig_of, similarities_of

SIZE, FRAMES = 100, 18  # 20 degrees from frame to frame
RIG = rig_of(FRAMES, SIZE)
TRUE = similarities_of(RIG.T_world_camera.numpy(), RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy())


@pytest.fixture(scope="module")
def clouds():
    return clouds_of(RIG, SIZE, noise=0.1)


@pytest.fixture(scope="module")
def maps(clouds):
    return [build_surface_map(c) for c in clouds]


def between(i: int, j: int) -> Similarity:
    return TRUE[j].inverse() @ TRUE[i]


def difference(a: Similarity, b: Similarity, centre: np.ndarray) -> tuple[float, float, float]:
    """Angle in degrees, shift of the centre and relative scale."""
    D = a @ b.inverse()
    angle = np.degrees(np.arccos(np.clip((np.trace(D.R) - 1) / 2, -1, 1)))
    return angle, float(np.linalg.norm(D.points(centre[None])[0] - centre)), abs(D.scale - 1)


# ------------------------------------------------------------------ pairs


def test_derivatives_of_the_agreement_are_those_of_differences(maps):
    """g is half the derivative of the sum of squared distances where the kernel is wide and nothing is cut off."""
    rng = np.random.default_rng(0)
    sides = [Side(m, *m.sample(300, rng)) for m in (maps[0], maps[1])]
    S = between(0, 1)
    c, wide = maps[1].centroid, 1e3
    g = agreement(*sides, np.array([S.scale]), S.R[None], S.t[None], 0.5, wide).g[0]

    def moved(x):
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(x[3:6]).as_matrix()
        return Similarity(float(np.exp(x[6])), turn, c - np.exp(x[6]) * turn @ c + x[:3]) @ S

    # sums of r itself along each unknown: H[:, k] = sum w J J_k is the change of g with a step along k
    H = agreement(*sides, np.array([S.scale]), S.R[None], S.t[None], 0.5, wide).H[0]
    h = 1e-5
    for k in range(7):
        ahead, behind = (moved(s * h * np.eye(7)[k]) for s in (1, -1))
        g_a, g_b = (
            agreement(*sides, np.array([x.scale]), x.R[None], x.t[None], 0.5, wide).g[0] for x in (ahead, behind)
        )
        # points that change their pixel make single jumps, so the comparison is one of the whole
        assert (g_a - g_b) @ H[:, k] / (2 * h) == pytest.approx(H[:, k] @ H[:, k], rel=0.25)
    assert np.isfinite(g).all()


def test_the_truth_agrees_and_a_displaced_surface_is_seen_in_front(maps):
    rng = np.random.default_rng(0)
    sides = [Side(m, *m.sample(500, rng)) for m in (maps[0], maps[1])]
    S = between(0, 1)
    nearer = Similarity(S.scale, S.R, S.t * 1.0 + np.array([0.0, 0.0, 0.6 * maps[1].radius]))
    found = agreement(
        *sides, np.array([S.scale, nearer.scale]), np.stack([S.R, nearer.R]), np.stack([S.t, nearer.t]), 0.04, 0.04
    )
    assert found.fitness[0] > 0.9
    assert found.agreeing[0] > 0.4
    assert found.score[0] > 3 * max(found.score[1], 0.1)
    assert found.in_front[1] > 0.2


@pytest.mark.parametrize(("i", "j"), [(0, 1), (4, 6), (9, 8)])
def test_neighbours_find_each_other(maps, i, j):
    found = register_pair((maps[i], maps[j]), (i, j), NEIGHBOURS, np.random.default_rng(0))
    angle, shift, scale = difference(found.S_target_source, between(i, j), maps[j].centroid)
    assert angle < 1
    assert shift < 0.02 * maps[j].radius
    assert scale < 0.02
    assert found.fitness > 0.9


def test_a_rolled_camera_is_found_without_a_guess():
    """Frame 1 turned about its line of sight by 130 degrees, as if held that way."""
    roll = Similarity(1.0, _roll(130), np.zeros(3))
    cloud = clouds_of(part_of(_rolled(RIG, 1, 130), [0, 1]), SIZE)
    pair = [build_surface_map(c) for c in cloud]
    found = register_pair((pair[0], pair[1]), (0, 1), ANYWHERE, np.random.default_rng(0))
    angle, _, scale = difference(found.S_target_source, roll.inverse() @ between(0, 1), pair[1].centroid)
    assert angle < 1
    assert scale < 0.02


def test_a_wrong_guess_is_mended_within_its_reach(maps):
    S = between(2, 3)
    wrong = Similarity(1.1 * S.scale, _roll(12) @ S.R, _roll(12) @ S.t)
    found = register_pair((maps[2], maps[3]), (2, 3), NEARBY, np.random.default_rng(0), wrong)
    assert difference(found.S_target_source, S, maps[3].centroid)[0] < 1


def test_searches_hold_what_they_promise():
    near, anywhere = rotations(NEARBY), rotations(ANYWHERE)
    np.testing.assert_allclose(near[0], np.eye(3))
    angle = np.degrees(np.arccos(np.clip((np.trace(near, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angle.max() == pytest.approx(20)
    assert len(anywhere) > 500
    np.testing.assert_allclose(
        anywhere @ anywhere.transpose(0, 2, 1), np.tile(np.eye(3), (len(anywhere), 1, 1)), atol=1e-12
    )


def _roll(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _rolled(rig, frame: int, degrees: float):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(_roll(degrees))
    camera, relative = rig.T_world_camera.clone(), rig.T_camera_projector.clone()
    camera[frame] = camera[frame] @ T
    relative[frame] = T.T @ relative[frame]
    return replace(rig, T_world_camera=camera, T_camera_projector=relative)


# ------------------------------------------------------------------ all frames


@pytest.fixture(scope="module")
def whole(clouds):
    return register(clouds, sequence=True)


def test_a_sequence_is_registered_all_around(whole):
    assert whole.registered.all()
    assert not whole.reasons
    rotation, position, scale = errors_against(RIG, whole.T_world_camera, whole.baseline)
    assert rotation.max() < 1
    assert position.max() < 0.02
    assert np.abs(scale).max() < 0.02


def test_loops_are_closed_and_the_gauge_is_that_of_the_baselines(whole):
    pairs = {edge.frames for edge in whole.edges if edge.used}
    assert ("frame_00000", "frame_00017") in pairs or ("frame_00001", "frame_00017") in pairs
    assert np.exp(np.log(whole.baseline).mean()) == pytest.approx(1)
    np.testing.assert_allclose(whole.T_world_camera[0], np.eye(4), atol=1e-9)


def test_the_joint_adjustment_brings_frames_to_their_places(clouds, whole):
    few = AdjustmentSettings(anchors_per_frame=120, max_iterations=16)
    found = adjust_registered(clouds, whole, few)
    baseline = np.linalg.norm(found.T_world_camera[:, :3, 3] - found.T_world_projector[:, :3, 3], axis=1)
    rotation, _, scale = errors_against(RIG, found.T_world_camera, baseline)
    assert rotation.max() < 0.3
    assert np.abs(scale).max() < 0.006
    assert found.median_after_px < found.median_before_px
    assert found.intrinsics == ""
    assert all(s is not None and s.camera_translation > 0 for s in found.sigma)
    assert np.exp(np.log(baseline).mean()) == pytest.approx(1)
    twice = found.scaled(2.0)
    np.testing.assert_allclose(twice.T_world_camera[:, :3, 3], 2 * found.T_world_camera[:, :3, 3])
    assert twice.sigma[0].relative_translation == pytest.approx(2 * found.sigma[0].relative_translation)
    assert twice.sigma[0].camera_rotation_deg == found.sigma[0].camera_rotation_deg


def test_a_wrong_camera_is_told(clouds, whole):
    long = [replace(c, camera=replace(c.camera, fl_x=1.03 * c.camera.fl_x, fl_y=1.03 * c.camera.fl_y)) for c in clouds]
    found = adjust_registered(long, whole, AdjustmentSettings(anchors_per_frame=120, max_iterations=16))
    assert found.intrinsics.startswith("The intrinsics contradict the captures")
    assert "camera: focal length -" in found.intrinsics


def test_an_unordered_set_is_registered(clouds):
    order = [3, 0, 4, 1, 2]
    found = register([clouds[k] for k in order], sequence=False)
    assert found.registered.all()
    rotation, _, scale = errors_against(part_of(RIG, order), found.T_world_camera, found.baseline)
    assert rotation.max() < 1
    assert np.abs(scale).max() < 0.02


def test_rough_camera_poses_are_a_start(clouds):
    order = [0, 1, 2, 3]
    rig = part_of(RIG, order)
    start = rig.T_world_camera.numpy().copy()
    turn = np.eye(4)
    turn[:3, :3] = _roll(8)
    start[1] = turn @ start[1]
    start[2, :3, 3] *= 1.05
    found = register([clouds[k] for k in order], start=start)
    assert found.registered.all()
    rotation, _, scale = errors_against(rig, found.T_world_camera, found.baseline)
    assert rotation.max() < 1
    assert np.abs(scale).max() < 0.02


def test_rough_cameras_may_look_past_the_object(clouds):
    """Each turned by 8 degrees about itself, one to the left and one to the right: nothing overlaps as given."""
    order = [0, 1, 2, 3]
    rig = part_of(RIG, order)
    start = rig.T_world_camera.numpy().copy()
    for k, sign in enumerate((1, -1, 1, -1)):
        start[k, :3, :3] = start[k, :3, :3] @ Rotation.from_rotvec([0, sign * np.radians(8), 0]).as_matrix()
    found = register([clouds[k] for k in order], start=start)
    assert found.registered.all()
    rotation, _, scale = errors_against(rig, found.T_world_camera, found.baseline)
    assert rotation.max() < 1
    assert np.abs(scale).max() < 0.02


def on_a_ball(cloud, radius: float, name: str):
    """The frame as if it had seen nothing but a ball about the middle of its points."""
    centre = cloud.centroid * (1 + 0.5 * cloud.radius / np.linalg.norm(cloud.centroid))
    ray = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    b = ray @ centre
    root = b * b - centre @ centre + (radius * cloud.radius) ** 2
    hit = root > 0
    points = ray[hit] * (b[hit] - np.sqrt(root[hit]))[:, None]
    parts = {k: getattr(cloud, k)[hit] for k in ("uv_camera", "sigma_noise", "sigma_pose")}
    return replace(cloud, name=name, points=points, **parts)


def test_a_frame_of_another_object_is_named_and_left_out(clouds):
    rig = part_of(RIG, [0, 1, 2, 3, 4])
    frames = [*clouds[:5], on_a_ball(clouds[5], 0.7, "stranger")]
    found = register(frames)
    assert found.registered.tolist() == [True] * 5 + [False]
    assert set(found.reasons) == {"stranger"}
    assert "capture" in found.reasons["stranger"]
    assert np.isnan(found.T_world_camera[5]).all()
    rotation, _, _ = errors_against(rig, found.T_world_camera[:5], found.baseline[:5])
    assert rotation.max() < 1
    poses = adjust_registered(frames, found, AdjustmentSettings(anchors_per_frame=60, max_iterations=3))
    assert np.isnan(poses.T_world_projector[5]).all()
    assert poses.sigma[5] is None


def test_a_ball_says_that_its_turns_are_unknown(clouds):
    found = register([on_a_ball(clouds[k], 0.8, f"ball {k}") for k in range(3)])
    assert found.registered.any()
    assert all(edge.slack_deg > 3 for edge in found.edges)
    assert any("ball 1: its rotation is known to" in r or "ball 1: a clearly different" in r for r in found.remarks)


def test_a_single_registered_frame_is_an_error_that_says_why(clouds, whole):
    alone = replace(whole, registered=np.arange(FRAMES) == 0, reasons={"frame_00009": "shares nothing"})
    with pytest.raises(UserError, match=r"1 of 18 frames could be registered(.|\n)*frame_00009: shares nothing"):
        adjust_registered(clouds, alone)
