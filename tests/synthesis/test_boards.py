"""Photographs of boards: what is in them agrees with the truth beside them."""

import json

import cv2
import numpy as np
import pytest
import torch

from sl_nerfstudio.calibration.board_captures import find_corners
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.synthesis.boards import BOARDS, write_board_captures
from sl_nerfstudio.synthesis.config import SynthConfig


@pytest.mark.parametrize("scene", BOARDS)
@pytest.mark.slow
def test_corners_are_where_the_truth_projects_them(scene, tmp_path):
    (tmp_path / "p.json").write_bytes(GrayCode(64, 48, 16).encode())
    config = SynthConfig(
        scene=scene, frames=2, resolution=560, pattern=tmp_path / "p.json", camera_distortion=(-0.2, 0.05, 0.0, 0.0)
    )
    write_board_captures(config, tmp_path / "out")
    truth = json.loads((tmp_path / "out/ground_truth/intrinsics.json").read_text())
    camera = Intrinsics.of(Device(**truth["camera"]), torch.float64)
    board = BOARDS[scene]
    p_board = np.c_[board.corners() * (1, -1), np.zeros(len(board.corners()))]
    for pose, T in enumerate(np.array(truth["T_camera_board"])):
        image = cv2.imread(str(tmp_path / f"out/images/pose_{pose:02d}/00.png"), cv2.IMREAD_GRAYSCALE)
        found = find_corners(image.astype(np.float32) / 255, board)
        expected, _ = project(camera, torch.from_numpy(p_board @ T[:3, :3].T + T[:3, 3]))
        assert found is not None and len(found.ids) > 0.8 * len(p_board)
        uv = expected.numpy()
        turned = [uv, uv[::-1]] if scene == "chessboard" else [uv]  # OpenCV may begin at the other end
        assert min(np.median(np.linalg.norm(found.uv - one[found.ids], axis=1)) for one in turned) < 0.12


def test_flags_of_scans_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"--appearance, --units: says nothing about photographs of a chessboard"):
        write_board_captures(SynthConfig(scene="chessboard", appearance="hard", units="m"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
