"""sl-process on the command line: from photographs to a scan folder, and its error messages."""

import json
import shutil
import sys

import numpy as np
import pytest
import torch

from sl_nerfstudio.cli.process import main
from sl_nerfstudio.geometry.lie import exp_se3, fit_similarity
from sl_nerfstudio.scan import Scale, check_scan, read_scan
from sl_nerfstudio.scan.images import encode_png, read_image
from tests.processing.gray_scan import make_gray_scan

pytestmark = pytest.mark.slow


def _run(monkeypatch, *flags):
    monkeypatch.setattr(sys, "argv", ["sl-process", *map(str, flags)])
    main()


def _fails(monkeypatch, capsys, *flags):
    with pytest.raises(SystemExit) as stop:
        _run(monkeypatch, *flags)
    assert stop.value.code == 1
    return capsys.readouterr().err


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


def test_photographs_become_a_metric_scan_and_a_second_run_decodes_nothing(monkeypatch, captures, tmp_path, capsys):
    out, work = tmp_path / "scan", tmp_path / "work"
    true_length = float(np.linalg.norm((captures.T_world_camera - captures.T_world_projector)[1, :3, 3]))
    flags = ["--work", work, "--jobs", 1, "--known-length", f"baseline of frame 1 = {true_length:.6f} mm"]
    _run(monkeypatch, *captures.flags, "--output", out, *flags)
    said = capsys.readouterr().out
    assert "wrote 4 of 4 frames" in said and "processing.html" in said
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
    _run(monkeypatch, *captures.flags, "--output", again, *flags)
    assert "(4 had been decoded before)" in capsys.readouterr().out
    second = read_scan(again)
    np.testing.assert_array_equal(second.poses.T_world_camera, scan.poses.T_world_camera)
    np.testing.assert_array_equal(second.frames[2].read_pattern(), scan.frames[2].read_pattern())


def _assert_poses(scan, captures):
    """All devices lie as they truly do after one rigid motion: the length is known."""
    found = np.concatenate([scan.poses.T_world_camera, scan.poses.T_world_projector])
    true = np.concatenate([captures.T_world_camera, captures.T_world_projector])
    S = fit_similarity(found[:, :3, 3], true[:, :3, 3])
    assert S.scale == pytest.approx(1, abs=0.03)
    span = np.linalg.norm(np.ptp(true[:, :3, 3], axis=0))
    assert np.linalg.norm(S.points(found[:, :3, 3]) - true[:, :3, 3], axis=1).max() < 0.03 * span
    turned = np.einsum("nij,nkj->nik", S.R @ found[:, :3, :3], true[:, :3, :3])
    angle = np.degrees(np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angle.max() < 2.0


def test_frames_that_cannot_be_used_are_left_out_by_name(monkeypatch, copy, tmp_path, capsys):
    images = copy.root / "images"
    _spoil(images / "pose 0", np.zeros_like)
    _spoil(images / "pose 3", lambda image: image[:-4])
    out = tmp_path / "scan"
    _run(monkeypatch, *copy.flags, "--output", out, "--work", tmp_path / "w", "--jobs", 1)
    said = capsys.readouterr().out
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


def test_fewer_than_two_frames_is_an_error_that_names_them_all(monkeypatch, copy, tmp_path, capsys):
    for k in range(3):
        _spoil(copy.root / "images" / f"pose {k}", np.zeros_like)
    out = tmp_path / "scan"
    said = _fails(monkeypatch, capsys, *copy.flags, "--output", out, "--work", tmp_path / "w", "--jobs", 1)
    assert "1 of 4 frames can be used, a scan needs at least 2" in said
    for k in range(3):
        assert f"pose {k}: " in said
    assert "cause:" in said and "remedy:" in said
    assert not out.exists() and (tmp_path / "w" / "processing.html").is_file()


def test_colour_16_bit_and_a_camera_held_upside_down(monkeypatch, copy, tmp_path):
    _spoil(copy.root / "images" / "pose 0", lambda image: np.repeat(image[..., None], 3, -1))
    _spoil(copy.root / "images" / "pose 1", lambda image: image.astype(np.uint16) * np.uint16(257))
    _spoil(copy.root / "images" / "pose 2", lambda image: np.rot90(image, 2))
    shutil.rmtree(copy.root / "images" / "pose 3")
    for order in ([], ["--unordered"]):
        out = tmp_path / f"scan{len(order)}"
        _run(monkeypatch, *copy.flags, "--output", out, "--jobs", 1, "--work", tmp_path / "w", *order)
        scan = read_scan(out)
        assert len(scan.frames) == 3 and check_scan(out) == []
        assert scan.frames[0].read_image().ndim == 3 and scan.frames[1].read_image().dtype == np.uint16
        up = scan.poses.T_world_camera[:, :3, 1]
        assert up[0] @ up[1] > 0.5
        assert up[0] @ up[2] < -0.5  # the third camera is upside down


def test_rough_poses_give_axes_and_unit_and_a_projector_of_which_nothing_is_known_is_found(
    monkeypatch, captures, tmp_path, capsys
):
    rng, exact = np.random.default_rng(1), json.loads((captures.root / "intrinsics.json").read_text())
    rough = [T @ exp_se3(torch.from_numpy(rng.normal(0, [5, 5, 5, 0.05, 0.05, 0.05]))).numpy()
             for T in captures.T_world_camera]  # 5 mm, 3 degrees  # fmt: skip
    frames = [{"file_path": f"images/pose {k}.png", "transform_matrix": T.tolist()} for k, T in enumerate(rough)]
    (tmp_path / "rough.json").write_text(json.dumps({"units": "mm", "frames": frames}))
    alone = json.loads(json.dumps(exact))
    del alone["projector"]
    (tmp_path / "camera.json").write_text(json.dumps(alone))
    flags = [*captures.flags[:4], "--intrinsics", tmp_path / "camera.json", "--poses", tmp_path / "rough.json"]
    _run(monkeypatch, *flags, "--estimate-projector", "--output", tmp_path / "scan", "--jobs", 1)
    assert "projector, from the epipolar geometry of all frames: focal lengths " in capsys.readouterr().out
    scan = read_scan(tmp_path / "scan")
    assert scan.units == "mm" and scan.scale.source == "given camera poses"
    assert scan.projector.fl_x == pytest.approx(exact["projector"]["fl_x"], rel=0.01)
    away = np.linalg.norm(scan.poses.T_world_camera[:, :3, 3] - captures.T_world_camera[:, :3, 3], axis=1)
    assert away.max() < 15  # as the mean of the rough ones, though no alignment was made here


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--images", "nowhere"], "nowhere: is no folder"),
        (["--images", "n" * 300], "nnn: is no folder"),
        (["--masks", "n" * 300], "nnn: is no folder"),
        (["--pattern", "nowhere.json"], "nowhere.json: is missing"),
        (["--intrinsics", "nowhere.json"], "nowhere.json: is missing"),
        (["--decoder", "network"], "describes a Gray-code sequence, which --decoder network does not read"),
        (["--decoder", "netwrok"], "--decoder netwrok: there is no decoder of this name"),
        (["--known-length", "85 mm"], 'known length "85 mm" is not understood'),
        (["--known-length", ""], 'known length "" is not understood'),
        (["--known-length", "baseline of frame 9 = 85 mm"], "--known-length: there is no frame 9"),
        (["--jobs", "0"], "--jobs 0: give at least 1"),
        (["--poses", "nowhere.json"], "nowhere.json: is missing"),
    ],
)
def test_bad_flags(monkeypatch, captures, tmp_path, capsys, flags, message):
    said = _fails(monkeypatch, capsys, *captures.flags, "--output", tmp_path / "scan", *flags)
    assert message in said and not (tmp_path / "scan").exists()


def test_wrong_pattern_and_wrong_intrinsics(monkeypatch, captures, tmp_path, capsys):
    from sl_nerfstudio.pattern.gray_code import GrayCode
    from sl_nerfstudio.pattern.grid import GridPattern

    other = tmp_path / "other.json"
    rest = [*captures.flags[:2], *captures.flags[4:], "--output", tmp_path / "s", "--jobs", "1"]
    other.write_bytes(GrayCode(800, 800, 8).encode())
    said = _fails(monkeypatch, capsys, *rest, "--pattern", other)
    assert "holds 34 images, the sequence of the pattern has 30" in said and "another sequence" in said
    other.write_bytes(GridPattern().encode())
    said = _fails(monkeypatch, capsys, *rest, "--pattern", other)
    assert "holds 0 images; a scan needs at least 2 frames" in said and "do not suit the pattern" in said
    other.write_bytes(GrayCode(1280, 720, 4).encode())
    said = _fails(monkeypatch, capsys, *rest, "--pattern", other)
    assert "projector was calibrated at 800 x 800, but the images are 1280 x 720" in said
    intrinsics = json.loads((captures.root / "intrinsics.json").read_text())
    intrinsics["camera"] |= {"w": 320, "h": 240}
    small = tmp_path / "small.json"
    small.write_text(json.dumps(intrinsics))
    said = _fails(monkeypatch, capsys, *captures.flags, "--output", tmp_path / "s", "--intrinsics", small)
    assert "small.json: camera was calibrated at 320 x 240, but the images are 160 x 160" in said


def test_an_earlier_scan_is_not_overwritten(monkeypatch, captures, tmp_path, capsys):
    (tmp_path / "mine").write_text("x")
    said = _fails(monkeypatch, capsys, *captures.flags, "--output", tmp_path)
    assert "is not empty" in said and [p.name for p in tmp_path.iterdir()] == ["mine"]
