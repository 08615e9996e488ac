"""Frames whose coordinates contradict the others after the joint adjustment: taken out, by name."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl_nerfstudio.bundle_adjustment.registered_frames import RegisteredFramesSettings, adjust_registered
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.processing import consistency
from sl_nerfstudio.processing.consistency import adjust_consistent, without_groups
from sl_nerfstudio.registration.result import CoordinatesDisagree, NoCommonSurface, Registration, UncertainRotation
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, errors_against, part_of

SIZE, FRAMES, MOVED = 100, 7, 3
RIG = part_of(rig_of(18, SIZE), list(range(FRAMES)))
NAMES = tuple(f"frame_{k:05d}" for k in range(FRAMES))


@pytest.fixture(autouse=True)
def quick_adjustment(monkeypatch):
    quick = RegisteredFramesSettings(adjustment=AdjustmentSettings(anchors_per_frame=120, max_iterations=12))
    monkeypatch.setattr(consistency, "adjust_registered", lambda c, r: adjust_registered(c, r, quick))


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
    turn[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    T[frame] = turn @ T[frame]
    return T


def test_nothing_is_taken_out_of_a_right_scan(clouds):
    log = []
    start = registration_of(RIG.T_world_camera.numpy())
    found = adjust_consistent(clouds, start, log.append)
    assert found.registration is start and log == []
    assert len(found.cross.frames) == FRAMES and found.cross.share > 0.95


@pytest.mark.parametrize("degrees", [20.0, 60.0])
def test_a_frame_far_from_its_place_is_taken_out_by_name_and_the_others_stay(clouds, degrees):
    log = []
    found = adjust_consistent(clouds, registration_of(moved_by(degrees)), log.append)
    assert found.registration.exclusions == (CoordinatesDisagree(NAMES[MOVED], (NAMES[MOVED],)),)
    others = [k for k in range(FRAMES) if k != MOVED]
    assert found.registration.registered.tolist() == [k != MOVED for k in range(FRAMES)]
    assert found.registration.component.tolist() == [-1 if k == MOVED else 0 for k in range(FRAMES)]
    assert len(log) == 1 and f"the coordinates of {NAMES[MOVED]} contradict those of the other frames" in log[0]
    assert np.isnan(found.adjusted.poses.T_world_camera[MOVED]).all()
    poses = found.adjusted.poses
    rotation, position, _ = errors_against(part_of(RIG, others), poses.T_world_camera[others], poses.baseline[others])
    assert rotation.max() < 0.3 and position.max() < 0.01
    assert found.cross.share > 0.95 and len(found.cross.frames) == FRAMES - 1


def test_a_frame_a_little_off_is_put_right_or_taken_out(clouds):
    found = adjust_consistent(clouds, registration_of(moved_by(5.0)), lambda _: None)
    kept = np.flatnonzero(found.registration.registered).tolist()
    assert set(range(FRAMES)) - set(kept) <= {MOVED}
    poses = found.adjusted.poses
    rotation, _, _ = errors_against(part_of(RIG, kept), poses.T_world_camera[kept], poses.baseline[kept])
    assert rotation.max() < 0.5


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
    for k in (1, 2, 4):
        assert np.isnan(found.T_world_camera[k]).all() and np.isnan(found.baseline[k]) and np.isnan(found.fitness[k])
    assert start.registered.all() and np.isfinite(start.T_world_camera).all()
