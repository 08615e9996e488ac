"""Code arrays: every 3x3 window occurs only once, and differs enough from all others."""

import itertools

import numpy as np
import pytest

from sl_nerfstudio.pattern.codes import code_array, hamming_margins, is_generated, rotate_codes, windows

_AFTER_A_QUARTER_TURN = {0: 0, 1: 3, 2: 4, 3: 1, 4: 2}


def _turned_once(window):
    """Clockwise: what was in the left column, from bottom to top, becomes the upper row."""
    rows, columns = len(window), len(window[0])
    return [[_AFTER_A_QUARTER_TURN[window[rows - 1 - j][i]] for j in range(rows)] for i in range(columns)]


def _smallest_distances(codes):
    """Upright and turned margins by comparing all pairs, in plain Python."""
    rows, columns = codes.shape
    all_windows = [codes[i : i + 3, j : j + 3].tolist() for i in range(rows - 2) for j in range(columns - 2)]
    turned = []
    for window in all_windows:
        for _ in range(3):
            window = _turned_once(window)
            turned.append(window)
    flat = [list(itertools.chain(*w)) for w in all_windows]
    flat_turned = [list(itertools.chain(*w)) for w in turned]

    def distance(a, b):
        return sum(x != y for x, y in zip(a, b, strict=True))

    upright = min(distance(a, b) for a, b in itertools.combinations(flat, 2))
    return upright, min(upright, min(distance(a, b) for a in flat for b in flat_turned))


@pytest.mark.parametrize("codes", [code_array(11, 9, 5), np.random.default_rng(0).integers(0, 2, (9, 9), np.int8)])
def test_margins_agree_with_a_comparison_of_all_pairs(codes):
    assert _smallest_distances(codes) == hamming_margins(codes)


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_the_default_size_corrects_one_misread_cell_with_about_as_many_of_each_symbol(seed):
    codes = code_array(40, 40, seed)
    share = np.bincount(codes.ravel(), minlength=5) / 1600
    assert codes.shape == (40, 40) and share.min() > 0.16 and share.max() < 0.24
    assert hamming_margins(codes) == (3, 2)
    assert not np.array_equal(codes, code_array(40, 40, seed + 1))


def test_an_array_too_large_for_the_margin_gets_a_lower_one():
    assert hamming_margins(code_array(12, 12, margin=3, turned_margin=3))[0] == 3


def test_arrays_of_older_files_are_recognised():
    """They had been made with other margins first, and say which they reached."""
    codes = code_array(20, 24, 5, margin=3, turned_margin=0)
    assert hamming_margins(codes)[0] == 3 and is_generated(codes, 5, 3, hamming_margins(codes)[1])
    assert not is_generated(codes, 6, 3, hamming_margins(codes)[1])


def test_margins_of_arrays_with_more_windows_than_are_compared_at_a_time():
    codes = code_array(40, 60, 0, margin=2, turned_margin=2)
    assert hamming_margins(codes) == (2, 2)
    codes[35:38, 5:8] = codes[10:13, 40:43]
    assert hamming_margins(codes) == (0, 0)
    codes[36, 6] = (codes[36, 6] + 1) % 5
    assert len(np.unique(windows(codes), axis=0)) == len(windows(codes)) and hamming_margins(codes)[0] == 1


def test_windows_are_listed_row_by_row_and_quarter_turns_exchange_symbols():
    codes = code_array(4, 5)
    assert windows(codes).shape == (6, 9) and windows(codes)[4].tolist() == codes[1:4, 1:4].ravel().tolist()
    assert rotate_codes(codes, 1).tolist() == _turned_once(codes.tolist())
    assert np.array_equal(rotate_codes(rotate_codes(codes, 1), 3), codes)
    assert code_array(2, 7).shape == (2, 7)  # smaller than a window
