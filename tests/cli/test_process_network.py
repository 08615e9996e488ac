"""From images alone to a scan with the network decoder, by the commands of the README."""

import json
import sys

import numpy as np
import pytest

from sl_nerfstudio.cli import process, synth
from sl_nerfstudio.scan import check_scan, read_scan
from sl_nerfstudio.scan.images import read_image
from tests.formulas import pose_errors

pytestmark = pytest.mark.slow

FRAMES, KEPT = 14, 5  # a walk around the object, and the neighbouring frames of it that are used
RESOLUTION = 540  # a period of the grid is about 14 pixels
HALF_A_PERIOD = 10.0  # pattern pixels: a pixel that is further off was decoded as another place


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Captures, their truth, and the scan that sl-process makes of them."""
    root = tmp_path_factory.mktemp("images")
    with pytest.MonkeyPatch.context() as patch:
        flags = ["--images-only", "--frames", FRAMES, "--resolution", RESOLUTION, "--seed", 3]
        patch.setattr(sys, "argv", ["sl-synth", "--output", str(root / "captures"), *map(str, flags)])
        synth.main()
        captures = root / "captures"
        for path in sorted((captures / "images").iterdir())[KEPT:]:
            path.unlink()
        first = _true_frames(root)[0]
        baseline = np.linalg.norm(first.T_world_camera[:3, 3] - first.T_world_projector[:3, 3])
        flags = [
            "--images", captures / "images", "--pattern", captures / "pattern.json", "--intrinsics",
            captures / "intrinsics.json", "--output", root / "scan", "--known-length",
            f"baseline of frame 0 = {baseline:.6f} mm", "--jobs", 2,
        ]  # fmt: skip
        patch.setattr(sys, "argv", ["sl-process", *map(str, flags)])
        process.main()
    return root


def _true_frames(root):
    return read_scan(root / "captures" / "ground_truth").frames[:KEPT]


def test_all_frames_are_in_the_scan_and_no_fault_is_found(folder):
    assert check_scan(folder / "scan") == []
    scan = read_scan(folder / "scan")
    assert [frame.name for frame in scan.frames] == [frame.name for frame in _true_frames(folder)]
    document = json.loads((folder / "scan" / "processing.json").read_text())
    assert document["decoder"] == "network" and len(document["frames"]) == KEPT
    for frame in document["frames"]:
        assert frame["in_scan"] and frame["decode_rate"] > 0.9 and frame["epipolar_px"] < 0.2
        assert frame["fitness"] > 0.9 and "degeneracies" not in frame
    before, after = document["joint_adjustment_px"]
    assert after < before < 3 and after < 0.15
    assert (folder / "scan" / "pattern.json").read_bytes() == (folder / "captures" / "pattern.json").read_bytes()


def test_poses_are_true_but_for_a_rigid_motion(folder):
    scan, true = read_scan(folder / "scan"), _true_frames(folder)
    found = scan.poses.stacked()
    wanted = np.stack([f.T_world_camera for f in true] + [f.T_world_projector for f in true])
    S, degrees, off = pose_errors(found, wanted)
    depth = np.linalg.norm(wanted[:KEPT, :3, 3], axis=1).mean()  # the object is at the origin
    assert off.max() < 0.004 * depth  # measured: 0.001
    assert degrees.max() < 0.4  # measured: 0.14
    assert scan.units == "mm" and S.scale == pytest.approx(1, abs=0.01)


def test_most_lit_pixels_are_decoded_and_hardly_any_wrongly(folder):
    for frame, true in zip(read_scan(folder / "scan").frames, _true_frames(folder), strict=True):
        coords, exact, mask = frame.read_coords(), true.read_coords(), frame.read_mask()
        decoded, lit = np.isfinite(coords).all(-1), np.isfinite(exact).all(-1)
        error = np.linalg.norm(coords[decoded & lit] - exact[decoded & lit], axis=-1)
        assert (decoded & lit).sum() > 0.9 * lit.sum()  # measured: 0.95 to 0.97
        assert np.median(error) < 0.2 and (error > HALF_A_PERIOD).mean() < 3e-3  # 0.10 to 0.12, up to 0.0021
        assert (decoded & ~lit).sum() < 0.01 * decoded.sum()  # up to 0.0076
        assert mask[decoded].all() and (mask & lit).sum() > 0.9 * lit.sum()
        np.testing.assert_array_equal(frame.read_image(), read_image(true.image_path))
