"""sl-process on the command line: from photographs to a scan folder, and its error messages."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from sl_nerfstudio.cli.process import main
from sl_nerfstudio.geometry.lie import exp_se3
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan import Scale, check_scan, read_scan
from sl_nerfstudio.scan.images import encode_png, read_image
from tests.formulas import pose_errors
from tests.processing.gray_scan import make_gray_scan

from .snapshots import expect, expect_refusals, masked, succeed

pytestmark = pytest.mark.slow


def _run(*flags):
    return succeed(main, "sl-process", *flags).out


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return make_gray_scan(tmp_path_factory.mktemp("gräy"))


@pytest.fixture
def copy(captures, tmp_path):
    """A copy of the captures that a test may spoil."""
    shutil.copytree(captures.root, tmp_path / "c")
    return type(captures)(tmp_path / "c", captures.T_world_camera, captures.T_world_projector, captures.coords)


def _spoil(folder, change):
    for path in folder.iterdir():
        path.write_bytes(encode_png(np.ascontiguousarray(change(read_image(path)))))


def test_photographs_become_a_metric_scan_and_a_second_run_decodes_nothing(captures, tmp_path):
    out, work = tmp_path / "scan", tmp_path / "work"
    true_length = float(np.linalg.norm((captures.T_world_camera - captures.T_world_projector)[1, :3, 3]))
    flags = ["--work", work, "--jobs", 1, "--known-length", f"baseline of frame 1 = {true_length:.6f} mm"]
    said = _run(*captures.flags, "--output", out, *flags)
    expect("sl-process", "run", masked(said.replace(str(tmp_path), "DIR")))
    assert check_scan(out) == []
    scan = read_scan(out)
    assert scan.units == "mm" and scan.scale.known and scan.scale == Scale(True, "baseline of frame pose 1", "pose 1")
    assert [f.name for f in scan.frames] == [f"pose {k}" for k in range(4)]
    for frame, exact in zip(scan.frames, captures.coords, strict=True):
        coords, mask = frame.read_coords(), frame.read_mask()
        both = np.isfinite(coords).all(-1) & np.isfinite(exact).all(-1)
        error = np.linalg.norm(coords[both] - exact[both], axis=1)
        assert both.sum() > 0.85 * np.isfinite(exact).all(-1).sum()
        assert np.median(error) < 0.5 and (error > 4).mean() < 0.01  # a cell
        assert mask[np.isfinite(coords).all(-1)].all()
    _assert_poses(scan, captures)
    document = json.loads((out / "processing.json").read_text())
    for frame in document["frames"]:
        assert frame["in_scan"] and min(frame["decode_rate"], frame["shared_decoded"]) > 0.8
    assert "4 of 4 frames are in the scan" in (out / "processing.html").read_text()

    again = tmp_path / "again"
    flags[flags.index("--jobs") + 1] = 2  # processes of their own make no difference
    assert "(4 had been decoded before)" in _run(*captures.flags, "--output", again, *flags)
    second = read_scan(again)
    np.testing.assert_array_equal(second.poses.T_world_camera, scan.poses.T_world_camera)
    np.testing.assert_array_equal(second.frames[2].read_pattern(), scan.frames[2].read_pattern())


def _assert_poses(scan, captures):
    """All devices lie as they truly do after one rigid motion: the length is known."""
    found = np.concatenate([scan.poses.T_world_camera, scan.poses.T_world_projector])
    true = np.concatenate([captures.T_world_camera, captures.T_world_projector])
    S, degrees, off = pose_errors(found, true)
    assert S.scale == pytest.approx(1, abs=0.03)
    span = np.linalg.norm(np.ptp(true[:, :3, 3], axis=0))
    assert off.max() < 0.03 * span and degrees.max() < 2.0


def test_frames_that_cannot_be_used_are_left_out_by_name(copy, tmp_path):
    images = copy.root / "images"
    _spoil(images / "pose 0", np.zeros_like)
    _spoil(images / "pose 3", lambda image: image[:-4])
    out = tmp_path / "scan"
    said = _run(*copy.flags, "--output", out, "--work", tmp_path / "w", "--jobs", 1)
    assert "wrote 2 of 4 frames" in said
    assert "left out: pose 0:" in said and "no stripes are seen: the images are black" in said
    assert "left out: pose 3:" in said and "is 160 x 156 pixels, most images are 160 x 160" in said
    assert [f.name for f in read_scan(out).frames] == ["pose 1", "pose 2"]
    assert read_scan(out).units == "arbitrary" and not read_scan(out).scale.known
    page = (out / "processing.html").read_text()
    assert "capture this frame again, with stripes visible" in page and "2 were left out" in page
    document = json.loads((out / "processing.json").read_text())
    assert [f["in_scan"] for f in document["frames"]] == [False, True, True, False]
    manifest = json.loads((tmp_path / "w" / "manifest.json").read_text())["frames"]
    assert manifest["pose 0"]["status"] == "failed in decoding" and manifest["pose 1"]["status"] == "decoded"


def test_colour_16_bit_and_a_camera_held_upside_down(copy, tmp_path):
    _spoil(copy.root / "images" / "pose 0", lambda image: np.repeat(image[..., None], 3, -1))
    _spoil(copy.root / "images" / "pose 1", lambda image: image.astype(np.uint16) * np.uint16(257))
    _spoil(copy.root / "images" / "pose 2", lambda image: np.rot90(image, 2))
    shutil.rmtree(copy.root / "images" / "pose 3")
    for order in ([], ["--unordered"]):
        out = tmp_path / f"scan{len(order)}"
        _run(*copy.flags, "--output", out, "--jobs", 1, "--work", tmp_path / "w", *order)
        scan = read_scan(out)
        assert len(scan.frames) == 3 and check_scan(out) == []
        assert scan.frames[0].read_image().ndim == 3 and scan.frames[1].read_image().dtype == np.uint16
        up = scan.poses.T_world_camera[:, :3, 1]
        assert up[0] @ up[1] > 0.5
        assert up[0] @ up[2] < -0.5  # the third camera is upside down


def test_rough_poses_give_axes_and_unit_and_a_projector_of_which_nothing_is_known_is_found(captures, tmp_path):
    rng, exact = np.random.default_rng(1), json.loads((captures.root / "intrinsics.json").read_text())
    rough = [T @ exp_se3(torch.from_numpy(rng.normal(0, [5, 5, 5, 0.05, 0.05, 0.05]))).numpy()
             for T in captures.T_world_camera]  # 5 mm, 3 degrees  # fmt: skip
    frames = [{"file_path": f"images/pose {k}.png", "transform_matrix": T.tolist()} for k, T in enumerate(rough)]
    (tmp_path / "rough.json").write_text(json.dumps({"units": "mm", "frames": frames}))
    alone = json.loads(json.dumps(exact))
    del alone["projector"]
    (tmp_path / "camera.json").write_text(json.dumps(alone))
    flags = [*captures.flags[:4], "--intrinsics", tmp_path / "camera.json", "--poses", tmp_path / "rough.json"]
    said = _run(*flags, "--estimate-projector", "--output", tmp_path / "scan", "--jobs", 1)
    assert "projector, from the epipolar geometry of all frames: focal lengths " in said
    scan = read_scan(tmp_path / "scan")
    assert scan.units == "mm" and scan.scale.source == "given camera poses"
    assert scan.projector.fl_x == pytest.approx(exact["projector"]["fl_x"], rel=0.01)
    away = np.linalg.norm(scan.poses.T_world_camera[:, :3, 3] - captures.T_world_camera[:, :3, 3], axis=1)
    assert away.max() < 15  # as the mean of the rough ones, though no alignment was made here


def test_flags_and_inputs_that_cannot_be_are_named_and_nothing_is_written(monkeypatch, captures, tmp_path):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(captures.root, "captures")
    intrinsics = json.loads((captures.root / "intrinsics.json").read_text())
    intrinsics["camera"] |= {"w": 320, "h": 240}
    Path("small.json").write_text(json.dumps(intrinsics))
    Path("mine").mkdir()
    Path("mine/file").touch()
    layouts = {"longer": GrayCode(800, 800, 8), "grid": GridPattern(), "wider": GrayCode(1280, 720, 4)}
    for name, layout in layouts.items():
        Path(f"{name}.json").write_bytes(layout.encode())
    before = sorted(tmp_path.rglob("*"))
    usual = [str(flag).replace(str(captures.root), "captures") for flag in captures.flags]
    expect_refusals(
        main, "sl-process", [*usual, "--output", "scan", "--jobs", 1],
        ["--images", "nowhere"], ["--images", "n" * 300], ["--masks", "n" * 300], ["--pattern", "nowhere.json"],
        ["--intrinsics", "nowhere.json"], ["--decoder", "network"], ["--decoder", "netwrok"],
        ["--known-length", "85 mm"], ["--known-length", ""], ["--known-length", "baseline of frame 9 = 85 mm"],
        ["--jobs", 0], ["--poses", "nowhere.json"], *(["--pattern", f"{name}.json"] for name in layouts),
        ["--intrinsics", "small.json"], ["--output", "mine"],
    )  # fmt: skip
    shutil.rmtree("scan.work")  # has the report of what was wrong with all frames
    assert sorted(tmp_path.rglob("*")) == before
