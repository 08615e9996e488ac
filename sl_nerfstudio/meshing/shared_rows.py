"""Compiled loops over vertices: how they move along their normals with poses and intrinsics, and the variance of that.

A vertex moves by minus the weighted mean of its frames' pulls, each the product of a residual's slope and derivatives.
The unknowns are delta of all frames, then rho of all frames, then the intrinsics: blocks of six.
"""

import numpy as np

from sl_nerfstudio.compiled import compiled, compiled_range
from sl_nerfstudio.meshing.compiled_derivatives import SLOPE, VIEW, derive_residual, view_point


@compiled
def _collect(vertex, first, last, frame, weight, devices, points, normals, view, by, starts, entries):
    """Blocks of the row of one vertex: the first unknown of each block, and its six entries; the number of blocks."""
    frames, blocks, total = len(devices), 1, 0.0
    starts[0] = 12 * frames  # the intrinsics, of all its frames
    entries[0] = 0.0
    for pair in range(first, last):
        k, w = frame[pair], weight[pair]
        view_point(devices[k], points[vertex], normals[vertex], view)
        derive_residual(devices[k], points[vertex], normals[vertex], view, by)
        s, t = view[SLOPE], view[SLOPE + 1]
        total += w * (s * s + t * t)
        starts[blocks], starts[blocks + 1] = 6 * k, 6 * (frames + k)
        for i in range(6):
            entries[blocks, i] = -w * (s * by[0, i] + t * by[1, i])
            entries[blocks + 1, i] = -w * (s * by[0, 6 + i] + t * by[1, 6 + i])
            entries[0, i] -= w * (s * by[0, 12 + i] + t * by[1, 12 + i])
        blocks += 2
    entries[:blocks] /= total
    return blocks


@compiled_range
def write_rows(start, stop, vertices, first, last, frame, weight, devices, points, normals, out):
    """Rows `out` (v, joint), which must be zero, of vertices with the pairs first to last of `frame` and `weight`."""
    most = 2 * (last[start:stop] - first[start:stop]).max() + 1 if stop > start else 1
    view, by, starts, entries = np.empty(VIEW), np.empty((2, 18)), np.empty(most, np.int64), np.empty((most, 6))
    for v in range(start, stop):
        own = (vertices[v], first[v], last[v])
        blocks = _collect(*own, frame, weight, devices, points, normals, view, by, starts, entries)
        for b in range(blocks):
            out[v, starts[b] : starts[b] + 6] += entries[b]


@compiled_range
def add_variances(
    start, stop, vertices, first, last, frame, weight, devices, points, normals, rigid, matrix, shared, of_motion, out
):
    """Variances `out` of the rows s - rigid m of vertices, with shared = matrix m^T and of_motion = m matrix m^T."""
    most = 2 * (last[start:stop] - first[start:stop]).max() + 1 if stop > start else 1
    view, by, starts, entries = np.empty(VIEW), np.empty((2, 18)), np.empty(most, np.int64), np.empty((most, 6))
    for v in range(start, stop):
        own = (vertices[v], first[v], last[v])
        blocks = _collect(*own, frame, weight, devices, points, normals, view, by, starts, entries)
        r, variance = rigid[vertices[v]], 0.0
        for b in range(blocks):
            row = starts[b]
            for i in range(6):
                inner = 0.0
                for c in range(b):
                    column = starts[c]
                    for j in range(6):
                        inner += matrix[row + i, column + j] * entries[c, j]
                own_block, motion = 0.0, 0.0
                for j in range(6):
                    own_block += matrix[row + i, row + j] * entries[b, j]
                    motion += shared[row + i, j] * r[j]
                variance += entries[b, i] * (2 * (inner - motion) + own_block)
        for i in range(6):
            for j in range(6):
                variance += r[i] * of_motion[i, j] * r[j]
        out[vertices[v]] = variance
