"""Registration of all frames: what is registered and why the rest is not; projectors with two poses; adjustment."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.registration.solids import ball, block, meshed
from sl_nerfstudio.bundle_adjustment.registered_frames import (
    RegisteredFramesSettings,
    adjust_registered,
)
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import angle_deg
from sl_nerfstudio.processing.result import contradiction
from sl_nerfstudio.registration import register as module
from sl_nerfstudio.registration.pairs import LEAST_ODDS
from sl_nerfstudio.registration.register import choose_projectors, chosen_clouds, register
from sl_nerfstudio.registration.result import (
    NoCommonSurface,
    OpenPlace,
    PoorPair,
    Registration,
    SeparateComponent,
    SurfaceDisagrees,
)
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.candidates import plane_starts
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, ray_pairs
from sl_nerfstudio.synthesis.sdf import carve, union
from tests.bundle_adjustment.analytic import DISK_HEIGHT, PROJECTORS, camera_of, images_of, rig_of
from tests.registration.analytic_clouds import clouds_of, errors_against, on_a_ball, part_of, pose_errors, rolled
from tests.registration.shaped_clouds import RenderedClouds, rendered, write_bar
from tests.relative_pose.two_views import errors_deg, known_pose

SIZE, FRAMES = 100, 18  # 20 degrees from frame to frame
RIG = rig_of(FRAMES, SIZE)
SMALL, SMALL_RIG = 70, rig_of(FRAMES, 70)


@pytest.fixture(scope="module")
def clouds():
    return clouds_of(RIG, SIZE, noise=0.1)


@pytest.fixture(scope="module")
def few():
    """Five frames side by side."""
    return clouds_of(part_of(SMALL_RIG, [0, 1, 2, 3, 4]), SMALL, noise=0.05)


def assert_right(found: Registration, frames: list[int]) -> None:
    """All frames are registered where they belong."""
    assert found.registered.all() and not found.exclusions
    rotation, position, scale = errors_against(part_of(RIG, frames), found.T_world_camera, found.baseline)
    assert rotation.max() < 1 and position.max() < 0.02 and np.abs(scale).max() < 0.02


def assert_right_or_named(found: Registration, truth: RenderedClouds, rotation_deg: float, position: float) -> None:
    """Each frame is registered where it belongs, or named with a reason."""
    kept = found.registered
    names = np.array(found.names)
    assert kept.sum() >= 2 and sorted(e.frame for e in found.exclusions) == sorted(names[~kept])
    for why in found.exclusions:
        assert isinstance(why, SeparateComponent | PoorPair | NoCommonSurface | OpenPlace)
        if isinstance(why, SeparateComponent):
            assert why.frame in why.component and why.partner in (None, *names[kept])
    values = (truth.T_world_camera, truth.baseline, found.T_world_camera, found.baseline)
    turn, shift, _ = pose_errors(*(x[kept] for x in values))
    assert turn.max() < rotation_deg and shift.max() < position


# Whole scans.


@pytest.fixture(scope="module")
def whole(clouds):
    return register(clouds, sequence=True)


@pytest.mark.slow
def test_a_sequence_is_registered_all_around_and_its_loop_is_closed(whole):
    assert_right(whole, list(range(FRAMES)))
    assert whole.ordered and not whole.uncertainties
    pairs = {edge.frames for edge in whole.edges if edge.used}
    assert ("frame_00000", "frame_00017") in pairs or ("frame_00001", "frame_00017") in pairs
    assert np.exp(np.log(whole.baseline).mean()) == pytest.approx(1)
    np.testing.assert_allclose(whole.T_world_camera[0], np.eye(4), atol=1e-9)


def test_an_unordered_set_is_registered(clouds):
    order = [3, 0, 4, 1, 2]
    assert_right(register([clouds[k] for k in order], sequence=False), order)


@pytest.mark.slow
def test_a_shuffled_sequence_is_recognised_and_registered_all_the_same():
    """The frames are said to follow each other; each is 120 degrees from the next, and from the one after that."""
    some = rendered("head", (0, 8, 16, 2, 10, 18, 4, 12, 20, 6, 14, 22))
    found = register(some.clouds, sequence=True)
    assert not found.ordered and found.registered.sum() >= 10
    assert_right_or_named(found, some, 1.5, 0.03)


@pytest.mark.parametrize(
    ("scene", "frames"),
    [("leaf", (0, 2, 4, 6, 8, 10)), ("head", (4, 5, 6, 16, 17))],
    ids=["leaf", "two sides of a head"],
)
@pytest.mark.slow
def test_frames_that_share_little_are_right_or_named(scene, frames):
    """A sheet that some frames see nearly from its edge, and two sides of an object without what is between."""
    some = rendered(scene, frames)
    assert_right_or_named(register(some.clouds), some, 3.0, 0.06)


@pytest.mark.slow
def test_a_vase_is_put_together_by_its_blotches():
    """Its shape tells nothing of the turn about its axis; the faint blotches that sl-synth paints on it do."""
    some = rendered("vase", tuple(range(4, 12)), resolution=240, lit=True)
    bare = register([replace(c, light=None) for c in some.clouds], sequence=True)
    found = register(some.clouds, sequence=True)
    assert (~bare.registered).sum() + len(bare.uncertainties) > len(some.frames) / 2  # left out, or said to slip
    assert found.registered.all() and not found.uncertainties
    assert_right_or_named(found, some, 2.0, np.inf)


# Rough camera poses.


@pytest.mark.parametrize("past", [False, True], ids=["rolled and moved", "looking past the object"])
def test_rough_camera_poses_are_a_start(clouds, past):
    """Turned to the left and to the right by 8 degrees, nothing overlaps as given."""
    start = RIG.T_world_camera[:4].numpy().copy()
    if past:
        for k, deg in enumerate((8, -8, 8, -8)):
            start[k, :3, :3] = start[k, :3, :3] @ Rotation.from_euler("y", deg, degrees=True).as_matrix()
    else:
        start[1, :3] = rolled(8) @ start[1, :3]
        start[2, :3, 3] *= 1.05
    assert_right(register(clouds[:4], start=start), [0, 1, 2, 3])


# Frames that are left out, or uncertain.


@pytest.mark.slow
def test_frames_of_a_separate_group_name_it_and_where_to_capture(few):
    """The last two show another object, a head, and match each other alone."""
    true = rendered("head", (4, 5))
    found = register([*few[:3], *true.clouds])
    assert found.registered.tolist() == [True, True, True, False, False]
    assert found.component.tolist() == [0, 0, 0, 1, 1]
    group = tuple(c.name for c in true.clouds)
    for why, name in zip(found.exclusions, group, strict=True):
        assert isinstance(why, SeparateComponent | OpenPlace)
        together = why.component if isinstance(why, SeparateComponent) else why.group
        assert (why.frame, together) == (name, group) and why.partner in (None, *found.names[:3])
    assert np.isnan(found.fitness[3:]).all() and (found.fitness[:3] > 0.9).all()
    (separate,) = found.separate  # in axes of their own
    assert separate.frames == group
    np.testing.assert_allclose(separate.T_world_camera[0], np.eye(4), atol=1e-9)
    T, baseline = true.T_world_camera, true.baseline
    unit = np.sqrt(baseline.prod())  # the geometric mean of the baselines is one
    relative = np.linalg.inv(T[0]) @ T[1]
    turn = relative[:3, :3].T @ separate.T_world_camera[1, :3, :3]
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 1
    np.testing.assert_allclose(separate.baseline, baseline / unit, rtol=0.02)
    off = np.linalg.norm(separate.T_world_camera[1, :3, 3] - relative[:3, 3] / unit)
    assert off < 0.03 * np.linalg.norm(T[0, :3, 3]) / unit


@pytest.mark.slow
def test_a_frame_of_another_object_is_named_and_left_out(clouds):
    frames = [*clouds[:5], on_a_ball(clouds[5], 0.7, "stranger")]
    found = register(frames)
    assert found.registered.tolist() == [True] * 5 + [False]
    (why,) = found.exclusions
    assert isinstance(why, PoorPair | SeparateComponent) and why.frame == "stranger"
    assert why.partner in found.names[:5]
    if isinstance(why, PoorPair):
        assert why.log_odds < why.least_odds == LEAST_ODDS
    else:
        assert why.component == ("stranger",)
    assert np.isnan(found.T_world_camera[5]).all()
    adjusted = adjust_registered(frames, found, small(60, 3))
    assert np.isfinite(adjusted.poses.T_world_projector).all((1, 2)).tolist() == [True] * 5 + [False]
    assert adjusted.sigma[5] is None


def test_where_nothing_is_joined_because_everything_slips_every_frame_says_so():
    """Two frames of a vase: to capture more of the same would not help."""
    found = register(rendered("vase", (4, 5)).clouds)
    excluded = {e.frame for e in found.exclusions if isinstance(e, SeparateComponent) and e.slips}
    assert excluded | {u.frame for u in found.uncertainties if u.sigma_deg > 60} == set(found.names)


@pytest.mark.slow
def test_the_rotation_of_a_ball_is_uncertain(clouds):
    """Every frame is named, whether its neighbours agree with it by chance or not."""
    found = register([on_a_ball(clouds[k], 0.8, f"ball {k}") for k in range(3)])
    assert found.edges and all(edge.rotation_sigma_deg > 3 for edge in found.edges)
    named = [e.frame for e in found.exclusions] + [u.frame for u in found.uncertainties]
    assert sorted(named) == sorted(found.names)


def test_a_frame_without_surface_shares_none(few):
    sparse = {k: getattr(few[2], k)[::50] for k in ("uv_camera", "points", "sigma_noise", "pose_errors")}
    found = register([*few[:2], replace(few[2], **sparse)])
    assert found.exclusions == (NoCommonSurface("frame_00002"),)
    assert found.registered.tolist() == [True, True, False]


def test_a_frame_whose_surface_disagrees_says_how_much_agrees(few, monkeypatch):
    monkeypatch.setattr(module, "LEAST_ODDS", np.inf)
    found = register(few[:3])
    assert not found.registered.any()
    assert [(type(e), e.frame) for e in found.exclusions] == [(SurfaceDisagrees, name) for name in found.names]
    assert all(0.9 < e.fitness <= 1 for e in found.exclusions)
    assert np.isnan(found.T_world_camera).all() and np.isnan(found.baseline).all()


def test_what_is_being_done_is_reported(few):
    stages: list[str] = []
    register(few[:2], progress=stages.append)
    register(few[:2], sequence=False, progress=stages.append)
    first, closing = "registering pairs", ["closing loops"] * 2
    assert stages == [first, *closing, first, "comparing all frames", *closing]


# Frames of which two poses of the projector explain the coordinates: decided by their neighbours, or named.


IMAGES = [image.numpy() for image in images_of(part_of(RIG, [0, 1, 2, 3, 4]), SIZE)]
DEVICES = camera_of(SIZE), PROJECTORS["pinhole"]
OPEN = 2
CLOUDS = clouds_of(part_of(RIG, [0, 1, 2, 3, 4]), SIZE)


def coords_of_disk(k: int) -> np.ndarray:
    """Coordinates of a frame on its supporting disk; NaN elsewhere."""
    cloud = CLOUDS[k]
    length = float(RIG.T_camera_projector[k, :3, 3].norm())
    T = RIG.T_world_camera[k].numpy()
    z = length * cloud.points @ T[2, :3] + T[2, 3]
    coords = cloud.coords.copy()
    column, row = np.floor(cloud.uv_camera).astype(int).T
    off = np.abs(z - DISK_HEIGHT) > 1e-3
    coords[row[off], column[off]] = np.nan
    return coords


@cache
def twin_of(k: int) -> np.ndarray:
    """The other pose of the projector that explains the disk."""
    true = RIG.T_camera_projector[k].numpy()
    rays, _ = ray_pairs(*correspondences_of(coords_of_disk(k)), *DEVICES)
    poses = []
    for R, t in plane_starts(rays):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, t
        depth = np.cross(t, rays.d_projector @ R.T) * np.cross(rays.d_camera, rays.d_projector @ R.T)
        if depth.sum(1).mean() > 0:
            poses.append(T)
    return max(poses, key=lambda T: max(errors_deg(T, true)))


def two_poses(k: int, coords: np.ndarray, true_first: bool) -> FrameCloud:
    """A frame that carries the true pose of its projector and the twin."""
    uv = correspondences_of(coords)
    true, twin = (known_pose(T, *uv, *DEVICES)
                  for T in (RIG.T_camera_projector[k].numpy(), twin_of(k)))  # fmt: skip
    first, second = (true, twin) if true_first else (twin, true)
    return frame_cloud(f"frame_{k:05d}", coords, *DEVICES, replace(first, alternatives=(second,)))


@pytest.mark.parametrize("true_first", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_true_pose_is_chosen_by_what_the_neighbours_saw(true_first):
    frame = two_poses(OPEN, IMAGES[OPEN], true_first)
    assert len(frame.alternatives) == 1
    all_frames = [*CLOUDS[:OPEN], frame, *CLOUDS[OPEN + 1 :]]
    found = choose_projectors(all_frames)
    assert found.undecided == ()
    clouds = chosen_clouds(all_frames, found.chosen)
    chosen = clouds[OPEN]
    assert chosen.alternatives == ()
    assert max(errors_deg(chosen.pose.T_camera_projector, RIG.T_camera_projector[OPEN].numpy())) < 1e-6
    for k in (0, 1, 3, 4):
        assert clouds[k].points is CLOUDS[k].points


@pytest.mark.slow
def test_where_only_a_flat_disk_is_seen_a_frame_is_right_or_named():
    """Its rim may still tell; the face of the disk does not."""
    flat = [two_poses(k, coords_of_disk(k), False) for k in range(4)]
    found = choose_projectors(flat)
    named = {u.frame for u in found.undecided}
    for k, cloud in enumerate(chosen_clouds(flat, found.chosen)):
        error = max(errors_deg(cloud.pose.T_camera_projector, RIG.T_camera_projector[k].numpy()))
        assert cloud.name in named or error < 1e-6
    for doubt in found.undecided:
        k = [c.name for c in flat].index(doubt.frame)
        R = [T[:3, :3] for T in (RIG.T_camera_projector[k].numpy(), twin_of(k))]
        expected = np.degrees(Rotation.from_matrix(R[0] @ R[1].T).magnitude())
        assert doubt.angle_deg == pytest.approx(expected, abs=0.1)


# After the joint adjustment.


def small(anchors: int, iterations: int) -> RegisteredFramesSettings:
    """Settings without the question whether there are other minima."""
    adjustment = AdjustmentSettings(anchors_per_frame=anchors, max_iterations=iterations, other_minima=False)
    return RegisteredFramesSettings(adjustment=adjustment)


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_wrong_camera_is_reported(clouds, whole):
    long = [replace(c, camera=replace(c.camera, fl_x=1.03 * c.camera.fl_x, fl_y=1.03 * c.camera.fl_y)) for c in clouds]
    found = adjust_registered(long, whole, small(120, 16)).intrinsics
    assert found is not None and found.contradicts()
    text = contradiction(found, [cloud.camera for cloud in long], long[0].projector)
    assert text.startswith("The intrinsics contradict the captures (chi square ")
    assert "camera: focal length -" in text
    assert contradiction(None, [], long[0].projector) == ""


def test_a_single_registered_frame_is_an_error_that_names_the_others(few):
    found = register(few[:3])
    lost = NoCommonSurface("frame_00001"), NoCommonSurface("frame_00002")
    alone = replace(found, registered=np.arange(3) == 0, exclusions=lost)
    with pytest.raises(UserError, match=r"1 of 3 frames could be registered(.|\n)*: frame_00001, frame_00002"):
        adjust_registered(few[:3], alone)


# Objects that look the same, or nearly, from several sides.


def turned_from_truth(found: Registration, true: RenderedClouds) -> list[float]:
    """Angles between the rotations of registered frames, against the first, and the true ones, in degrees."""
    inside = np.flatnonzero(found.registered)
    first, R, T = inside[0], found.T_world_camera[:, :3, :3], true.T_world_camera[:, :3, :3]
    return [angle_deg(R[first].T @ R[k] @ (T[first].T @ T[k]).T) for k in inside]


@pytest.fixture(scope="module")
def nut_walk(tmp_path_factory: pytest.TempPathFactory) -> RenderedClouds:
    path: Path = tmp_path_factory.mktemp("meshes") / "nut.ply"
    trimesh.creation.cylinder(30, 25, sections=6).export(path)
    return rendered(str(path), tuple(range(8)), 30, 90)  # steps of 9 to 17 degrees; a nut looks the same after 60


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_nut_is_registered_at_the_sides_that_it_shows_or_said_to_be_symmetric(
    nut_walk: RenderedClouds, seed: int
) -> None:
    found = register(nut_walk.clouds, seed=seed)
    assert found.registered.sum() > 4
    assert max(turned_from_truth(found, nut_walk)) < 3
    assert any(turn == pytest.approx(60, abs=1) for turn in found.turns_deg) or not found.by_order


@pytest.mark.slow
def test_a_bar_is_registered_all_around(tmp_path: Path) -> None:
    """Two bosses, one on each end, of unequal height: it is nearly the same after half a turn.

    In steps of 45 degrees errors of scale add up around it: rigid parts would not meet.
    """
    write_bar(tmp_path / "bar.ply")
    true = rendered(str(tmp_path / "bar.ply"), tuple(range(8)), 8, 90)
    found = register(true.clouds)
    assert found.registered.all() and not found.turns_deg
    assert max(turned_from_truth(found, true)) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["frog", "medal", "vase"])
def test_a_frog_a_medal_that_slides_and_a_vase_that_is_round_have_no_sides(scene: str) -> None:
    assert register(rendered(scene, tuple(range(8)), 24, 90).clouds).turns_deg == ()


def test_solids_are_what_they_say():
    solid = carve(0.0, union(0.0, block((0, 0, 0), (40, 30, 20), 0.01), ball((0, 0, 12), 9)), ball((20, 0, 0), 6))
    mesh = meshed(solid, (26, 22, 26), 0.5)
    assert mesh.is_watertight
    # a cap of 11 mm on a sphere of 9, less half a ball
    cap = np.pi * 11**2 * (3 * 9 - 11) / 3
    assert mesh.volume == pytest.approx(40 * 30 * 20 + cap - 2 / 3 * np.pi * 6**3, rel=0.01)
    with pytest.raises(ValueError, match="does not fit into its box"):
        meshed(solid, (18, 22, 26))


def test_uncertainties_follow_their_limits(few, monkeypatch):
    assert register(few[:3]).uncertainties == ()
    monkeypatch.setattr(module, "LARGEST_SIGMA_ROTATION_DEG", 0.0)
    monkeypatch.setattr(module, "is_ambiguous", lambda _: True)
    found = register(few[:3])
    assert all(edge.undecided for edge in found.edges)
    assert [u.frame for u in found.uncertainties] == list(found.names)
    for said in found.uncertainties:  # several pairs know more than the best of them, and less than as many like it
        alone = [e.rotation_sigma_deg for e in found.edges if said.frame in e.frames]
        assert min(alone) / np.sqrt(len(alone)) < said.sigma_deg < min(alone)
