"""Boards: OpenCV's own layout, corners and detectors agree with them."""

import re

import cv2
import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.boards import CharucoBoard, Chessboard, counts, draw_board, millimetres

CHARUCO = [
    CharucoBoard(6, 5, 7.5, 5.6, "5X5_1000"),
    CharucoBoard(5, 6, 7.5, 5.6, "4X4_50"),
    CharucoBoard(5, 6, 7.5, 5.6, "6X6_250", legacy=True),
    CharucoBoard(5, 7, 20.0, 15.0, "APRILTAG_36h11", legacy=True),
]


def blurred(image):
    """As a camera sees it: edges are a few pixels wide."""
    return cv2.GaussianBlur(image, (0, 0), 1.0)


@pytest.mark.parametrize("board", CHARUCO, ids=str)
def test_charuco_boards_are_those_of_opencv_and_its_detector_finds_their_corners(board):
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    theirs = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, markers)
    theirs.setLegacyPattern(board.legacy)
    assert np.allclose(board.corners(), np.array(theirs.getChessboardCorners())[:, :2])
    ours = draw_board(board, 80, margin=0)
    image = theirs.generateImage(ours.shape[::-1], marginSize=0)
    assert (ours != image).mean() < 0.02  # edges of markers, where they end within a pixel
    assert np.array_equal(ours[40::80, 2::80], image[40::80, 2::80])
    corners, ids, _, _ = cv2.aruco.CharucoDetector(theirs).detectBoard(blurred(draw_board(board, 60)))
    assert ids is not None and ids.ravel().tolist() == list(range(len(board.corners())))
    found = (corners.reshape(-1, 2) + 0.5) / 60 - 1
    assert np.abs(found * board.square - board.corners()).max() < 0.02 * board.square


@pytest.mark.parametrize("board", [Chessboard(9, 7, 75.0), Chessboard(5, 4, 0.5)], ids=str)
def test_chessboard_corners_are_detected_where_they_are_said_to_be(board):
    found, corners = cv2.findChessboardCornersSB(blurred(draw_board(board, 40)), (board.columns, board.rows))
    assert found and board.black()[0, 0]
    in_mm = ((corners.reshape(-1, 2) + 0.5) / 40 - 1) * board.square
    if in_mm[0, 0] > in_mm[-1, 0]:  # half a turn
        in_mm = in_mm[::-1]
    assert np.abs(in_mm - board.corners()).max() < 0.005 * board.square


def test_black_areas_do_not_overlap_and_make_up_the_picture():
    board = CHARUCO[0]
    left, top, right, bottom = board.black_areas().T
    area = ((right - left) * (bottom - top)).sum() / board.square**2
    assert area == pytest.approx((draw_board(board, 560, margin=0) == 0).mean() * 30, rel=1e-3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Chessboard(9, 7, 0.0), "larger than 0 mm"),
        (lambda: CharucoBoard(1, 9, 1.0, 0.5, "4X4_50"), "2 to 100 squares a side"),
        (lambda: CharucoBoard(11, 10, 1.0, 0.5, "4X4_50"), "55 white squares, but 4X4_50 has 50 markers"),
    ],
)
def test_boards_that_cannot_be(make, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make()


def test_what_a_user_types_about_a_board():
    for text, mm in (("75 mm", 75), ("7.5cm", 75), (".075 m", 75), ("1 in", 25.4), ("2 inch", 50.8), ("5 um", 0.005)):
        assert millimetres(text, "--square") == pytest.approx(mm)
    for text in ("75", "mm", "75 miles", "-75 mm", "nan mm", "0 mm", "1000 m", "1e99 m", ""):
        with pytest.raises(UserError, match=f'--square "{re.escape(text)}"'):
            millimetres(text, "--square")
    assert counts("9x7", "--corners") == counts(" 9 X 7", "--corners") == (9, 7)
    for text in ("9", "9x", "-9x7", "9x7x5", "99999x1"):
        with pytest.raises(UserError, match=f'--corners "{text}"'):
            counts(text, "--corners")
