"""What a frame has of the surface that others show: from scans of which the truth is known."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.review.agreement import missing_shares, shared_surface, shared_surface_of_scan
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

FRAMES, ODD = 12, 5
EXACT = {"pose_error": (0.0, 0.0), "autocalibration_error": (0.0, 0.0, 0.0), "missing": 0.0, "wrong": 0.0}
ELSEWHERE = Similarity(1e-3, np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([3.0, -2.0, 7.0]))


def scan_of(scene, root):
    synthesise(SynthConfig(scene=scene, frames=FRAMES, resolution=160, **EXACT), root / "scan")
    return read_scan(root / "scan")


@pytest.fixture(scope="module")
def frog(tmp_path_factory):
    return scan_of("frog", tmp_path_factory.mktemp("shared"))


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A box of which no two sides are alike."""
    root = tmp_path_factory.mktemp("missing")
    trimesh.creation.box((110, 70, 50)).subdivide_to_size(8.0).export(root / "box.ply")
    return scan_of(str(root / "box.ply"), root)


def read(scan):
    return [f.read_coords() for f in scan.frames], [f.read_mask() for f in scan.frames]


def surface(scan, coords, masks, poses=None):
    return shared_surface([f.camera for f in scan.frames], scan.projector, poses or scan.poses, coords, masks)


def missing(scan, poses=None, seen=None):
    poses, (coords, masks) = poses or scan.poses, read(scan)
    points = surface(scan, coords, masks, poses).points
    return missing_shares([f.camera for f in scan.frames], scan.projector, poses, points, seen or masks)


def with_odd_frame(scan, motion):
    """The poses with the odd frame moved by a matrix."""
    poses = scan.poses.mapped(Similarity.identity())
    for T in (poses.T_world_camera, poses.T_world_projector):
        T[ODD] = motion @ T[ODD]
    return poses


@pytest.mark.parametrize("share", [0.2, 0.8])
@pytest.mark.slow
def test_what_one_frame_did_not_decode_is_measured(frog, share):
    assert min(shared_surface_of_scan(frog).decoded) > 0.97
    coords, masks = read(frog)
    coords[ODD][np.random.default_rng(0).random(masks[ODD].shape) > share] = np.nan
    found = surface(frog, coords, masks).decoded
    assert found[ODD] == pytest.approx(share, abs=0.05)
    assert min(s for k, s in enumerate(found) if k != ODD) > 0.97


def test_only_what_the_pattern_reaches_and_somebody_decoded_counts(frog):
    coords, masks = read(frog)
    wall = [np.ones_like(mask) for mask in masks]  # the pattern on a wall behind the object that no frame decoded
    assert max(np.isfinite(c[..., 0]).mean() for c in coords) < 0.5
    assert min(surface(frog, coords, wall).decoded) > 0.85  # these masks claim what is in shadow, too
    half = masks[ODD].shape[0] // 2  # the lower half of one frame is in the shadow of something
    coords[ODD][half:], masks[ODD][half:] = np.nan, False
    odd = surface(frog, coords, masks).decoded[ODD]
    assert odd is not None and odd > 0.97


def test_a_frame_far_from_the_others_is_not_judged(frog):
    away = np.eye(4)
    away[:3, 3] = 1e4
    found = surface(frog, *read(frog), with_odd_frame(frog, away)).decoded
    assert found[ODD] is None and None not in found[:ODD]


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["chair", "vase"])
def test_right_frames_miss_nothing(scene, tmp_path):
    """Thin legs, an inside, and shadows that parts cast on each other."""
    found = missing(scan_of(scene, tmp_path))
    assert None not in found
    assert max(found) < 0.01


@pytest.mark.parametrize("axis", ["y", "z"])
def test_a_frame_at_another_side_of_a_box_misses_what_others_show(box, axis):
    assert max(missing(box)) < 0.01
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(axis, 90, degrees=True).as_matrix()
    found = missing(box, with_odd_frame(box, turn))
    assert (found[ODD] or 0) > 0.05
    assert float(np.median(found)) < 0.05


def test_what_a_frame_did_not_decode_is_not_missing_if_it_saw_the_pattern_or_nothing_is_known(box):
    seen = [np.ones_like(frame.read_mask()) for frame in box.frames]
    assert max(missing(box, seen=seen)) == 0
    found = missing(box, seen=[*seen[:ODD], None, *seen[ODD + 1 :]])
    assert found[ODD] is None and None not in found[:ODD]


def test_shares_do_not_depend_on_unit_and_axes(box):
    coords, seen = read(box)
    coords[ODD][::2] = np.nan
    masks = [mask.copy() for mask in seen]
    seen[ODD][: seen[ODD].shape[0] // 2] = False  # as if a shadow had fallen on the upper half
    here, there = (missing(box, poses, seen) for poses in (box.poses, box.poses.mapped(ELSEWHERE)))
    np.testing.assert_allclose(here, there, atol=0.005)
    assert (here[ODD] or 0) > 0.2
    here, there = (surface(box, coords, masks, poses).decoded for poses in (box.poses, box.poses.mapped(ELSEWHERE)))
    np.testing.assert_allclose(here, there, atol=0.01)
    assert here[ODD] == pytest.approx(0.5, abs=0.05)
