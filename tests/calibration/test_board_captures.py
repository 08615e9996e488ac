"""Corners in drawn photographs, and carried into the pattern, against known homographies."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sl_nerfstudio.calibration.board_adjustment import Corners
from sl_nerfstudio.calibration.board_captures import corners_in_pattern, find_corners, other_board_seen
from sl_nerfstudio.pattern.boards import CharucoBoard, Chessboard, draw_board

SQUARE_PX = 40
CHESSBOARD = Chessboard(7, 4, 20.0)
CHARUCO = CharucoBoard(8, 6, 20.0, 15.0, "5X5_1000")
SIZE = (640, 480)  # of the image


def photographed(board):
    """The board seen at an angle, and the (u, v) of its corners, computed from the homography."""
    drawn = draw_board(board, SQUARE_PX)
    h, w = drawn.shape
    source = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
    target = np.array([[90, 60], [560, 90], [600, 430], [60, 400]], np.float32)
    H = cv2.getPerspectiveTransform(source, target)
    to_centres = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # cv2 counts from the centre of the first pixel
    large = np.diag([4.0, 4.0, 1.0])  # drawn with 16 rays a pixel
    image = cv2.warpPerspective(
        drawn, np.linalg.inv(to_centres) @ large @ H @ to_centres, (4 * SIZE[0], 4 * SIZE[1]),
        flags=cv2.INTER_LINEAR, borderValue=255,
    )  # fmt: skip
    image = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), 0.7).astype(np.float32) / 255
    p = (board.corners() / board.square + 1) * SQUARE_PX
    uvw = np.c_[p, np.ones(len(p))] @ H.T
    return image, uvw[:, :2] / uvw[:, 2:]


@pytest.mark.parametrize(
    "board", [CHESSBOARD, CHARUCO, replace(CHARUCO, legacy=True)], ids=["chessboard", "charuco", "legacy"]
)
def test_corners_of_a_drawn_board_are_found(board):
    image, uv = photographed(board)
    found = find_corners(image * 0.3, replace(board, legacy=False) if isinstance(board, CharucoBoard) else board)
    assert found is not None
    np.testing.assert_array_equal(found.ids, np.arange(len(uv)))
    turned = [uv, uv[::-1]] if isinstance(board, Chessboard) else [uv]  # OpenCV may begin at the other end
    error = min((np.linalg.norm(found.uv - one, axis=1) for one in turned), key=np.max)
    assert np.sqrt((error**2).mean()) < 0.05 and error.max() < 0.08


def test_a_charuco_board_may_be_partly_out_of_view():
    image, uv = photographed(CHARUCO)
    image = image.copy()
    image[:, :300] = 0.5
    found = find_corners(image, CHARUCO)
    assert found is not None and 8 <= len(found.ids) < len(uv)
    assert np.linalg.norm(found.uv - uv[found.ids], axis=1).max() < 0.1


def test_no_board_is_none_and_another_board_is_named():
    empty = np.full(SIZE[::-1], 0.5, np.float32)
    image, _ = photographed(CHESSBOARD)
    assert find_corners(empty, CHESSBOARD) is None and find_corners(empty, CHARUCO) is None
    wrong = replace(CHESSBOARD, columns=8, rows=5)  # squares counted instead of corners
    assert find_corners(image, wrong) is None
    assert other_board_seen(image, wrong) == CHESSBOARD
    assert other_board_seen(empty, wrong) is None


H = np.array([[2.0, 0.3, 100.0], [-0.2, 1.8, 50.0], [2e-3, -1e-3, 1.0]])  # from camera to pattern pixels


def mapped(uv):
    uvw = np.concatenate([uv, np.ones_like(uv[..., :1])], -1) @ H.T
    return uvw[..., :2] / uvw[..., 2:]


@pytest.fixture
def plane():
    """Coordinates of a flat board in 100 x 80 pixels, and four corners on it."""
    x, y = np.meshgrid(np.arange(100) + 0.5, np.arange(80) + 0.5)
    uv = np.array([[30.3, 12.1], [68.7, 24.2], [31.2, 55.5], [69.4, 54.8]])
    return mapped(np.stack([x, y], -1)).astype(np.float32), Corners(np.array([0, 3, 4, 9]), uv)


def test_corners_are_carried_by_the_exact_homography(plane):
    coords, corners = plane
    found = corners_in_pattern(corners, coords)
    np.testing.assert_array_equal(found.ids, corners.ids)
    np.testing.assert_allclose(found.uv, mapped(corners.uv), atol=1e-4)


def test_nothing_decoded_at_the_corner_and_wrong_pixels_do_not_matter(plane):
    coords, corners = plane
    rng = np.random.default_rng(0)
    wrong = rng.random(coords.shape[:2]) < 0.1
    coords[wrong] += rng.uniform(-40, 40, (int(wrong.sum()), 2)).astype(np.float32)
    for x, y in corners.uv.astype(int):
        coords[y - 4 : y + 5, x - 4 : x + 5] = np.nan
    found = corners_in_pattern(corners, coords)
    np.testing.assert_allclose(found.uv, mapped(corners.uv), atol=0.01)


def test_a_corner_decoded_on_one_side_only_is_left_out(plane):
    coords, corners = plane
    coords[:, 50:] = np.nan  # the two right corners lie beyond
    coords[28:, 17:] = np.nan  # and of the surroundings of the lower left one only a strip is known
    np.testing.assert_array_equal(corners_in_pattern(corners, coords).ids, [0])
