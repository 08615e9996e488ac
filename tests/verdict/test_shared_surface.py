"""How much a frame decoded of what the others show: from a scan of which it is known, because the test removed it."""

import numpy as np
import pytest

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.review.coverage import shared_surface, shared_surface_of_scan
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

FRAMES, EMPTIED = 12, 5


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    root = tmp_path_factory.mktemp("shared") / "scan"
    exact = {"pose_error": (0.0, 0.0), "autocalibration_error": (0.0, 0.0, 0.0), "missing": 0.0, "wrong": 0.0}
    synthesise(SynthConfig(scene="frog", frames=FRAMES, resolution=160, **exact), root)
    return read_scan(root)


def shares(scan, coords, masks, poses=None):
    cameras = [f.camera for f in scan.frames]
    return shared_surface(cameras, scan.projector, poses or scan.poses, coords, masks).decoded


def read(scan):
    return [f.read_coords() for f in scan.frames], [f.read_mask() for f in scan.frames]


def test_where_all_is_decoded_so_is_what_the_others_show(scan):
    assert min(shared_surface_of_scan(scan).decoded) > 0.97


def test_what_no_frame_decoded_says_nothing_against_any(scan):
    """The pattern on a wall behind the object, five times as large in the image."""
    coords, masks = read(scan)
    wall = [np.ones_like(mask) for mask in masks]
    assert max(np.isfinite(c[..., 0]).mean() for c in coords) < 0.5
    seen = shares(scan, coords, wall)
    assert min(seen) > 0.85  # these masks say that the pattern reaches what is in shadow, too


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_what_one_frame_did_not_decode_is_measured(scan, share):
    coords, masks = read(scan)
    lost = np.random.default_rng(0).random(masks[EMPTIED].shape) > share
    coords[EMPTIED][lost] = np.nan
    found = shares(scan, coords, masks)
    assert found[EMPTIED] == pytest.approx(share, abs=0.05)
    assert min(s for k, s in enumerate(found) if k != EMPTIED) > 0.97


def test_what_the_pattern_does_not_reach_is_not_missing(scan):
    """The lower half of one frame is in the shadow of something: it sees no pattern there."""
    coords, masks = read(scan)
    half = masks[EMPTIED].shape[0] // 2
    coords[EMPTIED][half:], masks[EMPTIED][half:] = np.nan, False
    found = shares(scan, coords, masks)[EMPTIED]
    assert found is not None and found > 0.97


def test_shares_do_not_depend_on_unit_and_axes(scan):
    S = Similarity(1e-3, np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([3.0, -2.0, 7.0]))
    coords, masks = read(scan)
    coords[EMPTIED][::2] = np.nan
    here, there = shares(scan, coords, masks), shares(scan, coords, masks, scan.poses.mapped(S))
    np.testing.assert_allclose(here, there, atol=0.01)


def test_a_frame_far_from_the_others_is_not_judged(scan):
    poses = scan.poses.mapped(Similarity.identity())
    for T in (poses.T_world_camera, poses.T_world_projector):
        T[EMPTIED, :3, 3] += 1e4
    found = shares(scan, *read(scan), poses)
    assert found[EMPTIED] is None and None not in found[:EMPTIED]
