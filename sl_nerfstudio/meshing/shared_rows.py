"""Compiled loop over vertices: how they move along their normals with poses and intrinsics.

A vertex moves by minus the weighted mean of its frames' pulls, each the product of a residual's slope and derivatives.
"""

import numpy as np

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.meshing.compiled_derivatives import SLOPE, VIEW, derive_residual, view_point


@compiled
def write_rows(vertices, first, last, frame, weight, place, frames, devices, points, normals, out):
    """Fill `out` (v, 12 frames + 6), which must be zero: by delta of some frames, their rho, and the intrinsics.

    `place` says which of those frames each frame is. Vertices have the pairs first to last of `frame` and `weight`.
    """
    view, by = np.empty(VIEW), np.empty((2, 18))
    for v in range(len(vertices)):
        point, normal, total = points[vertices[v]], normals[vertices[v]], 0.0
        for pair in range(first[v], last[v]):
            k, w = frame[pair], weight[pair]
            view_point(devices[k], point, normal, view)
            derive_residual(devices[k], point, normal, view, by)
            s, t = view[SLOPE], view[SLOPE + 1]
            total += w * (s * s + t * t)
            for i in range(6):
                out[v, 6 * place[k] + i] -= w * (s * by[0, i] + t * by[1, i])
                out[v, 6 * (frames + place[k]) + i] -= w * (s * by[0, 6 + i] + t * by[1, 6 + i])
                out[v, 12 * frames + i] -= w * (s * by[0, 12 + i] + t * by[1, 12 + i])
        for i in range(out.shape[1]):
            out[v, i] /= total
