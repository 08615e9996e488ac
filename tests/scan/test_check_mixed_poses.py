"""Poses of other frames, of another world or of another calibration are found by what the scan states of its poses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sphere_scan import PROJECTOR, poses
from test_check_conventions import disturbed, frames_of, rigid_rig

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.scan.check_conventions import convention_problems
from sl_nerfstudio.scan.check_geometry import fit_geometry
from sl_nerfstudio.scan.types import PoseSigma

SIGMA = PoseSigma(5.0, 1.0, 0.5, 0.15)
EXACT = {  # of nerfstudio's worlds
    "camera": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "projector": ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
}


def scan(count=8, seed=1):
    """Free devices around a sphere, whose errors are those that the scan states."""
    random = np.random.default_rng(seed)
    honest = disturbed(frames_of(uneven(count)), 1.0, 5.0, 0.15 * 3**0.5, seed)
    return [
        replace(f, T_world_projector=f.T_world_projector @ shift(random.normal(size=3) * 0.5), sigma=SIGMA)
        for f in honest
    ]


def uneven(count):
    """Devices at irregular distances from each other, so that no order is that of another."""
    random = np.random.default_rng(0)
    out = []
    for T_world_camera, T_world_projector in poses(count):
        turn = Rotation.from_rotvec(random.normal(size=3) * [0.1, 0.1, 0.1]).as_matrix()
        T = T_world_projector.copy()
        T[:3, 3] = T_world_camera[:3, 3] + turn @ (T[:3, 3] - T_world_camera[:3, 3]) * random.uniform(0.8, 1.4)
        out.append((T_world_camera, T))
    return out


def shift(t):
    T = np.eye(4)
    T[:3, 3] = t
    return T


def reordered(frames, kinds, order):
    """The frames with poses of `kinds` of devices in another order."""
    return [
        replace(f, **{f"T_world_{kind}": getattr(frames[k], f"T_world_{kind}") for kind in kinds})
        for f, k in zip(frames, order, strict=True)
    ]


def in_world(frames, kind, S):
    """The frames with poses of one kind of device in another world."""
    moved = S.poses(np.stack([getattr(f, f"T_world_{kind}") for f in frames]))
    return [replace(f, **{f"T_world_{kind}": T}) for f, T in zip(frames, moved, strict=True)]


def only(frames):
    """The one problem of a scan, of all frames."""
    found = list(convention_problems(frames, PROJECTOR, 1e-3))
    assert len(found) == 1 and found[0][0] is None, found
    return found[0][1], found[0][2]


@pytest.mark.parametrize("seed", range(5))
def test_poses_within_what_is_stated_are_left_alone(seed):
    for count in (2, 3, 8):
        assert list(convention_problems(scan(count, seed), PROJECTOR, 1e-3)) == []
        assert fit_geometry(scan(count, seed), PROJECTOR).typical_excess < 2.5


@pytest.mark.parametrize(
    ("kinds", "words", "key"),
    [
        (["camera"], "the camera poses", "transform_matrix"),
        pytest.param(["projector"], "the projector poses", "projector_transform_matrix", marks=pytest.mark.slow),
        pytest.param(["camera", "projector"], "the poses of both devices", "transform_matrix", marks=pytest.mark.slow),
    ],
)
def test_an_order_that_is_not_that_of_the_images_is_named(kinds, words, key):
    frames = scan()
    for order, how in (
        (np.roll(range(8), 1), "one frame late (that of f0 stands at f1)"),
        (np.roll(range(8), -2), "2 frames early (that of f0 stands at f6)"),
        ([*range(1, 8), 7], "one frame early"),
        (range(7, -1, -1), "in reverse order (that of f0 stands at f7)"),
    ):
        found, problem = only(reordered(frames, kinds, order))
        assert found == key and problem.cause.startswith(f"{words} are {how}"), problem
        assert "the stated uncertainty explains" in problem.problem and f"put {words} in the order" in problem.remedy


@pytest.mark.parametrize("kind", ["camera", pytest.param("projector", marks=pytest.mark.slow)])
def test_a_world_of_one_kind_of_device_is_named(kind):
    R = EXACT[kind]
    _, problem = only(in_world(scan(), kind, Similarity(1.0, np.array(R, float), np.zeros(3))))
    axes = np.array(R if kind == "projector" else np.transpose(R)) @ [1, 2, 3]
    said = ", ".join(("-" if a < 0 else "") + "xyz"[abs(a) - 1] for a in axes)
    assert f"x, y, z of the projectors' are {said} of the cameras'" in problem.cause
    S = Similarity(0.13, Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix(), np.array([30.0, -5.0, 12.0]))
    key, problem = only(in_world(scan(), kind, S))
    assert key == "transform_matrix" and "are in two different worlds" in problem.cause
    scale = 0.13 if kind == "projector" else 1 / 0.13
    assert float(problem.cause.split("scaled by ")[1].split()[0]) == pytest.approx(scale, rel=0.05)


@pytest.mark.parametrize("kind", ["camera", "projector"])
def test_a_pose_that_was_copied_is_named_and_a_device_that_stands_still_is_not(kind):
    frames = scan()
    copied = reordered(frames, [kind], [0] * 8)
    key, problem = only(copied)
    assert key == ("transform_matrix" if kind == "camera" else "projector_transform_matrix")
    assert problem.problem.startswith("is the same in 8 of 8 frames") and "of f0 was copied" in problem.cause
    relative = np.linalg.inv(frames[0].T_world_camera) @ frames[0].T_world_projector
    key, problem = only([replace(f, T_world_projector=f.T_world_camera @ relative) for f in frames])
    assert key == "projector_transform_matrix" and "relative to the camera in 8 of 8 frames" in problem.problem
    still = poses(3)[0][0 if kind == "camera" else 1]
    moving = [(still, p) if kind == "camera" else (p, still) for p, _ in rigid_rig(12)[:2] + rigid_rig(12)[-2:]]
    found = list(convention_problems(frames_of(moving), PROJECTOR, 1e-3))
    assert not any("copied" in problem.cause for _, _, problem in found)
