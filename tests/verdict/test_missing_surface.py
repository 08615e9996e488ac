"""Surface that a frame should have seen: from scans in which one frame is known to be at the wrong place."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.review.coverage import missing_shares, shared_surface
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

FRAMES, ODD = 12, 5
EXACT = {"pose_error": (0.0, 0.0), "autocalibration_error": (0.0, 0.0, 0.0), "missing": 0.0, "wrong": 0.0}


def scan_of(scene, root):
    synthesise(SynthConfig(scene=scene, frames=FRAMES, resolution=160, **EXACT), root / "scan")
    return read_scan(root / "scan")


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A box of which no two sides are alike."""
    root = tmp_path_factory.mktemp("missing")
    trimesh.creation.box((110, 70, 50)).subdivide_to_size(8.0).export(root / "box.ply")
    return scan_of(str(root / "box.ply"), root)


def missing(scan, poses=None, seen=None):
    poses, cameras = poses or scan.poses, [f.camera for f in scan.frames]
    coords, masks = [f.read_coords() for f in scan.frames], [f.read_mask() for f in scan.frames]
    points = shared_surface(cameras, scan.projector, poses, coords, masks).points
    return missing_shares(cameras, scan.projector, poses, points, seen or masks)


@pytest.mark.parametrize("scene", ["chair", "vase"])
def test_right_frames_miss_nothing(scene, tmp_path):
    """Thin legs, an inside, and shadows that parts cast on each other."""
    found = missing(scan_of(scene, tmp_path))
    assert None not in found
    assert max(found) < 0.01


@pytest.mark.parametrize("axis", ["y", "z"])
def test_a_frame_at_another_side_of_a_box_misses_what_others_show(box, axis):
    assert max(missing(box)) < 0.01
    poses = box.poses.mapped(Similarity.identity())
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(axis, 90, degrees=True).as_matrix()
    for T in (poses.T_world_camera, poses.T_world_projector):
        T[ODD] = turn @ T[ODD]
    found = missing(box, poses)
    assert (found[ODD] or 0) > 0.05
    assert float(np.median(found)) < 0.05


def test_what_a_frame_did_not_decode_is_not_missing_if_it_saw_the_pattern(box):
    seen = [np.ones_like(frame.read_mask()) for frame in box.frames]
    assert max(missing(box, seen=seen)) == 0


def test_where_nothing_is_known_nothing_is_said(box):
    seen = [frame.read_mask() for frame in box.frames]
    seen[ODD] = None
    found = missing(box, seen=seen)
    assert found[ODD] is None and None not in found[:ODD]


def test_shares_do_not_depend_on_unit_and_axes(box):
    S = Similarity(1e-3, np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([3.0, -2.0, 7.0]))
    seen = [frame.read_mask() for frame in box.frames]
    seen[ODD][: seen[ODD].shape[0] // 2] = False  # as if a shadow had fallen on the upper half
    here, there = missing(box, seen=seen), missing(box, box.poses.mapped(S), seen)
    np.testing.assert_allclose(here, there, atol=0.005)
    assert (here[ODD] or 0) > 0.2
