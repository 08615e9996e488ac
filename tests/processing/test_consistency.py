"""Frames whose coordinates contradict the others after the joint adjustment: taken out, or moved to where they fit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sl_nerfstudio.bundle_adjustment import adjust as adjustment
from sl_nerfstudio.bundle_adjustment import modes
from sl_nerfstudio.bundle_adjustment.registered_frames import (
    RegisteredFramesSettings,
    adjust_registered,
    find_registered_minimum,
)
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.geometry.devices import Intrinsics, project
from sl_nerfstudio.processing import consistency
from sl_nerfstudio.processing.consistency import adjust_consistent, without_groups
from sl_nerfstudio.registration.assembly import Assembly
from sl_nerfstudio.registration.register import include_left_out
from sl_nerfstudio.registration.result import (
    CoordinatesDisagree,
    Edge,
    NoCommonSurface,
    Registration,
    UncertainRotation,
    UndecidedProjector,
)
from sl_nerfstudio.registration.surfaces import frame_cloud
from sl_nerfstudio.registration.view_graph import ViewGraph
from sl_nerfstudio.relative_pose.epipolar import correspondences_of
from tests.bundle_adjustment import analytic
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, errors_against, on_a_ball, part_of
from tests.relative_pose.two_views import known_pose

SIZE, FRAMES, MOVED = 100, 7, 3
RIG = part_of(rig_of(18, SIZE), list(range(FRAMES)))
NAMES = tuple(f"frame_{k:05d}" for k in range(FRAMES))
BRIEF = AdjustmentSettings(anchors_per_frame=120, max_iterations=12, further_searches=False)
QUICK = RegisteredFramesSettings(adjustment=BRIEF)
CONTRADICTION = f"the coordinates of {NAMES[MOVED]} contradict those of the other frames; adjusting again without them"


def placed(*frames):
    return f"placed against the adjusted frames: {', '.join(NAMES[k] for k in frames)}; adjusting again with them"


@pytest.fixture(autouse=True)
def adjusted(monkeypatch) -> list[list[int]]:
    """Adjustments are quick; the frames of each are listed."""
    groups: list[list[int]] = []

    def quick(clouds, registration, settings):
        groups.append(np.flatnonzero(registration.registered).tolist())
        return find_registered_minimum(clouds, registration, settings or QUICK)

    monkeypatch.setattr(consistency, "find_registered_minimum", quick)
    return groups


@pytest.fixture(scope="module")
def clouds():
    return clouds_of(RIG, SIZE, noise=0.1)


def registration_of(T: np.ndarray) -> Registration:
    """All frames registered at the given poses."""
    n = len(T)
    baseline = RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy()
    return Registration(NAMES, T, baseline, np.full(n, True), np.zeros(n, dtype=np.int64), np.full(n, 0.95), (), (), ())


def moved_by(degrees: float, frame: int = MOVED) -> np.ndarray:
    """True camera poses, one of them turned about the object together with its projector."""
    T = RIG.T_world_camera.numpy().copy()
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.8, 0.6, 0.0])).as_matrix()
    T[frame] = turn @ T[frame]
    return T


def test_nothing_is_taken_out_of_a_right_scan(clouds):
    log = []
    start = registration_of(RIG.T_world_camera.numpy())
    found = adjust_consistent(clouds, start, log.append)
    assert found.registration is start and log == []
    assert len(found.cross.frames) == FRAMES and found.cross.share > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [5.0, 20.0, 60.0])
def test_a_frame_that_was_put_elsewhere_is_put_right_or_named_and_the_others_stay(clouds, degrees):
    """The adjustment finds its way back from a few degrees; farther off, a frame is taken out and placed anew."""
    log = []
    found = adjust_consistent(clouds, registration_of(moved_by(degrees)), log.append)
    kept = np.flatnonzero(found.registration.registered).tolist()
    assert set(range(FRAMES)) - set(kept) <= {MOVED}
    assert [e.frame for e in found.registration.exclusions] == [NAMES[k] for k in range(FRAMES) if k not in kept]
    poses = found.adjusted.poses
    rotation, position, _ = errors_against(part_of(RIG, kept), poses.T_world_camera[kept], poses.baseline[kept])
    assert rotation.max() < 0.5 and position.max() < 0.01
    assert found.cross.share > 0.95 and len(found.cross.frames) == len(kept)
    assert set(log) <= (set() if degrees < 10 else {CONTRADICTION, placed(MOVED)})


@pytest.mark.slow
def test_frames_come_in_one_after_the_other(clouds, monkeypatch):
    """Each that comes in may be what the next one needs: trying ends when nothing is left out."""
    true, calls = registration_of(RIG.T_world_camera.numpy()), []

    def one_at_a_time(clouds, registration, poses, candidates):
        calls.append(list(candidates))
        return without_groups(true, [[k] for k in candidates[1:]])

    monkeypatch.setattr(consistency, "include_left_out", one_at_a_time)
    log = []
    found = adjust_consistent(clouds, without_groups(true, [[1], [MOVED]]), log.append)
    assert calls == [[1, MOVED], [MOVED]] and found.registration.registered.all()
    assert found.registration.exclusions == () and np.isfinite(found.adjusted.poses.baseline).all()
    assert log == [placed(1), placed(MOVED)]


@pytest.mark.slow
@pytest.mark.parametrize("doubt", [{"by_order": (NAMES[1],)}, {"turns_deg": (90.0,)}, {}])
def test_frames_that_fit_at_several_places_do_not_come_in(clouds, monkeypatch, doubt):
    """Every frame of a symmetric object does; of others, those with two projectors."""
    why = UndecidedProjector(NAMES[MOVED], 20.0)
    without = without_groups(registration_of(RIG.T_world_camera.numpy()), [[1], [MOVED]])
    torn = replace(without, exclusions=(without.exclusions[0], why), **doubt)
    asked = []

    def none_placed(clouds, registration, poses, candidates):
        asked.append(list(candidates))
        return registration

    monkeypatch.setattr(consistency, "include_left_out", none_placed)
    found = adjust_consistent(clouds, torn, lambda _: None)
    assert asked == ([] if doubt else [[1]])
    assert registration_gaps(found.registration) == [1, MOVED] and found.registration.exclusions == torn.exclusions


@pytest.mark.slow
def test_a_frame_of_another_object_is_taken_out_by_name(clouds):
    """It cannot be placed anew, either."""
    log = []
    found = adjust_consistent(with_stranger(clouds), registration_of(RIG.T_world_camera.numpy()), log.append)
    assert found.registration.exclusions == (CoordinatesDisagree(NAMES[MOVED], (NAMES[MOVED],)),)
    assert found.registration.registered.tolist() == [k != MOVED for k in range(FRAMES)]
    assert found.registration.component.tolist() == [-1 if k == MOVED else 0 for k in range(FRAMES)]
    assert log[0] == CONTRADICTION
    assert np.isnan(found.adjusted.poses.T_world_camera[MOVED]).all()


@pytest.mark.slow
def test_a_frame_that_contradicts_again_where_it_was_placed_is_not_placed_a_third_time(clouds, monkeypatch, adjusted):
    """Here every frame that is asked for is placed, a stranger, too; another frame comes in beside it."""
    true, asked = registration_of(RIG.T_world_camera.numpy()), []
    everything, rest = list(range(FRAMES)), [k for k in range(FRAMES) if k not in (1, MOVED)]

    def all_of_them(clouds, registration, poses, candidates):
        asked.append(list(candidates))
        return without_groups(true, [[k] for k in registration_gaps(registration) if k not in candidates])

    monkeypatch.setattr(consistency, "include_left_out", all_of_them)
    log = []
    found = adjust_consistent(with_stranger(clouds), without_groups(true, [[1]]), log.append, QUICK)
    assert asked == [[1, MOVED]]
    assert adjusted == [[0, *everything[2:]], rest, everything, sorted([1, *rest])]
    assert np.flatnonzero(~found.registration.registered).tolist() == [MOVED]
    assert found.registration.exclusions == (CoordinatesDisagree(NAMES[MOVED], (NAMES[MOVED],)),)
    assert log == [CONTRADICTION, placed(1, MOVED)]


@pytest.mark.slow
def test_frames_that_are_connected_with_each_other_are_placed_together(clouds, monkeypatch):
    """Each by itself is not certain enough here; the axes of a group, and its unit, are its own."""
    true = registration_of(RIG.T_world_camera.numpy())
    start = without_groups(true, [[1, MOVED]])
    poses = find_registered_minimum(clouds, start, QUICK).frames.poses
    (block,) = start.separate
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix(), [5.0, 1.0, -2.0]
    T = turn @ block.T_world_camera
    T[:, :3, 3] *= 2.5
    start = replace(start, separate=(replace(block, T_world_camera=T, baseline=2.5 * block.baseline),))
    decide = Assembly.decide
    monkeypatch.setattr(Assembly, "decide", lambda self, a, b: decide(self, a, b) if len(b) > 1 else None)
    found = include_left_out(clouds, start, poses, [1, MOVED])
    assert found.registered.all() and found.exclusions == ()
    np.testing.assert_allclose(found.T_world_camera[[1, MOVED]], true.T_world_camera[[1, MOVED]], atol=0.03)
    np.testing.assert_allclose(found.baseline, true.baseline, rtol=0.01)


@pytest.mark.slow
def test_a_frame_that_slides_along_a_side_in_all_of_its_pairs_does_not_come_in(clouds, monkeypatch):
    """A link of a robot's arm that was seen along its axis came in 13 degrees off, under a sigma of 0.1."""
    start = without_groups(registration_of(RIG.T_world_camera.numpy()), [[MOVED]])
    poses = find_registered_minimum(clouds, start, QUICK).frames.poses
    edges = ViewGraph.edges
    for slip_deg in (0.0, 5.0):
        with monkeypatch.context() as patch:
            sliding = property(lambda graph, deg=slip_deg: [replace(e, slip_deg=deg) for e in edges.__get__(graph)])
            patch.setattr(ViewGraph, "edges", sliding)
            found = include_left_out(clouds, start, poses, [MOVED])
        assert registration_gaps(found) == ([MOVED] if slip_deg else [])


@pytest.mark.slow
def test_pairs_of_a_frame_that_was_placed_are_used_if_they_say_the_same(clouds):
    """Before, they were not: their frames stood in different components."""
    true = registration_of(RIG.T_world_camera.numpy())
    R = true.T_world_camera[:, :3, :3]
    turn = Rotation.from_rotvec([0.0, 0.4, 0.0]).as_matrix()
    edges = tuple(
        Edge((NAMES[i], NAMES[j]), wrong @ R[j].T @ R[i], 0.5, 0.9, used, False, 1.0)
        for i, j, wrong, used in ((0, MOVED, np.eye(3), False), (MOVED, 4, turn, False), (0, 4, turn, False),
                                  (0, 2, np.eye(3), True), (1, MOVED, np.eye(3), True))
    )  # fmt: skip
    start = replace(without_groups(true, [[1], [MOVED]]), edges=edges)
    poses = find_registered_minimum(clouds, start, QUICK).frames.poses
    found = include_left_out(clouds, start, poses, [MOVED])
    assert registration_gaps(found) == [1]
    assert [edge.used for edge in found.edges] == [True, False, False, True, False]


@pytest.mark.slow
def test_other_minima_are_searched_for_once_and_the_last_group_states_what_they_show(monkeypatch):
    """On a plane along which frames slide; a stranger among them makes two adjustments of it."""
    monkeypatch.setattr(analytic, "BALLS", ())
    clouds, starts = with_stranger(clouds_of(RIG, SIZE, noise=0.05)), []
    search = adjustment.search
    for module in (adjustment, modes):
        monkeypatch.setattr(module, "search", lambda problem, *rest: starts.append(problem) or search(problem, *rest))
    monkeypatch.setattr(consistency, "include_left_out", lambda clouds, registration, *_: registration)
    found = adjust_consistent(clouds, registration_of(RIG.T_world_camera.numpy()), lambda _: None, QUICK)
    kept = [k for k in range(FRAMES) if k != MOVED]
    assert np.flatnonzero(found.registration.registered).tolist() == kept
    assert [p.start.frames for p in starts] == [FRAMES, *[FRAMES - 1] * (1 + modes._DRAWN)]
    wanted = adjust_registered(clouds, found.registration, QUICK)
    alone = find_registered_minimum(clouds, found.registration, QUICK).frames
    np.testing.assert_array_equal(found.adjusted.poses.T_world_camera, wanted.poses.T_world_camera)
    assert found.adjusted.sigma == wanted.sigma
    assert max(found.adjusted.sigma[k].camera_translation / alone.sigma[k].camera_translation for k in kept) > 1.02


def registration_gaps(registration: Registration) -> list[int]:
    """Numbers of the frames that are not registered."""
    return np.flatnonzero(~registration.registered).tolist()


def with_stranger(clouds):
    """The frames, one of them of another object."""
    return [*clouds[:MOVED], stranger_of(clouds[MOVED]), *clouds[MOVED + 1 :]]


def stranger_of(cloud):
    """The frame as if a ball had stood there: another object, lit by the same projector."""
    T = cloud.pose.T_camera_projector
    other = on_a_ball(cloud, 0.8, cloud.name)
    coords = np.full_like(cloud.coords, np.nan)
    p = (other.points - T[:3, 3]) @ T[:3, :3]
    uv, lit = project(Intrinsics.of(cloud.projector, torch.float64), torch.from_numpy(p))
    column, row = np.floor(other.uv_camera).astype(int).T
    coords[row[lit], column[lit]] = uv.numpy()[lit]
    pose = known_pose(T, *correspondences_of(coords), cloud.camera, cloud.projector)
    return frame_cloud(cloud.name, coords, cloud.camera, cloud.projector, pose)


def test_groups_become_components_of_their_own_and_what_was_said_of_them_goes():
    start = replace(
        registration_of(RIG.T_world_camera.numpy()),
        uncertainties=(UncertainRotation(NAMES[1], 4.0), UncertainRotation(NAMES[5], 4.0)),
        exclusions=(NoCommonSurface("other"),),
    )
    found = without_groups(start, [[1, 2], [4]])
    assert found.registered.tolist() == [True, False, False, True, False, True, True]
    assert found.component.tolist() == [0, 1, 1, 0, -1, 0, 0]
    assert found.uncertainties == (start.uncertainties[1],)
    group = (NAMES[1], NAMES[2])
    assert found.exclusions == (
        NoCommonSurface("other"),
        CoordinatesDisagree(NAMES[1], group),
        CoordinatesDisagree(NAMES[2], group),
        CoordinatesDisagree(NAMES[4], (NAMES[4],)),
    )
    (separate,) = found.separate  # a single frame has no poses to tell
    assert separate.frames == group
    np.testing.assert_array_equal(separate.T_world_camera, RIG.T_world_camera[1:3])
    np.testing.assert_array_equal(separate.baseline, start.baseline[1:3])
    for k in (1, 2, 4):
        assert np.isnan(found.T_world_camera[k]).all() and np.isnan(found.baseline[k]) and np.isnan(found.fitness[k])
    assert start.registered.all() and np.isfinite(start.T_world_camera).all()
