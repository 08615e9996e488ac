"""Kernels over the marked rows of the table: clear a gradient, and Adam.

A batch of points marks a small part of the rows, scattered throughout the table. Most of the time is spent waiting for
memory, so the marked rows are listed first and prefetched before they are used.
"""

import numpy as np

from sl_nerfstudio.field.kernels.simd import FEATURES, kernel, part, prefetch

LIST = 1024
"""Rows listed at a time."""
_AHEAD = 12
_ONE, _ZERO = np.float32(1), np.float32(0)


@part
def list_marked(marks, start, stop, rows):
    """List and clear marks, from `start` on, until `rows` is full; returns the number of rows and where to continue."""
    words, n, row = marks.view(np.int64), 0, start
    while row < stop and n <= len(rows) - 8:
        if words[row // 8] != 0:
            for i in range(row, min(row + 8, stop)):
                if marks[i]:
                    marks[i] = 0
                    rows[n] = i
                    n += 1
        row += 8
    return n, row


@kernel
def clear(gradient, marks, start, stop, rows):
    """Zero the marked rows in `start .. stop` of a flat gradient, and their marks; `start` is a multiple of 8."""
    while start < stop:
        n, start = list_marked(marks, start, stop, rows)
        for k in range(n):
            if k + _AHEAD < n:
                prefetch(gradient, (rows[k + _AHEAD] * FEATURES,))
            for i in range(FEATURES):
                gradient[rows[k] * FEATURES + i] = _ZERO


@part
def list_any(marks, start, stop, rows):
    """As `list_marked`, of rows that any process marked (processes, marks), which are then marked in all of them."""
    words, n, row = marks.view(np.int64), 0, start
    while row < stop and n <= len(rows) - 8:
        together = words[0, row // 8]
        for k in range(1, len(words)):
            together |= words[k, row // 8]
        if together != 0:
            for k in range(len(words)):
                words[k, row // 8] = together
            for i in range(row, min(row + 8, stop)):
                if marks[0, i]:
                    rows[n] = i
                    n += 1
        row += 8
    return n, row


@kernel
def average(gradients, marks, start, stop, rows, own, count):
    """Mean over processes of the rows in `start .. stop` that any of them marked, for all of them; marks become equal.

    `gradients` [process, row * 8], `marks` [process, row]. Every `count`-th stretch of LIST rows, from number `own` on,
    is done; `start` is at a multiple of LIST * count.
    """
    processes, share = len(gradients), _ONE / np.float32(len(gradients))
    first = start + own * LIST
    while first < stop:
        end = min(first + LIST, stop)
        row = first
        while row < end:
            n, row = list_any(marks, row, end, rows)
            for k in range(n):
                if k + _AHEAD < n:
                    for p in range(processes):
                        prefetch(gradients[p], (rows[k + _AHEAD] * FEATURES,))
                at = rows[k] * FEATURES
                for i in range(at, at + FEATURES):
                    total = gradients[0, i]
                    for p in range(1, processes):
                        total += gradients[p, i]
                    total *= share
                    for p in range(processes):
                        gradients[p, i] = total
        first += count * LIST


@kernel
def adam(table, gradient, moments, steps, marks, start, stop, rows, corrections, lr, beta1, beta2, eps):
    """One step of Adam for every marked row whose gradient is not exactly zero; clears the gradient and the marks.

    `moments` [row, 2, 8], flat: mean and mean square of the gradient. `steps` counts the steps of each row, and
    `corrections[t]` holds the factors of step t's mean and of the root of its mean square.
    """
    last = len(corrections) - 1
    while start < stop:
        n, start = list_marked(marks, start, stop, rows)
        for k in range(n):
            if k + _AHEAD < n:
                at = rows[k + _AHEAD] * FEATURES
                prefetch(gradient, (at,))
                prefetch(table, (at,))
                prefetch(moments, (2 * at,))
            row = rows[k]
            at = row * FEATURES
            seen = False
            for i in range(at, at + FEATURES):
                seen |= gradient[i] != _ZERO
            if not seen:
                continue
            t = min(np.int64(steps[row]) + 1, last)
            steps[row] = t
            rate, root = lr * corrections[t, 0], corrections[t, 1]
            for i in range(FEATURES):
                g = gradient[at + i]
                m = beta1 * moments[2 * at + i] + (_ONE - beta1) * g
                s = beta2 * moments[2 * at + FEATURES + i] + (_ONE - beta2) * g * g
                moments[2 * at + i], moments[2 * at + FEATURES + i] = m, s
                table[at + i] -= rate * m / (np.sqrt(s) * root + eps)
                gradient[at + i] = _ZERO
