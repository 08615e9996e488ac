"""Code arrays: a grid of symbols in which every small window occurs only once.

Symbols:

    0  no gap
    1  gap in the horizontal line, left side higher       2  ... right side higher
    3  gap in the vertical line, upper side further right 4  ... upper side further left

Turning the pattern by 90 degrees exchanges 1 with 3 and 2 with 4; turning it by 180 degrees changes no symbol. So
windows can be compared for every roll of the camera, in quarter turns.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float32, Int
from numpy import ndarray

from sl_nerfstudio.pattern.code_search import resolve_conflicts

SYMBOLS = 5
WINDOW = 3
SYMBOL_NAMES = (
    "no gap",
    "horizontal line: left side higher",
    "horizontal line: right side higher",
    "vertical line: upper side further right",
    "vertical line: upper side further left",
)
_QUARTER_TURN = np.array([0, 3, 4, 1, 2], dtype=np.int8)


def rotate_codes(codes: Int[ndarray, "*batch rows columns"], quarter_turns: int) -> Int[ndarray, "*batch r c"]:
    """The code array as seen when the pattern is turned clockwise by `quarter_turns` times 90 degrees."""
    turned = np.rot90(codes, -quarter_turns, axes=(-2, -1))
    return _QUARTER_TURN[turned] if quarter_turns % 2 else np.ascontiguousarray(turned)


def windows(codes: Int[ndarray, "rows columns"], size: int = WINDOW) -> Int[ndarray, "n cells"]:
    """All `size` x `size` windows, row by row, each flattened row by row."""
    view = np.lib.stride_tricks.sliding_window_view(codes, (size, size))
    return view.reshape(-1, size * size)


def hamming_margin(codes: Int[ndarray, "rows columns"], rotations: bool = True, size: int = WINDOW) -> int:
    """Smallest number of cells in which two different windows differ.

    With `rotations`, windows are also compared with all windows (themselves included) of the pattern turned by 90, 180
    and 270 degrees, as a camera with unknown roll sees them.
    """
    plain = windows(codes, size)
    most_alike = 0
    for turns in range(4 if rotations else 1):
        alike = _one_hot(plain) @ _one_hot(windows_turned(plain, turns, size)).T  # cells in which two windows agree
        if turns == 0:
            np.fill_diagonal(alike, 0)
        most_alike = max(most_alike, int(alike.max()))
    return size * size - most_alike


def _one_hot(plain: Int[ndarray, "n cells"]) -> Float32[ndarray, "n symbols"]:
    return (plain[..., None] == np.arange(SYMBOLS)).reshape(len(plain), -1).astype(np.float32)


def windows_turned(plain: Int[ndarray, "n cells"], quarter_turns: int, size: int = WINDOW) -> Int[ndarray, "n cells"]:
    """Flattened windows, each turned clockwise about its own centre."""
    return rotate_codes(plain.reshape(-1, size, size), quarter_turns).reshape(len(plain), size * size)


def code_array(
    rows: int, columns: int, seed: int = 0, margin: int = 3, turned_margin: int = 2
) -> Int[ndarray, "rows columns"]:
    """Random symbols whose 3x3 windows differ in `margin` cells, or `turned_margin` when one of the two is turned.

    Starts from random symbols and re-samples cells of windows that are too similar to others. If an array of this size
    cannot reach the margins, lower ones are tried; `hamming_margin` measures what was reached (3 and 2 for 40 x 40
    cells: in an upright window, one misread cell of nine can be corrected).
    """
    for now, turned in _attempts(margin, turned_margin):
        codes = _attempt(rows, columns, seed, now, turned)
        if codes is not None:
            return codes
    raise ValueError("unreachable: the last attempt cannot fail")


def is_generated(codes: Int[ndarray, "rows columns"], seed: int, margin: int, turned_margin: int) -> bool:
    """Whether `codes` are a `code_array` of this seed that reached `margin` and `turned_margin` or less.

    Margins that were not reached are not tried again, which takes much of the time of `code_array`.
    """
    attempts = [a for a in _attempts(3, 2) if a[0] <= margin and a[1] <= turned_margin]
    for now, turned in attempts or [(1, 0)]:
        generated = _attempt(codes.shape[0], codes.shape[1], seed, now, turned)
        if generated is not None and np.array_equal(codes, generated):
            return True
    return False


def _attempts(margin: int, turned_margin: int) -> Iterator[tuple[int, int]]:
    """Pairs of margins to try, the last of which any array has."""
    yield margin, turned_margin
    while margin > 1 or turned_margin > 0:
        turned_margin, margin = (turned_margin - 1, margin) if turned_margin > 0 else (turned_margin, margin - 1)
        yield margin, turned_margin


def _attempt(rows: int, columns: int, seed: int, margin: int, turned_margin: int) -> Int[ndarray, "r c"] | None:
    """The array of this seed and these margins; None if they could not be reached."""
    rng = np.random.default_rng([seed, margin, turned_margin])
    codes = rng.integers(0, SYMBOLS, (rows, columns)).astype(np.int8)
    hopeless = margin <= 1 and turned_margin <= 0
    if min(rows, columns) < WINDOW or hopeless:
        return codes
    return codes if resolve_conflicts(codes, margin, turned_margin, int(rng.integers(2**31))) else None
