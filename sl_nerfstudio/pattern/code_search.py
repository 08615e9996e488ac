"""Local search for code arrays whose 3x3 windows keep a minimum Hamming distance.

Two tables count, for each of the 5^9 possible windows, how often it occurs upright and how often in the pattern turned
by 90, 180 or 270 degrees. The conflicts of a window are the occurrences in the Hamming balls around it. Cells of
windows with conflicts get the symbol that leaves the fewest conflicts (min-conflicts heuristic). Constants that are
passed on are `np.int64(1)` rather than 1: for each such constant, numba would compile the called function anew.
"""

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from sl_nerfstudio.compiled import compiled

_SYMBOLS, _CELLS = 5, 9
_MOVES_PER_CELL = 3  # after that a margin counts as unreachable
_RANDOM_MOVES = 0.1


def resolve_conflicts(codes: Int[ndarray, "rows columns"], margin: int, turned_margin: int, seed: int) -> bool:
    """Change `codes` in place until its 3x3 windows are far enough apart; False if that fails.

    Any two differ in at least `margin` cells (1 to 3), and each differs in at least `turned_margin` cells
    (0 to 3) from all windows of the pattern turned by 90, 180 or 270 degrees.
    """
    return bool(_search(codes, margin - 1, turned_margin - 1, seed, _MOVES_PER_CELL * codes.size))


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
            for s in range(_SYMBOLS - 1):
                near = key + change[k, s]
                total += table[near]
                if radius >= 2:
                    for m in range(k + 1, _CELLS):
                        for r in range(_SYMBOLS - 1):
                            total += table[near + change[m, r]]
    return total


@compiled
def _conflicts(tables: ndarray, codes: ndarray, row: int, column: int, radius: int, turned_radius: int) -> int:
    """Occurrences near the window at (row, column), not counting the window itself."""
    change = np.empty((_CELLS, _SYMBOLS - 1), dtype=np.int64)
    key, power = np.int64(0), np.int64(1)
    for cell in range(_CELLS - 1, -1, -1):
        digit = codes[row + cell // 3, column + cell % 3]
        key += digit * power
        for s in range(_SYMBOLS - 1):
            change[cell, s] = ((digit + s + 1) % _SYMBOLS - digit) * power
        power *= _SYMBOLS
    return _in_ball(tables[0], key, change, radius) - 1 + _in_ball(tables[1], key, change, turned_radius)


@compiled
def _search(codes: ndarray, radius: int, turned_radius: int, seed: int, moves: int) -> bool:
    np.random.seed(seed)
    rows, columns = codes.shape[0] - 2, codes.shape[1] - 2
    tables = np.zeros((2, _SYMBOLS**_CELLS), dtype=np.int32)
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
    best_cell, best_symbol, best_cost = np.random.randint(_CELLS), np.random.randint(_SYMBOLS), np.int64(2**30)
    start = np.random.randint(_CELLS * _SYMBOLS)
    if np.random.random() < _RANDOM_MOVES:  # escapes from cycles
        _replace(tables, codes, row + best_cell // 3, column + best_cell % 3, best_symbol)
        return
    for step in range(_CELLS * _SYMBOLS):
        choice = (start + step) % (_CELLS * _SYMBOLS)
        cell, symbol = choice // _SYMBOLS, choice % _SYMBOLS
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
