"""Kernels over the rows of the table: clear a gradient, and Adam for the rows that have one."""

import numpy as np

from sl_nerfstudio.model.kernels.grid import BLOCK
from sl_nerfstudio.model.kernels.simd import FEATURES, kernel

_SPAN = BLOCK * FEATURES


@kernel
def clear(gradient, marks, start, stop):
    """Zero the marked blocks `start .. stop` of a flat gradient, and their marks."""
    for block in range(start, stop):
        if marks[block]:
            marks[block] = 0
            for i in range(block * _SPAN, min((block + 1) * _SPAN, len(gradient))):
                gradient[i] = np.float32(0)


@kernel
def adam_rows(table, gradient, mean, square, steps, marks, start, stop, corrections, beta1, beta2, eps):
    """One step of Adam for every row of the marked blocks whose gradient is not exactly zero.

    `steps` counts the steps of each row; `corrections[t]` is [step size, 1 / sqrt(bias of square)] of step t.
    """
    last, one = len(corrections) - 1, np.float32(1)
    for block in range(start, stop):
        if not marks[block]:
            continue
        for row in range(block * BLOCK, min((block + 1) * BLOCK, len(steps))):
            at = row * FEATURES
            seen = False
            for i in range(at, at + FEATURES):
                seen |= gradient[i] != np.float32(0)
            if not seen:
                continue
            t = min(steps[row] + 1, last)
            steps[row] = t
            rate, root = corrections[t, 0], corrections[t, 1]
            for i in range(at, at + FEATURES):
                g = gradient[i]
                m = beta1 * mean[i] + (one - beta1) * g
                s = beta2 * square[i] + (one - beta2) * g * g
                mean[i], square[i] = m, s
                table[i] -= rate * m / (np.sqrt(s) * root + eps)
