"""A frame on the wrong side of an object that nearly looks the same from two is found after the joint adjustment."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.geometry.lie import angle_deg
from sl_nerfstudio.processing import consistency
from sl_nerfstudio.processing.consistency import _doubtful, adjust_consistent
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.review.agreement import CrossFrameAgreement, FrameCrossAgreement
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of
from tests.registration.shaped_clouds import rendered, write_bar

pytestmark = pytest.mark.slow

FRAMES, TURNED = 10, 4


def test_a_frame_on_the_wrong_side_is_moved_to_where_it_agrees(tmp_path: Path) -> None:
    """Two bosses on a bar differ by 10 of 90 mm.

    A frame that is turned by half a turn agrees to 97 % with the others, as frames of real scans do; where it belongs,
    to 100 %.
    """
    write_bar(tmp_path / "bar.ply")
    made = rendered(str(tmp_path / "bar.ply"), tuple(range(FRAMES)), FRAMES, 130)
    T = made.T_world_camera.copy()
    T[TURNED] = np.diag([-1.0, -1.0, 1.0, 1.0]) @ T[TURNED]
    names = tuple(cloud.name for cloud in made.clouds)
    every, alone = np.full(FRAMES, True), np.zeros(FRAMES, dtype=np.int64)
    start = Registration(names, T, made.baseline.copy(), every, alone, np.full(FRAMES, 0.95), (), (), ())
    log: list[str] = []
    found = adjust_consistent(made.clouds, start, log.append)
    assert log == [f"tried at other places, where they may agree better: {names[TURNED]}"]
    assert found.registration.registered.all()
    poses = found.adjusted.poses.T_world_camera
    turns = [a[:3, :3] @ b[:3, :3].T for a, b in zip(made.T_world_camera, poses, strict=True)]
    assert max(angle_deg(turn @ turns[0].T) for turn in turns) < 0.3
    assert min(frame.share for frame in found.cross.frames) > 0.99


def frame(share: float, excess: float) -> FrameCrossAgreement:
    return FrameCrossAgreement(100, 1.0, share, 0.1, 0.3, excess)


def test_doubtful_are_few_frames_that_agree_less_well_than_most() -> None:
    def doubtful(*frames: FrameCrossAgreement) -> list[int]:
        return _doubtful(CrossFrameAgreement(0.1, 0.97, 0.1, 0.3, frames, ()))

    usual = [frame(0.97, 1.1)] * 8
    assert doubtful(*usual) == []
    assert doubtful(*usual, frame(0.94, 1.1), frame(0.97, 1.5)) == [8, 9]
    unknown = frame(float("nan"), float("nan"))
    assert doubtful(unknown, *usual, frame(0.94, 1.1)) == [9]
    assert doubtful(unknown, unknown) == []
    worse = [frame(0.97 - 0.03 - 0.01 * k, 1.1) for k in range(10)]
    assert doubtful(*[frame(0.97, 1.1)] * 30, *worse) == list(range(34, 40))  # the worst six
    assert doubtful(frame(0.97, 1.0), frame(0.97, 1.0), frame(0.5, 2.0), frame(0.9, 1.0)) == [2]  # a third at most


def test_of_what_looks_the_same_from_several_sides_no_frame_is_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    """The order of capture, not its surface, says where a frame of a nut is."""
    rig = rig_of(9, 80)
    clouds = clouds_of(rig, 80, noise=0.1)
    T, baseline = rig.T_world_camera.numpy(), rig.T_camera_projector[:, :3, 3].norm(dim=-1).numpy()
    names, n = tuple(cloud.name for cloud in clouds), len(clouds)
    start = Registration(
        names, T, baseline, np.full(n, True), np.zeros(n, dtype=np.int64), np.full(n, 0.95), (), (), ()
    )
    asked: list[bool] = []
    monkeypatch.setattr(consistency, "_moved_elsewhere", lambda *_: asked.append(True))
    adjust_consistent(clouds, replace(start, turns_deg=(60.0,)), lambda _: None)
    assert not asked
    adjust_consistent(clouds, start, lambda _: None)
    assert asked
