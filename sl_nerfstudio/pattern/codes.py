"""Code arrays: a grid of symbols in which every small window occurs only once.

Symbols:

    0  no gap
    1  gap in the horizontal line, left side higher       2  ... right side higher
    3  gap in the vertical line, upper side further right 4  ... upper side further left

Turning the pattern by 90 degrees exchanges 1 with 3 and 2 with 4; turning it by 180 degrees changes no symbol. So
windows can be compared for every roll of the camera, in quarter turns.
"""

import numpy as np
from jaxtyping import Float32, Int
from numpy import ndarray

from sl_nerfstudio.parallel import compiled

SYMBOLS = 5
WINDOW = 3

# Local search for code arrays whose 3x3 windows keep a minimum Hamming distance.
#
# Two tables count, for each of the 5^9 possible windows, how often it occurs upright and how often in the pattern
# turned by 90, 180 or 270 degrees. The conflicts of a window are the occurrences in the Hamming balls around it.
# Cells of windows with conflicts get the symbol that leaves the fewest conflicts (min-conflicts heuristic). Constants
# that are passed on are `np.int64(1)` rather than 1: for each such constant, numba would compile the called function
# anew.

_CELLS = WINDOW**2
_MOVES_PER_CELL = 3  # after that a margin counts as unreachable
_RANDOM_MOVES = 0.1


@compiled
def _count(tables: ndarray, codes: ndarray, row: int, column: int, amount: int) -> None:
    """Count (or uncount) the window at (row, column): upright in one table, its turned versions in the other."""
    turn = (0, 3, 4, 1, 2)
    a = b = c = d = 0
    for i in range(3):
        for j in range(3):
            a = a * 5 + codes[row + i, column + j]
            b = b * 5 + turn[codes[row + 2 - j, column + i]]
            c = c * 5 + codes[row + 2 - i, column + 2 - j]
            d = d * 5 + turn[codes[row + j, column + 2 - i]]
    tables[0, a] += amount
    tables[1, b] += amount
    tables[1, c] += amount
    tables[1, d] += amount


@compiled
def _in_ball(table: ndarray, key: int, change: ndarray, radius: int) -> int:
    """Sum of the table over the Hamming ball around `key`; `change[k, s]` alters cell k."""
    if radius < 0:
        return 0
    total = table[key]
    if radius >= 1:
        for k in range(_CELLS):
            for s in range(SYMBOLS - 1):
                near = key + change[k, s]
                total += table[near]
                if radius >= 2:
                    for m in range(k + 1, _CELLS):
                        for r in range(SYMBOLS - 1):
                            total += table[near + change[m, r]]
    return total


@compiled
def _conflicts(tables: ndarray, codes: ndarray, row: int, column: int, radius: int, turned_radius: int) -> int:
    """Occurrences near the window at (row, column), not counting the window itself."""
    change = np.empty((_CELLS, SYMBOLS - 1), dtype=np.int64)
    key, power = np.int64(0), np.int64(1)
    for cell in range(_CELLS - 1, -1, -1):
        digit = codes[row + cell // 3, column + cell % 3]
        key += digit * power
        for s in range(SYMBOLS - 1):
            change[cell, s] = ((digit + s + 1) % SYMBOLS - digit) * power
        power *= SYMBOLS
    return _in_ball(tables[0], key, change, radius) - 1 + _in_ball(tables[1], key, change, turned_radius)


@compiled
def _search(codes: ndarray, radius: int, turned_radius: int, seed: int, moves: int) -> bool:
    """Change `codes` in place until its 3x3 windows are far enough apart; False if that fails in so many moves.

    No two are within `radius` cells (up to 2) of each other, and none within `turned_radius` (-1: any is allowed) of
    a window of the pattern turned by 90, 180 or 270 degrees.
    """
    np.random.seed(seed)
    rows, columns = codes.shape[0] - 2, codes.shape[1] - 2
    tables = np.zeros((2, SYMBOLS**_CELLS), dtype=np.int32)
    for row in range(rows):
        for column in range(columns):
            _count(tables, codes, row, column, np.int64(1))
    clean, place = 0, 0
    while clean < rows * columns:
        if _conflicts(tables, codes, place // columns, place % columns, radius, turned_radius) == 0:
            clean += 1
            place = (place + 1) % (rows * columns)
            continue
        clean = 0
        moves -= 1
        if moves < 0:
            return False
        _best_change(tables, codes, place // columns, place % columns, radius, turned_radius)
    return True


@compiled
def _best_change(tables: ndarray, codes: ndarray, row: int, column: int, radius: int, turned_radius: int) -> None:
    """Re-sample the one cell of a window that leaves the fewest conflicts in all windows around that cell."""
    best_cell, best_symbol, best_cost = np.random.randint(_CELLS), np.random.randint(SYMBOLS), np.int64(2**30)
    start = np.random.randint(_CELLS * SYMBOLS)
    if np.random.random() < _RANDOM_MOVES:  # escapes from cycles
        _replace(tables, codes, row + best_cell // 3, column + best_cell % 3, best_symbol)
        return
    for step in range(_CELLS * SYMBOLS):
        choice = (start + step) % (_CELLS * SYMBOLS)
        cell, symbol = choice // SYMBOLS, choice % SYMBOLS
        i, j = row + cell // 3, column + cell % 3
        old = np.int64(codes[i, j])
        if symbol == old:
            continue
        _replace(tables, codes, i, j, symbol)
        cost = _cost(tables, codes, i, j, radius, turned_radius, best_cost)
        _replace(tables, codes, i, j, old)
        if cost < best_cost:
            best_cell, best_symbol, best_cost = cell, symbol, cost
    _replace(tables, codes, row + best_cell // 3, column + best_cell % 3, best_symbol)


@compiled
def _cost(tables: ndarray, codes: ndarray, i: int, j: int, radius: int, turned_radius: int, limit: int) -> int:
    """Conflicts of the windows that hold cell (i, j); counting stops at `limit`."""
    cost = 0
    for row in range(max(i - 2, 0), min(i, codes.shape[0] - 3) + 1):
        for column in range(max(j - 2, 0), min(j, codes.shape[1] - 3) + 1):
            cost += _conflicts(tables, codes, row, column, radius, turned_radius)
            if cost >= limit:
                return limit
    return cost


@compiled
def _replace(tables: ndarray, codes: ndarray, i: int, j: int, symbol: int) -> None:
    for amount in (-1, 1):
        for row in range(max(i - 2, 0), min(i, codes.shape[0] - 3) + 1):
            for column in range(max(j - 2, 0), min(j, codes.shape[1] - 3) + 1):
                _count(tables, codes, row, column, amount)
        codes[i, j] = symbol


FULL_MARGINS = (3, 2)  # upright one misread cell of nine can be corrected; turned, one is noticed
_BLOCK = 512  # windows compared with all others at a time
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


def windows(codes: Int[ndarray, "rows columns"]) -> Int[ndarray, "n cells"]:
    """All 3 x 3 windows, row by row, each flattened row by row."""
    view = np.lib.stride_tricks.sliding_window_view(codes, (WINDOW, WINDOW))
    return view.reshape(-1, WINDOW * WINDOW)


def hamming_margins(codes: Int[ndarray, "rows columns"]) -> tuple[int, int]:
    """Smallest number of cells in which two different windows differ: upright, and where the camera may roll.

    For the second, windows are also compared with all windows (themselves included) of the pattern turned by 90, 180
    and 270 degrees.
    """
    plain = windows(codes)
    cells = plain.reshape(-1, WINDOW, WINDOW)
    upright, *turned = (
        _most_alike(plain, rotate_codes(cells, turns).reshape(plain.shape), turns > 0) for turns in range(4)
    )
    return WINDOW**2 - upright, WINDOW**2 - max(upright, *turned)


def _most_alike(a: Int[ndarray, "n cells"], b: Int[ndarray, "m cells"], with_itself: bool) -> int:
    """Largest number of equal cells of a window of `a` and one of `b`; `with_itself`: also of the same index."""
    most = 0
    there = _one_hot(b).T
    for start in range(0, len(a), _BLOCK):  # all pairs at once would take gigabytes
        alike = _one_hot(a[start : start + _BLOCK]) @ there
        if not with_itself:
            np.fill_diagonal(alike[:, start:], 0)
        most = max(most, int(alike.max()))
    return most


def _one_hot(plain: Int[ndarray, "n cells"]) -> Float32[ndarray, "n symbols"]:
    return (plain[..., None] == np.arange(SYMBOLS)).reshape(len(plain), -1).astype(np.float32)


def code_array(
    rows: int, columns: int, seed: int = 0, margin: int = FULL_MARGINS[0], turned_margin: int = FULL_MARGINS[1]
) -> Int[ndarray, "rows columns"]:
    """Random symbols whose 3x3 windows differ in `margin` cells, or `turned_margin` when one of the two is turned.

    Starts from random symbols and re-samples cells of windows that are too similar to others. If an array of this size
    cannot reach the margins, lower ones are tried; `hamming_margins` measures what was reached (3 and 2 up to about
    64 x 36 cells: in an upright window, one misread cell of nine can be corrected).
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
    attempts = [a for a in _attempts(*FULL_MARGINS) if a[0] <= margin and a[1] <= turned_margin]
    for now, turned in attempts or [(1, 0)]:
        generated = _attempt(codes.shape[0], codes.shape[1], seed, now, turned)
        if generated is not None and np.array_equal(codes, generated):
            return True
    return False


def _attempts(margin: int, turned_margin: int) -> list[tuple[int, int]]:
    """Pairs of margins to try, the last of which any array has.

    The smaller one of a pair counts first: a camera that rolls needs both.
    """
    pairs = [(now, turned) for now in range(1, margin + 1) for turned in range(min(now, turned_margin) + 1)]
    return sorted(pairs, key=lambda pair: (min(pair), sum(pair)), reverse=True)


def _attempt(rows: int, columns: int, seed: int, margin: int, turned_margin: int) -> Int[ndarray, "r c"] | None:
    """The array of this seed and these margins; None if they could not be reached."""
    rng = np.random.default_rng([seed, margin, turned_margin])
    codes = rng.integers(0, SYMBOLS, (rows, columns)).astype(np.int8)
    hopeless = margin <= 1 and turned_margin <= 0
    if min(rows, columns) < WINDOW or hopeless:
        return codes
    seed = int(rng.integers(2**31))
    return codes if _search(codes, margin - 1, turned_margin - 1, seed, _MOVES_PER_CELL * codes.size) else None
