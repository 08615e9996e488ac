"""sl-calibrate as a user runs it, on photographs that sl-synth makes."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from sl_nerfstudio.calibration.formats import read_device_file
from sl_nerfstudio.cli.calibrate import main
from sl_nerfstudio.cli.synth import main as synth
from sl_nerfstudio.pattern.files import make_grid
from sl_nerfstudio.pattern.gray_code import GrayCode

from .snapshots import expect, expect_refusals, masked, succeed

pytestmark = pytest.mark.slow

FRAMES = 5
BOARD = ["--corners", "9x6", "--square", "30 mm"]


def _calibrate(*flags):
    return succeed(main, "sl-calibrate", *flags).out


@pytest.fixture(scope="session")
def captures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boards")
    (folder / "pattern.json").write_bytes(GrayCode(256, 192, 4).encode())
    flags = ["--frames", FRAMES, "--resolution", 320, "--seed", 1, "--pattern", folder / "pattern.json"]
    succeed(synth, "sl-synth", "--scene", "chessboard", "--output", folder / "scene", *flags)
    return folder / "scene"


@pytest.fixture(scope="session")
def calibrated(captures, tmp_path_factory):
    output = tmp_path_factory.mktemp("result") / "<b>intrinsics.json"
    flags = ("--output", output, *BOARD, "--pattern", captures / "pattern.json")
    said = _calibrate("--images", captures / "images", *flags)
    expect("sl-calibrate", "run", masked(said.replace(str(output.parent), "DIR").replace(str(captures), "SCENE")))
    return output


@pytest.fixture
def photographs(captures, tmp_path):
    """One image under white light of each pose, for the camera alone."""
    for pose in sorted((captures / "images").iterdir()):
        (tmp_path / "photographs").mkdir(exist_ok=True)
        shutil.copy(pose / "00.png", tmp_path / "photographs" / f"{pose.name}.png")
    return tmp_path / "photographs"


def test_both_devices_are_as_they_were(captures, calibrated):
    truth = json.loads((captures / "ground_truth" / "intrinsics.json").read_text())
    found = json.loads(calibrated.read_text())
    for name in ("camera", "projector"):
        got, true = found[name], truth[name]
        assert (got["w"], got["h"], got["model"]) == (true["w"], true["h"], true["model"])
        for key in ("fl_x", "fl_y", "cx", "cy"):
            assert abs(got[key] - true[key]) < 3 * got["sigma"][key]
            assert abs(got[key] - true[key]) < 0.01 * true["fl_x"]
    assert [pose["name"] for pose in found["poses"]] == [f"pose_{k:02d}" for k in range(FRAMES)]
    np.testing.assert_allclose(found["T_projector_camera"], truth["T_projector_camera"], rtol=0.02, atol=8)


def test_a_charuco_board_under_the_coded_grid_calibrates_both_devices(tmp_path):
    """Two photographs of each pose: under the grid, and under white light."""
    (tmp_path / "pattern.json").write_bytes(make_grid("800x800").encode())
    flags = ["--frames", 4, "--resolution", 480, "--seed", 2, "--pattern", tmp_path / "pattern.json"]
    succeed(synth, "sl-synth", "--scene", "charuco", "--output", tmp_path / "scene", *flags)
    board = ["--board", "charuco", "--squares", "11x8", "--square", "30 mm", "--marker", "22 mm"]
    output = tmp_path / "intrinsics.json"
    _calibrate("--images", tmp_path / "scene" / "images", "--output", output, *board,
         "--pattern", tmp_path / "pattern.json")  # fmt: skip
    truth, found = (
        json.loads(path.read_text()) for path in (tmp_path / "scene" / "ground_truth" / "intrinsics.json", output)
    )
    for name in ("camera", "projector"):
        got, true = found[name], truth[name]
        assert all(abs(got[key] - true[key]) < 3 * got["sigma"][key] for key in ("fl_x", "cx", "cy"))
        assert abs(got["fl_x"] - true["fl_x"]) < 0.01 * true["fl_x"]
    expected = {"columns": 11, "rows": 8, "square": 30.0, "marker": 22.0, "dictionary": "5X5_1000", "legacy": False}
    assert found["board"] == {"kind": "charuco", **expected}


def test_sl_process_reads_the_result(calibrated):
    found = json.loads(calibrated.read_text())
    for name in ("camera", "projector"):
        device = read_device_file(calibrated, name, (found[name]["w"], found[name]["h"]))
        assert all(getattr(device, key) == found[name][key] for key in ("fl_x", "fl_y", "cx", "cy", "k1", "model"))


def test_the_report_has_the_verdict_and_escapes_names(calibrated):
    page = calibrated.with_suffix(".html").read_text()
    verdict = json.loads(calibrated.read_text())["verdict"]
    assert f'<div class="verdict {verdict}"><strong>{verdict.capitalize()}</strong>' in page
    assert "<b>intrinsics" not in page and "&lt;b&gt;intrinsics.json" in page
    assert page.count('class="frame"') == FRAMES and 'id="next"' in page


def test_the_camera_alone_leaves_out_an_image_without_a_board(photographs, tmp_path):
    cv2.imwrite(str(photographs / "empty.png"), np.full((240, 320), 128, np.uint8))
    output = tmp_path / "camera.json"
    said = _calibrate("--images", photographs, "--output", output, *BOARD, "--camera-only")
    assert "not used" in said and "empty.png: shows no chessboard of 9 x 6 inner corners" in said
    found = json.loads(output.read_text())
    assert "projector" not in found and len(found["poses"]) == FRAMES
    assert abs(found["camera"]["fl_x"] / 416 - 1) < 0.01
    assert "shows no chessboard" in output.with_suffix(".html").read_text()
    shorter = output.stat()
    _calibrate("--images", photographs, "--output", output, *BOARD, "--camera-only")  # its own result is replaced
    assert output.stat().st_ino != shorter.st_ino


def test_an_image_of_another_size_is_named_and_left_out(photographs, tmp_path):
    cv2.imwrite(str(photographs / "pose_09.png"), np.full((200, 320), 128, np.uint8))
    said = _calibrate("--images", photographs, "--output", tmp_path / "a.json", *BOARD, "--camera-only")
    assert "pose_09.png: is 320 x 200 pixels, most images are 320 x 240" in said
    assert len(json.loads((tmp_path / "a.json").read_text())["poses"]) == FRAMES


def test_flags_and_photographs_that_cannot_be_are_named_and_nothing_is_written(
    captures, photographs, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(captures / "images", "poses")
    for pose in range(2, FRAMES):
        (photographs / f"pose_{pose:02d}.png").unlink()
        shutil.rmtree(f"poses/pose_{pose:02d}")
    Path("poses/pose_01/07.png").unlink()
    shutil.copy(captures / "pattern.json", "pattern.json")
    for name in ("mine.json", "html.html"):
        Path(name).write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    alone, charuco = [*BOARD, "--camera-only"], ["--board", "charuco"]
    expect_refusals(
        main, "sl-calibrate", ["--images", "photographs", "--output", "a.json"],
        ["--square", "30 mm", "--camera-only"], ["--corners", "9x6", "--camera-only"], BOARD,
        [*alone, "--sequence", "opencv"], [*alone, "--marker", "5 mm"], [*charuco, "--corners", "9x6"],
        [*charuco, "--squares", "9x6", "--square", "3 cm", "--camera-only"],
        ["--corners", "9by6", "--square", "30 mm", "--camera-only"],
        ["--corners", "9x6", "--square", "30", "--camera-only"], [*alone, "--output", "a.yml"],
        [*alone, "--output", "mine.json"], [*alone, "--output", "html.json"],
        ["--corners", "10x7", "--square", "30 mm", "--camera-only"],  # is answered with the right count
        ["--images", "poses", *BOARD, "--pattern", "pattern.json"],  # a sequence that is one image short
    )  # fmt: skip
    assert sorted(tmp_path.rglob("*")) == before and Path("mine.json").read_text() == "mine"
