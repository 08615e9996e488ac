"""sl-calibrate as a user runs it, on photographs that sl-synth makes."""

import json
import re
import shutil
import sys

import cv2
import numpy as np
import pytest

from sl_nerfstudio.calibration.formats import read_device_file
from sl_nerfstudio.cli.calibrate import main
from sl_nerfstudio.cli.synth import main as synth
from sl_nerfstudio.pattern.files import make_grid
from sl_nerfstudio.pattern.gray_code import GrayCode

FRAMES = 5
BOARD = ["--corners", "9x6", "--square", "30 mm"]


def _run(command, *flags):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["sl-calibrate", *map(str, flags)])
        command()


def _refused(capsys, *flags):
    """What the command says on its error output."""
    with pytest.raises(SystemExit) as stopped:
        _run(main, *flags)
    assert stopped.value.code not in (0, None)
    return capsys.readouterr().err


@pytest.fixture(scope="session")
def captures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boards")
    (folder / "pattern.json").write_bytes(GrayCode(256, 192, 4).encode())
    flags = ["--frames", FRAMES, "--resolution", 320, "--seed", 1, "--pattern", folder / "pattern.json"]
    _run(synth, "--scene", "chessboard", "--output", folder / "scene", *flags)
    return folder / "scene"


@pytest.fixture(scope="session")
def calibrated(captures, tmp_path_factory):
    output = tmp_path_factory.mktemp("result") / "<b>intrinsics.json"
    _run(main, "--images", captures / "images", "--output", output, *BOARD, "--pattern", captures / "pattern.json")
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
    _run(synth, "--scene", "charuco", "--output", tmp_path / "scene", *flags)
    board = ["--board", "charuco", "--squares", "11x8", "--square", "30 mm", "--marker", "22 mm"]
    output = tmp_path / "intrinsics.json"
    _run(main, "--images", tmp_path / "scene" / "images", "--output", output, *board,
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


def test_the_camera_alone_leaves_out_an_image_without_a_board(photographs, tmp_path, capsys):
    cv2.imwrite(str(photographs / "empty.png"), np.full((240, 320), 128, np.uint8))
    output = tmp_path / "camera.json"
    _run(main, "--images", photographs, "--output", output, *BOARD, "--camera-only")
    said = capsys.readouterr().out
    assert "not used" in said and "empty.png: shows no chessboard of 9 x 6 inner corners" in said
    found = json.loads(output.read_text())
    assert "projector" not in found and len(found["poses"]) == FRAMES
    assert abs(found["camera"]["fl_x"] / 416 - 1) < 0.01
    assert "shows no chessboard" in output.with_suffix(".html").read_text()
    shorter = output.stat()
    _run(main, "--images", photographs, "--output", output, *BOARD, "--camera-only")  # its own result is replaced
    assert output.stat().st_ino != shorter.st_ino


def test_a_wrong_count_is_answered_with_the_right_one(photographs, tmp_path, capsys):
    for pose in range(2, FRAMES):
        (photographs / f"pose_{pose:02d}.png").unlink()
    flags = ["--corners", "10x7", "--square", "30 mm", "--camera-only"]
    said = _refused(capsys, "--images", photographs, "--output", tmp_path / "a.json", *flags)
    assert "0 poses of the board can be used, 3 are needed" in said and "give --corners 9x6" in said
    assert not (tmp_path / "a.json").exists()


def test_an_image_of_another_size_is_named_and_left_out(photographs, tmp_path, capsys):
    cv2.imwrite(str(photographs / "pose_09.png"), np.full((200, 320), 128, np.uint8))
    _run(main, "--images", photographs, "--output", tmp_path / "a.json", *BOARD, "--camera-only")
    said = capsys.readouterr().out
    assert "pose_09.png: is 320 x 200 pixels, most images are 320 x 240" in said
    assert len(json.loads((tmp_path / "a.json").read_text())["poses"]) == FRAMES


def test_a_sequence_one_image_short_is_named(captures, tmp_path, capsys):
    shutil.copytree(captures / "images", tmp_path / "images")
    for pose in range(2, FRAMES):
        shutil.rmtree(tmp_path / "images" / f"pose_{pose:02d}")
    (tmp_path / "images" / "pose_01" / "07.png").unlink()
    pattern = ["--pattern", captures / "pattern.json"]
    said = _refused(capsys, "--images", tmp_path / "images", "--output", tmp_path / "a.json", *BOARD, *pattern)
    assert "pose_01" in said and "25" in said and "one image of each of the 26 patterns" in said


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--square", "30 mm", "--camera-only"], "--corners is missing(.*\n)+.*--corners 9x7"),
        (["--corners", "9x6", "--camera-only"], "--square is missing"),
        ([*BOARD], "--pattern is missing(.*\n)+.*--camera-only"),
        ([*BOARD, "--camera-only", "--sequence", "opencv"], "--camera-only: no pattern is needed"),
        ([*BOARD, "--camera-only", "--marker", "5 mm"], "--marker: says nothing about a chessboard"),
        (["--board", "charuco", "--corners", "9x6"], "--corners: says nothing about a charuco"),
        (["--board", "charuco", "--squares", "9x6", "--square", "3 cm", "--camera-only"], "--marker is missing"),
        (["--corners", "9by6", "--square", "30 mm", "--camera-only"], "--corners"),
        (["--corners", "9x6", "--square", "30", "--camera-only"], "--square"),
    ],
)
def test_flags_that_are_missing_or_contradict_are_named(flags, message, tmp_path, capsys):
    said = _refused(capsys, "--images", tmp_path, "--output", tmp_path / "a.json", *flags)
    assert re.search(message, said), said


def test_files_of_others_are_not_overwritten(photographs, tmp_path, capsys):
    for name in ("a.json", "a.html"):
        (tmp_path / name).write_text("mine")
        said = _refused(capsys, "--images", photographs, "--output", tmp_path / "a.json", *BOARD, "--camera-only")
        assert f"{name}: would be overwritten" in said and (tmp_path / name).read_text() == "mine"
        (tmp_path / name).unlink()
    assert "must end in .json" in _refused(
        capsys, "--images", photographs, "--output", tmp_path / "a.yml", *BOARD, "--camera-only"
    )
