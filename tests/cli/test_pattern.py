"""sl-pattern: patterns are complete, and an independent PDF reader finds boards in their stated size."""

import json
import re

import cv2
import numpy as np
import pypdfium2
import pytest
from PIL import Image

from sl_nerfstudio.cli.pattern import main, margin_warning
from sl_nerfstudio.pattern.boards import CharucoBoard, Chessboard
from sl_nerfstudio.pattern.files import PRESETS, make_grid, read_layout
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import read_image

from .snapshots import Ended, expect, expect_refusals, succeed


def pattern(*flags: object) -> Ended:
    return succeed(main, "sl-pattern", *flags)


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_presets_tell_places_apart_whatever_the_roll_of_the_camera(preset):
    grid = make_grid(preset)
    assert (grid.w, grid.h, grid.period) == PRESETS[preset] and grid.margins == (3, 2)


def test_a_folder_with_a_grid(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    said = pattern("--output", "müster", "--preset", "doe").out
    grid, image = read_layout(tmp_path / "müster/pattern.json"), read_image(tmp_path / "müster/pattern.png")
    assert (grid.w, grid.h, grid.period) == PRESETS["doe"] and image.shape == (grid.h, grid.w)
    assert np.abs(image / 255 - grid.render(4)).max() < 0.5 / 255 + 1e-6  # the description alone gives the same picture
    said += pattern("--output", "g", "--kind", "gray-code", "--width", 32, "--height", 24, "--cell", 2).out
    layout = read_layout(tmp_path / "g/pattern.json")
    assert layout == GrayCode(32, 24, 2)
    shown = [read_image(path) for path in sorted((tmp_path / "g/sequence").iterdir())]
    assert all(np.array_equal(a, b) for a, b in zip(shown, layout.sequence(), strict=True))
    said += pattern("--output", "b", "--kind", "charuco", "--squares", "7x5", "--print-width", "170").out
    assert json.loads((tmp_path / "b/board.json").read_text())["square_mm"] == 24.2857
    said += pattern("--output", "c", "--kind", "chessboard", "--corners", "9x7", "--square", "12 cm").out
    with Image.open(tmp_path / "c/board.png") as picture:  # larger than any paper: a page of its own
        assert picture.size[0] * picture.size[1] < 41e6
    expect("sl-pattern", "run", said)


@pytest.mark.slow
def test_too_many_nodes_are_warned_of_and_the_remedy_helps(tmp_path):
    """Where (3, 2) cannot be had, the roll of the camera counts before the second misread symbol."""
    flags = ["--width", 355, "--height", 200]
    said = pattern("--output", tmp_path / "a", *flags, "--period", 5).out
    assert "at least 2 of 9 symbols, in 2 where" in said and "warning: " in said
    period = re.search(r"--period (\d+) or more", said)[1]
    said = pattern("--output", tmp_path / "b", *flags, "--period", period).out
    assert "at least 3 of 9 symbols, in 2 where" in said and "warning" not in said
    grid = GridPattern(w=1920, h=1080, period=20.0, codes=np.zeros((54, 96), dtype=np.int8))
    assert "--period 30 or more, as --preset 1920x1080 does" in margin_warning(grid)


def test_flags_override_the_preset(tmp_path):
    numbers = ("--width", 320, "--height", 200, "--period", 16, "--line-width", 3, "--gap", 5, "--seed", 4)
    pattern("--output", tmp_path / "p", *numbers, "--print-width", 80)
    grid = read_layout(tmp_path / "p/pattern.json")
    assert (grid.w, grid.h, grid.period, grid.line_width, grid.gap, grid.seed) == (320, 200, 16, 3, 5, 4)
    with Image.open(tmp_path / "p/pattern.png") as image:
        assert image.info["dpi"][0] == pytest.approx(320 / 80 * 25.4, rel=1e-3)


CHESS, CHARUCO_KIND, SIDE = ["--kind", "chessboard"], ["--kind", "charuco"], ["--square", "9 mm"]


def test_flags_that_cannot_be_are_named_and_nothing_is_written(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    expect_refusals(
        main, "sl-pattern", ["--output", "x"],
        ["--period", "0"], ["--line-width", "25"], ["--gap", "19"], ["--width", "30"], ["--width", "100000"],
        ["--seed", "-1"], ["--print-width", "0"], ["--kind", "gray-code", "--gap", "3"], ["--cell", "3"],
        ["--square", "3 mm"], ["--kind", "gray-code", "--cell", "0"],
        CHESS, [*CHARUCO_KIND, "--square", "1 mm", "--print-width", "9"], [*CHESS, "--square", "20"],
        [*CHESS, "--square", "20 mm", "--corners", "9"], [*CHESS, "--square", "2 mm", "--corners", "2x9"],
        [*CHARUCO_KIND, *SIDE, "--marker", "9 mm"], [*CHARUCO_KIND, *SIDE, "--dictionary", "5X5"],
        [*CHESS, "--square", "9 m"], [*CHESS, "--square", "1 um"], [*CHESS, *SIDE, "--marker", "8 mm"],
        [*CHARUCO_KIND, *SIDE, "--corners", "9x7"],
    )  # fmt: skip
    assert not list(tmp_path.iterdir())


# Boards.

PIXELS_PER_MM = 8
CHESSBOARD = Chessboard(9, 7, 18.0)
CHARUCO = CharucoBoard(12, 8, 15.0, 11.2, "5X5_1000")
FLAGS = {
    CHESSBOARD: [*CHESS, "--corners", "9x7", "--square", "18 mm"],
    CHARUCO: [*CHARUCO_KIND, "--squares", "12x8", "--print-width", "180", "--marker", "1.12 cm"],
}
each_board = pytest.mark.parametrize("board", FLAGS, ids=["chessboard", "charuco"])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folders = {board: tmp_path_factory.mktemp("boards") / str(k) for k, board in enumerate(FLAGS)}
    for board, folder in folders.items():
        pattern("--output", folder, *FLAGS[board])
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
    assert np.abs((found_mm * true).sum(0) / (true * true).sum(0) - 1).max() < 1e-4  # stretched


@each_board
def test_pdf_and_png_have_the_stated_size_and_a_white_border_of_a_square(written, board):
    page = pypdfium2.PdfDocument(written[board] / "board.pdf")[0]
    w, h = (points * 25.4 / 72 for points in page.get_size())
    assert (round(w, 2), round(h, 2)) == (297, 210)
    image = _rendered(page)
    corners = _found(board, image)
    _agree(board, corners * [w, h] / image.shape[::-1])  # the reader rounds up to whole pixels, and stretches the page
    assert not list(page.get_objects(filter=[pypdfium2.raw.FPDF_PAGEOBJ_IMAGE]))  # vectors alone
    side = board.square * PIXELS_PER_MM
    (left, top), (right, bottom) = (corners.min(0) - 1.9 * side).astype(int), (corners.max(0) + 1.9 * side).astype(int)
    inside, margin = image[top:bottom, left:right], int(0.85 * side)
    assert min(left, top) >= 0 and right <= image.shape[1] and bottom <= image.shape[0]
    assert all(e.min() == 255 for e in (inside[:margin], inside[-margin:], inside[:, :margin], inside[:, -margin:]))
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


@pytest.mark.parametrize(
    ("board", "what", "fields"),
    [
        (CHESSBOARD, "9 x 7 inner corners, squares 18 mm", {"kind": "chessboard", "corners": "9x7", "square_mm": 18.0}),
        (
            CHARUCO,
            "12 x 8 squares of 15 mm, markers 11.2 mm, dictionary 5X5_1000",
            {"kind": "charuco", "squares": "12x8", "square_mm": 15.0, "marker_mm": 11.2, "dictionary": "5X5_1000",
             "legacy": False},
        ),
    ],
)  # fmt: skip
def test_page_and_json_say_what_the_board_is(written, board, what, fields):
    text = pypdfium2.PdfDocument(written[board] / "board.pdf")[0].get_textpage().get_text_range()
    assert what in text and "100 mm" in text and "print at 100 %" in text
    assert json.loads((written[board] / "board.json").read_text()) == {"sl_board": 1, **fields}
