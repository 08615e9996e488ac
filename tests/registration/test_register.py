from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl_nerfstudio.bundle_adjustment.registered_frames import (
    RegisteredFramesSettings,
    adjust_registered,
)
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.result import contradiction
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.result import NoCommonSurface, PoorPair, SeparateComponent
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, errors_against, on_a_ball, part_of, pose_errors, rolled
from tests.registration.shaped_clouds import rendered

pytestmark = pytest.mark.slow

SIZE, FRAMES = 100, 18  # 20 degrees from frame to frame
RIG = rig_of(FRAMES, SIZE)


def small(anchors: int, iterations: int) -> RegisteredFramesSettings:
    """Settings without the question whether there are other minima."""
    adjustment = AdjustmentSettings(anchors_per_frame=anchors, max_iterations=iterations, other_minima=0)
    return RegisteredFramesSettings(adjustment=adjustment)


@pytest.fixture(scope="module")
def clouds():
    return clouds_of(RIG, SIZE, noise=0.1)


@pytest.fixture(scope="module")
def whole(clouds):
    return register(clouds, sequence=True)


def test_a_sequence_is_registered_all_around(whole):
    assert whole.registered.all()
    assert whole.ordered
    assert not whole.exclusions
    assert not whole.uncertainties
    rotation, position, scale = errors_against(RIG, whole.T_world_camera, whole.baseline)
    assert rotation.max() < 1
    assert position.max() < 0.02
    assert np.abs(scale).max() < 0.02


def test_loops_are_closed_and_the_gauge_is_that_of_the_baselines(whole):
    pairs = {edge.frames for edge in whole.edges if edge.used}
    assert ("frame_00000", "frame_00017") in pairs or ("frame_00001", "frame_00017") in pairs
    assert np.exp(np.log(whole.baseline).mean()) == pytest.approx(1)
    np.testing.assert_allclose(whole.T_world_camera[0], np.eye(4), atol=1e-9)


def test_bundle_adjustment_improves_the_poses(clouds, whole):
    found = adjust_registered(clouds, whole, small(120, 16))
    poses, baseline = found.poses, found.poses.baseline
    rotation, _, scale = errors_against(RIG, poses.T_world_camera, baseline)
    assert rotation.max() < 0.3
    assert np.abs(scale).max() < 0.006
    assert found.median_after_px < found.median_before_px
    assert found.intrinsics is not None and not found.intrinsics.contradicts()
    assert all(s is not None and s.camera_translation > 0 for s in found.sigma)
    assert np.exp(np.log(baseline).mean()) == pytest.approx(1)
    twice = found.scaled(2.0)
    np.testing.assert_allclose(twice.poses.T_world_camera[:, :3, 3], 2 * poses.T_world_camera[:, :3, 3])
    np.testing.assert_allclose(twice.poses.baseline, 2 * baseline)
    np.testing.assert_allclose(twice.poses.T_world_projector[:, :3, :3], poses.T_world_projector[:, :3, :3])
    assert twice.sigma[0].relative_translation == pytest.approx(2 * found.sigma[0].relative_translation)
    assert twice.sigma[0].camera_rotation_deg == found.sigma[0].camera_rotation_deg


def test_a_wrong_camera_is_reported(clouds, whole):
    long = [replace(c, camera=replace(c.camera, fl_x=1.03 * c.camera.fl_x, fl_y=1.03 * c.camera.fl_y)) for c in clouds]
    found = adjust_registered(long, whole, small(120, 16)).intrinsics
    assert found is not None and found.contradicts()
    text = contradiction(found, [cloud.camera for cloud in long], long[0].projector)
    assert text.startswith("The intrinsics contradict the captures (chi square ")
    assert "camera: focal length -" in text
    assert contradiction(None, [], long[0].projector) == ""


def test_an_unordered_set_is_registered(clouds):
    order = [3, 0, 4, 1, 2]
    found = register([clouds[k] for k in order], sequence=False)
    assert found.registered.all()
    rotation, _, scale = errors_against(part_of(RIG, order), found.T_world_camera, found.baseline)
    assert rotation.max() < 1
    assert np.abs(scale).max() < 0.02


def test_a_shuffled_sequence_is_recognised_and_registered_all_the_same():
    """The frames are said to follow each other; each is 120 degrees from the next, and from the one after that."""
    some = rendered("head", (0, 8, 16, 2, 10, 18, 4, 12, 20, 6, 14, 22))
    found = register(some.clouds, sequence=True)
    assert not found.ordered
    kept = found.registered
    assert kept.sum() >= 10
    assert {e.frame for e in found.exclusions} == {n for n, here in zip(found.names, kept, strict=True) if not here}
    truth, found_poses = (some.T_world_camera, some.baseline), (found.T_world_camera, found.baseline)
    rotation, position, _ = pose_errors(*(x[kept] for x in (*truth, *found_poses)))
    assert rotation.max() < 1.5
    assert position.max() < 0.03


@pytest.mark.parametrize(
    ("scene", "frames"),
    [("leaf", (0, 2, 4, 6, 8, 10)), ("head", (4, 5, 6, 16, 17))],
    ids=["leaf", "two sides of a head"],
)
def test_frames_that_share_little_are_right_or_named(scene, frames):
    """A sheet that some frames see nearly from its edge, and two sides of an object without what is between."""
    some = rendered(scene, frames)
    found = register(some.clouds)
    kept = found.registered
    assert kept.sum() >= 2
    assert {e.frame for e in found.exclusions} == {n for n, here in zip(found.names, kept, strict=True) if not here}
    for why in found.exclusions:
        assert isinstance(why, SeparateComponent | PoorPair | NoCommonSurface)
        if isinstance(why, SeparateComponent):
            assert why.frame in why.component
            assert why.partner is None or why.partner in {n for n, here in zip(found.names, kept, strict=True) if here}
    truth, found_poses = (some.T_world_camera, some.baseline), (found.T_world_camera, found.baseline)
    rotation, position, _ = pose_errors(*(x[kept] for x in (*truth, *found_poses)))
    assert rotation.max() < 3
    assert position.max() < 0.06


def test_rough_camera_poses_are_a_start(clouds):
    order = [0, 1, 2, 3]
    rig = part_of(RIG, order)
    start = rig.T_world_camera.numpy().copy()
    turn = np.eye(4)
    turn[:3, :3] = rolled(8)
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


def test_a_frame_of_another_object_is_named_and_left_out(clouds):
    rig = part_of(RIG, [0, 1, 2, 3, 4])
    frames = [*clouds[:5], on_a_ball(clouds[5], 0.7, "stranger")]
    found = register(frames)
    assert found.registered.tolist() == [True] * 5 + [False]
    (why,) = found.exclusions
    assert isinstance(why, PoorPair | SeparateComponent) and why.frame == "stranger"
    assert why.partner in found.names[:5]
    if isinstance(why, PoorPair):
        assert why.overlap < why.least_overlap == 0.15 or why.fitness < why.least_fitness == 0.6
    else:
        assert why.component == ("stranger",)
    assert np.isnan(found.T_world_camera[5]).all()
    rotation, _, _ = errors_against(rig, found.T_world_camera[:5], found.baseline[:5])
    assert rotation.max() < 1
    adjusted = adjust_registered(frames, found, small(60, 3))
    assert np.isnan(adjusted.poses.T_world_projector[5]).all()
    assert np.isfinite(adjusted.poses.T_world_projector[:5]).all()
    assert adjusted.sigma[5] is None


def test_the_rotation_of_a_ball_is_uncertain(clouds):
    """Every frame is named, whether its neighbours agree with it by chance or not."""
    found = register([on_a_ball(clouds[k], 0.8, f"ball {k}") for k in range(3)])
    assert found.edges and all(edge.rotation_sigma_deg > 3 for edge in found.edges)
    assert {e.frame for e in found.exclusions} | {u.frame for u in found.uncertainties} == set(found.names)
    assert not {e.frame for e in found.exclusions} & {u.frame for u in found.uncertainties}


def test_a_single_registered_frame_is_an_error_that_names_the_others(clouds, whole):
    lost = NoCommonSurface("frame_00009"), NoCommonSurface("frame_00010")
    alone = replace(whole, registered=np.arange(FRAMES) == 0, exclusions=lost)
    with pytest.raises(UserError, match=r"1 of 18 frames could be registered(.|\n)*: frame_00009, frame_00010"):
        adjust_registered(clouds, alone)


def test_a_vase_is_put_together_by_its_blotches():
    """Its shape tells nothing of the turn about its axis; the faint blotches that sl-synth paints on it do."""
    some = rendered("vase", tuple(range(4, 12)), resolution=240, lit=True)
    bare = register([replace(c, light=None) for c in some.clouds], sequence=True)
    found = register(some.clouds, sequence=True)
    assert bare.registered.sum() < len(some.frames)
    assert found.registered.all() and not found.uncertainties
    rotation = pose_errors(some.T_world_camera, some.baseline, found.T_world_camera, found.baseline)[0]
    assert rotation.max() < 2
