"""The benchmark of photographs: what it calls right, wrong and decoded, on scans with errors made on purpose."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.photographs.__main__ import Config, line, measure, row_of, summary
from benchmarks.photographs.scoring import FoundFrame, decoding_figures, group_sizes, pose_errors, read_truth
from benchmarks.photographs.sets import WORK, captures_of, chosen_captures, note_of
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.types import PoseSigma

_SET = "cone-and-cylinder-table-plain-3-shuffled"
_GAUGE = Similarity(0.37, Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix(), np.array([30.0, -5.0, 8.0]))
_SIGMA = PoseSigma(0.1, 0.05, 0.1, 0.05)


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return captures_of(_SET, 7, 72, tmp_path_factory.mktemp("sets"))


@pytest.fixture(scope="module")
def truth(captures):
    return read_truth(captures)


def _found(captures, moved=None, names=None):
    """Frames in another gauge under the names of the images, some moved by a function of both poses."""
    scan = read_scan(captures / "ground_truth")
    frames = []
    for name, number in note_of(captures)["frames"].items():
        if names is not None and name not in names:
            continue
        T = scan.frames[number].T_world_camera, scan.frames[number].T_world_projector
        T = (moved or {}).get(name, lambda *poses: poses)(*T)
        camera, projector = (_GAUGE.poses(pose) for pose in T)
        frames.append(FoundFrame(name, camera, projector, _SIGMA))
    return frames


def _turned(degrees, axis=(0.0, 0.0, 1.0)):
    """A motion of a frame as a whole about the world's origin, which is near the object."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix()
    return lambda camera, projector: (T @ camera, T @ projector)


def _with_baseline(factor):
    def move(camera, projector):
        other = projector.copy()
        other[:3, 3] = camera[:3, 3] + factor * (projector[:3, 3] - camera[:3, 3])
        return camera, other

    return move


def _with_projector_turned(degrees):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, 0, np.radians(degrees)]).as_matrix()
    return lambda camera, projector: (camera, projector @ T)


def test_a_perfect_scan_in_any_gauge_is_right(captures, truth):
    errors = pose_errors(_found(captures), truth)
    assert len(errors) == 7 and all(e.right for e in errors)
    assert max(e.camera_deg for e in errors) < 1e-5 and max(e.shift for e in errors) < 1e-6
    assert truth.size == pytest.approx(80)


@pytest.mark.parametrize(
    ("move", "right"),
    [
        (_turned(25.0), False),
        (_turned(2.0), True),
        (_turned(4.0), False),
        (_with_baseline(1.1), False),
        (_with_baseline(1.005), True),
        (_with_projector_turned(3.5), False),
    ],
)
def test_a_stray_is_found_and_tilts_no_other_frame(captures, truth, move, right):
    errors = {e.name: e for e in pose_errors(_found(captures, {"photo_002": move}), truth)}
    assert errors["photo_002"].right == right
    others = [e for name, e in errors.items() if name != "photo_002"]
    assert all(e.right for e in others)
    if not right:
        assert max(e.camera_deg for e in others) < 1e-3


def test_strays_that_agree_with_each_other_are_still_strays(captures, truth):
    moved = dict.fromkeys(("photo_000", "photo_003", "photo_005"), _turned(40.0, (0.0, 1.0, 0.0)))
    found = _found(captures, moved)
    assert {e.name for e in pose_errors(found, truth) if not e.right} == set(moved)
    assert group_sizes(found, truth) == (4, 3)


def test_decoded_pixels_of_the_object_are_counted(captures, truth, tmp_path):
    """A quarter of the pixels missing, one in ten off by 5 pattern pixels, the rest off by 0.3; one frame refused."""
    rng = np.random.default_rng(0)
    kept, lit, lit_of_refused = {}, 0, 0
    (tmp_path / "decoded").mkdir()
    for name, frame in truth.frames.items():
        coords = frame.frame.read_coords().copy()
        own = np.isfinite(frame.object_coords()[..., 0])
        lit += own.sum()
        assert 0 < own.sum() < np.isfinite(coords[..., 0]).sum(), "the table is not the object"
        if name == "photo_004":
            kept[name] = {"key": "", "status": "failed in decoding"}
            lit_of_refused = own.sum()
            continue
        draw = rng.random(own.shape)
        coords[..., 0] += np.where(draw < 0.1, 5.0, 0.3)
        coords[draw > 0.75] = np.nan
        np.savez(tmp_path / "decoded" / f"{name}-k.npz", coords=coords)
        kept[name] = {"key": "k", "status": "decoded"}
    (tmp_path / "manifest.json").write_text(json.dumps({"frames": kept}))
    figures = decoding_figures(tmp_path, truth)
    assert figures.decoded == pytest.approx(0.75 * (1 - lit_of_refused / lit), abs=0.02)
    assert figures.median_px == pytest.approx(0.3, abs=1e-3)
    assert figures.wrong == pytest.approx(0.1 / 0.75, abs=0.02) and figures.slipped == 0


def test_a_row_counts_frames_and_a_failed_run_has_none_right(captures, truth):
    scan = _found(captures, {"photo_001": _turned(90.0)}, names=[f"photo_{n:03d}" for n in range(5)])
    row = row_of(captures, truth, scan, None, "good", 1.0, "")
    assert (row.right, row.wrong, row.left_out, row.usable) == (4, ("photo_001",), 2, 7)
    assert (row.placed, row.beyond, row.groups) == (5, ("photo_001",), (4, 1))
    assert row.camera_deg < 1e-5 and row.sigma_deg == _SIGMA.camera_rotation_deg
    assert "1 of them under good or acceptable" in summary([row])
    failed = row_of(captures, truth, [], None, "-", 1.0, "error: 1 of 7 frames could be used")
    assert (failed.right, failed.wrong, failed.left_out, failed.groups) == (0, (), 7, ())
    assert "error: 1 of 7" in line(failed)


def test_sets_are_found_by_list_part_name_and_folder(captures):
    folder = captures.parent
    assert chosen_captures(["kept"], 7, 72, folder) == [captures]
    assert chosen_captures([captures.name, _SET], 7, 72, folder) == [captures]
    with pytest.raises(UserError, match=r"cube-table-plain-3.*SCENE-BACKGROUND-APPEARANCE-SEED"):
        chosen_captures(["cube-table-plain-3"], 7, 72, folder)


@pytest.mark.slow
def test_registration_alone_is_measured_on_frames_that_are_decoded_once(tmp_path):
    config = Config(until="decoded", keep=tmp_path, jobs=1)
    captures = captures_of("cone-and-cylinder-none-plain-3-half", 6, 320, tmp_path)
    assert measure(captures, config).placed == 0
    kept = {file: file.stat().st_ino for file in (captures / WORK).rglob("*.npz")}
    row = measure(captures, replace(config, until="registered"))
    assert row.message == "" and row.wrong == () and row.right == row.placed >= 4, line(row)
    assert row.decoded > 0.7 and row.median_px < 0.5 and row.camera_deg < 1 < 50 * row.sigma_deg
    assert {file: file.stat().st_ino for file in (captures / WORK).rglob("*.npz")} == kept
