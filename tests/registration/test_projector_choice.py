"""Frames of which two poses of the projector explain the coordinates: decided by their neighbours, or named."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl_nerfstudio.registration.register import choose_projectors, chosen_clouds
from sl_nerfstudio.registration.result import UndecidedProjector
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.candidates import plane_starts
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, ray_pairs
from tests.bundle_adjustment.analytic import DISK_HEIGHT, PROJECTORS, camera_of, images_of, rig_of
from tests.registration.analytic_clouds import clouds_of, part_of
from tests.relative_pose.known_pose import known_pose
from tests.relative_pose.two_views import errors_deg

SIZE = 100
RIG = part_of(rig_of(18, SIZE), list(range(5)))
IMAGES = [image.numpy() for image in images_of(RIG, SIZE)]
DEVICES = camera_of(SIZE), PROJECTORS["pinhole"]
OPEN = 2


def on_disk(cloud: FrameCloud, k: int) -> np.ndarray:
    """Coordinates of a frame on its supporting disk; NaN elsewhere."""
    length = float(RIG.T_camera_projector[k, :3, 3].norm())
    T = RIG.T_world_camera[k].numpy()
    z = length * cloud.points @ T[2, :3] + T[2, 3]
    coords = cloud.coords.copy()
    column, row = np.floor(cloud.uv_camera).astype(int).T
    off = np.abs(z - DISK_HEIGHT) > 1e-3
    coords[row[off], column[off]] = np.nan
    return coords


def twin_of(k: int, coords: np.ndarray) -> np.ndarray:
    """The other pose of the projector that explains the disk."""
    true = RIG.T_camera_projector[k].numpy()
    rays, _ = ray_pairs(*correspondences_of(coords), *DEVICES)
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
                  for T in (RIG.T_camera_projector[k].numpy(), twin_of(k, coords_of_disk(k))))  # fmt: skip
    first, second = (true, twin) if true_first else (twin, true)
    return frame_cloud(f"frame_{k:05d}", coords, *DEVICES, replace(first, alternatives=(second,)))


def coords_of_disk(k: int) -> np.ndarray:
    return on_disk(CLOUDS[k], k)


CLOUDS = clouds_of(RIG, SIZE)


@pytest.mark.parametrize("true_first", [False, True])
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


def test_where_only_a_flat_disk_is_seen_a_frame_is_right_or_named():
    """Its rim may still tell; the face of the disk does not."""
    flat = [two_poses(k, coords_of_disk(k), False) for k in range(4)]
    found = choose_projectors(flat)
    named = {u.frame for u in found.undecided}
    assert named
    for k, cloud in enumerate(chosen_clouds(flat, found.chosen)):
        error = max(errors_deg(cloud.pose.T_camera_projector, RIG.T_camera_projector[k].numpy()))
        assert cloud.name in named or error < 1e-6
    for doubt in found.undecided:
        assert isinstance(doubt, UndecidedProjector)
        k = [c.name for c in flat].index(doubt.frame)
        R = [T[:3, :3] for T in (RIG.T_camera_projector[k].numpy(), twin_of(k, coords_of_disk(k)))]
        expected = np.degrees(Rotation.from_matrix(R[0] @ R[1].T).magnitude())
        assert doubt.angle_deg == pytest.approx(expected, abs=0.1)


def test_without_alternatives_nothing_is_done():
    found = choose_projectors(CLOUDS[:2])
    assert found.chosen == (0, 0) and found.undecided == ()
