"""sl-pattern --kind chessboard|charuco: an independent PDF reader finds the board in its stated size."""

import json
import shlex
import sys

import cv2
import numpy as np
import pypdfium2
import pytest
from PIL import Image

from sl_nerfstudio.cli.pattern import main
from sl_nerfstudio.pattern.boards import CharucoBoard, Chessboard

PIXELS_PER_MM = 8
CHESSBOARD = Chessboard(9, 7, 18.0)
CHARUCO = CharucoBoard(12, 8, 15.0, 11.2, "5X5_1000")
FLAGS = {
    CHESSBOARD: ["--kind", "chessboard", "--corners", "9x7", "--square", "18 mm"],
    CHARUCO: ["--kind", "charuco", "--squares", "12x8", "--print-width", "180", "--marker", "1.12 cm"],
}
each_board = pytest.mark.parametrize("board", FLAGS, ids=["chessboard", "charuco"])


def _run(*flags):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["sl-pattern", *map(str, flags)])
        main()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folders = {board: tmp_path_factory.mktemp("boards") / str(k) for k, board in enumerate(FLAGS)}
    for board, folder in folders.items():
        _run("--output", folder, *FLAGS[board])
    return folders


def _rendered(page, pixels_per_mm=PIXELS_PER_MM, **options):
    return np.asarray(page.render(scale=pixels_per_mm * 25.4 / 72, grayscale=True, **options).to_pil())


def _found(board, image):
    """Detected corners in pixels from the image's corner, in the order of `corners`."""
    image = cv2.GaussianBlur(image, (0, 0), 1.0)
    if isinstance(board, Chessboard):
        found, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows))
        corners = corners.reshape(-1, 2) + 0.5
        assert found
        return corners if corners[0, 1] < corners[-1, 1] else corners[::-1]
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    theirs = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, markers)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(theirs).detectBoard(image)
    assert ids.ravel().tolist() == list(range(len(board.corners())))
    return corners.reshape(-1, 2) + 0.5


def _agree(board, found_mm):
    """To a hundredth of a millimetre, apart from where the board lies on the page."""
    found_mm, true = found_mm - found_mm.mean(0), board.corners() - board.corners().mean(0)
    assert np.abs(found_mm - true).max() < 0.03
    stretch = (found_mm * true).sum(0) / (true * true).sum(0)
    assert np.abs(stretch - 1).max() < 1e-4


@each_board
def test_the_pdf_has_the_stated_size(written, board):
    page = pypdfium2.PdfDocument(written[board] / "board.pdf")[0]
    w, h = (points * 25.4 / 72 for points in page.get_size())
    assert (round(w, 2), round(h, 2)) == (297, 210)
    image = _rendered(page)
    mm_a_pixel = np.array([w, h]) / image.shape[::-1]  # the reader rounds the page up to whole pixels, and stretches it
    _agree(board, _found(board, image) * mm_a_pixel)
    assert not list(page.get_objects(filter=[pypdfium2.raw.FPDF_PAGEOBJ_IMAGE]))  # vectors alone


@each_board
def test_the_png_has_the_stated_size(written, board):
    with Image.open(written[board] / "board.png") as picture:
        per_mm = picture.info["dpi"][0] / 25.4
        assert picture.size == (round(297 * per_mm), round(210 * per_mm)) and picture.info["dpi"][0] > 590
        w, h = picture.size
        small = np.asarray(picture.resize((w // 3, h // 3), Image.Resampling.BOX, box=(0, 0, w - w % 3, h - h % 3)))
    _agree(board, _found(board, small) * 3 / per_mm)


def test_the_ruler_on_the_page_is_100_mm_long(written):
    page = pypdfium2.PdfDocument(written[CHESSBOARD] / "board.pdf")[0]
    image = _rendered(page, 40, crop=(20, 5, 500, 560))
    ruler = np.flatnonzero((image < 128).mean(0) > 0)  # columns of pixels with ink: the first mark, the line
    line = image[(image < 128).sum(1).argmax()] < 128
    assert np.count_nonzero(line) / 40 == pytest.approx(100, abs=0.05) and ruler[0] == np.flatnonzero(line)[0]


@each_board
def test_the_page_says_what_the_board_is(written, board):
    text = pypdfium2.PdfDocument(written[board] / "board.pdf")[0].get_textpage().get_text_range()
    what = "9 x 7 inner corners, squares 18 mm" if board is CHESSBOARD else (
        "12 x 8 squares of 15 mm, markers 11.2 mm, dictionary 5X5_1000"
    )  # fmt: skip
    assert what in text and "100 mm" in text and "print at 100 %" in text


@each_board
def test_at_least_one_square_around_the_board_is_white(written, board):
    page = pypdfium2.PdfDocument(written[board] / "board.pdf")[0]
    image = _rendered(page)
    corners = _found(board, image) / PIXELS_PER_MM
    lowest, highest = corners.min(0) - 1.9 * board.square, corners.max(0) + 1.9 * board.square
    (left, top), (right, bottom) = ((p * PIXELS_PER_MM).astype(int) for p in (lowest, highest))
    inside = image[top:bottom, left:right]
    margin = int(0.85 * board.square * PIXELS_PER_MM)
    assert min(left, top) >= 0 and right <= image.shape[1] and bottom <= image.shape[0]
    for edge in (inside[:margin], inside[-margin:], inside[:, :margin], inside[:, -margin:]):
        assert edge.min() == 255


def test_board_json(written):
    assert json.loads((written[CHESSBOARD] / "board.json").read_text()) == {
        "sl_board": 1, "kind": "chessboard", "corners": "9x7", "square_mm": 18.0,
    }  # fmt: skip
    assert json.loads((written[CHARUCO] / "board.json").read_text()) == {
        "sl_board": 1, "kind": "charuco", "squares": "12x8", "square_mm": 15.0, "marker_mm": 11.2,
        "dictionary": "5X5_1000", "legacy": False,
    }  # fmt: skip


def test_the_size_follows_from_the_width_and_the_command_says_it(tmp_path, capsys):
    _run("--output", tmp_path / "b", "--kind", "charuco", "--squares", "7x5", "--print-width", "170")
    said = capsys.readouterr().out
    words = shlex.split(said.strip().splitlines()[-1])
    assert words[:3] == ["sl-calibrate", "--images", "captures"]
    assert words[3:] == [
        "--board", "charuco", "--squares", "7x5", "--square", "24.2857 mm", "--marker", "18.2143 mm",
        "--dictionary", "5X5_1000", "--pattern", "pattern.json", "--output", "intrinsics.json",
    ]  # fmt: skip
    assert json.loads((tmp_path / "b" / "board.json").read_text())["square_mm"] == 24.2857
    assert "A4, on its side" in said


def test_boards_larger_than_paper_get_a_page_of_their_own(tmp_path, capsys):
    _run("--output", tmp_path / "b", "--kind", "chessboard", "--corners", "9x7", "--square", "12 cm")
    assert "a page of 1440 x 1218 mm" in capsys.readouterr().out
    with Image.open(tmp_path / "b" / "board.png") as picture:
        assert picture.size[0] * picture.size[1] < 41e6


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--kind", "chessboard"], "give either --print-width, the width of all 10 squares together"),
        (["--kind", "charuco", "--square", "1 mm", "--print-width", "9"], "the width of all 11 squares together"),
        (["--kind", "chessboard", "--square", "20"], '--square "20": is no length with a unit'),
        (["--kind", "chessboard", "--square", "20 mm", "--corners", "9"], '--corners "9": is no pair of numbers'),
        (["--kind", "chessboard", "--square", "2 mm", "--corners", "2x9"], "3 to 100 inner corners a side"),
        (["--kind", "charuco", "--square", "9 mm", "--marker", "9 mm"], "markers must be smaller than squares"),
        (["--kind", "charuco", "--square", "9 mm", "--dictionary", "5X5"], "there is no dictionary 5X5"),
        (["--kind", "chessboard", "--square", "9 m"], "too large for a page"),
        (["--kind", "chessboard", "--square", "1 um"], "too small to print"),
        (["--kind", "chessboard", "--square", "9 mm", "--marker", "8 mm"], "--marker: has no meaning for --kind chess"),
        (["--kind", "charuco", "--square", "9 mm", "--corners", "9x7"], "--corners: has no meaning for --kind charuco"),
    ],
)
def test_bad_boards(tmp_path, capsys, flags, message):
    with pytest.raises(SystemExit) as stop:
        _run("--output", tmp_path / "x", *flags)
    assert stop.value.code == 1 and message in capsys.readouterr().err and not (tmp_path / "x").exists()
