"""The compiled loops of `surface_agreement`.

Most of the time that registration takes is spent here. So each step does one thing for all points, without branches
that a processor would have to guess: they are mapped (several at once), then looked up, then compared, then summed up;
of those that are still of interest, the numbers are kept.
"""

import numpy as np

from sl_nerfstudio.compiled import compiled, compiled_range, compiled_sums
from sl_nerfstudio.geometry.devices.models import pixel_of
from sl_nerfstudio.geometry.robust import geman_mcclure_cost, geman_mcclure_weight

_kernel_weight = compiled(geman_mcclure_weight)
_kernel_cost = compiled(geman_mcclure_cost)


@compiled_range
def agreement_sums(
    first, last, points, sigma, scale, R, t, reverse, plane, valid, code, camera, c, tolerances, least_facing, cutoff,
    empty, light, least_lit, H, g, counts
):  # fmt: skip
    """Adds to H, g and counts (agreeing, in front, behind, squares, cost, absent); `reverse`: points are the target's.

    `points` are (6, n): points and normals. For every similarity, they are compared with the other frame's surface.
    """
    h, w = valid.shape
    n = points.shape[1]
    mapped, place, some, rows = np.empty((6, n)), np.empty(n), np.empty(n, np.int64), np.empty((9, n))
    flat_plane, flat_valid = plane.reshape(h * w, 5), valid.reshape(h * w)
    M, shift, turn = np.empty((3, 3)), np.empty(3), np.eye(3)
    for k in range(first, last):
        s = scale[k]
        M[:] = R[k].T if reverse else R[k]
        for i in range(3):
            shift[i] = -(M[i, 0] * t[k, 0] + M[i, 1] * t[k, 1] + M[i, 2] * t[k, 2]) / s if reverse else t[k, i]
        _map(points, M, 1 / s if reverse else s, shift, code, camera, h, w, mapped, place)
        counts[k, 5] += _absent(mapped, place, empty.reshape(h * w), light, least_lit)
        count = _on_surface(place, flat_valid, some)
        scales = (1.0, s, s) if reverse else (s, 1.0, 1.0)  # of sigma, of the surface's sigma and of distances
        count = _compare(
            mapped, sigma, place, flat_plane, scales, tolerances, least_facing, cutoff, some, count, rows, counts[k]
        )
        if reverse:  # the normal, in the target's axes and against the motion of the source
            turn[:] = -R[k]
        _derive(points if reverse else mapped, turn, c, some, count, rows)
        _add_normal_equations(rows, count, H[k], g[k])


@compiled
def _map(points, M, scale, shift, code, camera, h, w, mapped, place):
    """Points and normals in the other frame's axes, and their place in its map; -1 where it cannot see them."""
    # Numbers of their own: an array might be the one that is written to, as far as the compiler knows.
    r00, r01, r02 = M[0, 0], M[0, 1], M[0, 2]
    r10, r11, r12 = M[1, 0], M[1, 1], M[1, 2]
    r20, r21, r22 = M[2, 0], M[2, 1], M[2, 2]
    tx, ty, tz = shift[0], shift[1], shift[2]
    for n in range(points.shape[1]):
        x, y, z, a, b, d = points[0, n], points[1, n], points[2, n], points[3, n], points[4, n], points[5, n]
        X = scale * (r00 * x + r01 * y + r02 * z) + tx
        Y = scale * (r10 * x + r11 * y + r12 * z) + ty
        Z = scale * (r20 * x + r21 * y + r22 * z) + tz
        A = r00 * a + r01 * b + r02 * d
        B = r10 * a + r11 * b + r12 * d
        C = r20 * a + r21 * b + r22 * d
        mapped[0, n], mapped[1, n], mapped[2, n] = X, Y, Z
        mapped[3, n], mapped[4, n], mapped[5, n] = A, B, C
        column, row, in_front = pixel_of(code, X, Y, Z, camera)
        towards = A * X + B * Y + C * Z <= 0
        seen = towards & in_front & (column >= 0) & (row >= 0) & (column < w) & (row < h)
        place[n] = np.floor(row) * w + np.floor(column) if seen else -1.0


@compiled
def _on_surface(place, valid, some):
    """Puts the indices of points whose place has a surface into `some`, and returns how many they are."""
    seen = 0
    for n in range(len(place)):
        some[seen] = n
        seen += place[n] >= 0
    count = 0
    for m in range(seen):
        n = some[m]
        some[count] = n
        count += valid[int(place[n])]
    return count


@compiled
def _absent(mapped, place, empty, light, least_cosine):
    """How many points would be seen and lit where the other frame saw nothing; `light` see `EmptyPlaces`."""
    code, projector, T, reach = light
    h, w = reach.shape
    count = 0
    for n in range(len(place)):
        if place[n] < 0 or not empty[int(place[n])]:
            continue
        x, y, z, a, b, c = mapped[0, n], mapped[1, n], mapped[2, n], mapped[3, n], mapped[4, n], mapped[5, n]
        if -(a * x + b * y + c * z) < least_cosine * np.sqrt(x * x + y * y + z * z):
            continue
        X = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        Y = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        Z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        A = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c
        B = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c
        C = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c
        distance = np.sqrt(X * X + Y * Y + Z * Z)
        if least_cosine * distance > -(A * X + B * Y + C * Z):
            continue
        column, row, in_front = pixel_of(code, X, Y, Z, projector)
        if in_front and column >= 0 and row >= 0 and column < w and row < h:
            count += distance < reach[int(row), int(column)]
    return count


@compiled
def _compare(mapped, sigma, place, plane, scales, tolerances, least_facing, cutoff, some, count, rows, counts):
    """Adds to the counts; leaves in `some` the points that move the alignment, returns how many they are.

    Their normals are put into the first three of `rows`, weights and distances into the last two.
    """
    used, agreeing, ahead, behind, squares, cost = 0, 0, 0, 0, 0.0, 0.0
    for m in range(count):
        n = some[m]
        at = int(place[n])
        na, nb, nc = plane[at, 0], plane[at, 1], plane[at, 2]
        r = scales[2] * (na * mapped[0, n] + nb * mapped[1, n] + nc * mapped[2, n] - plane[at, 3])
        spread = np.sqrt((scales[0] * sigma[n]) ** 2 + (scales[1] * plane[at, 4]) ** 2)
        tau, width = max(tolerances[0], tolerances[3] * spread), max(tolerances[1], tolerances[4] * spread)
        facing = na * mapped[3, n] + nb * mapped[4, n] + nc * mapped[5, n]
        agrees = (abs(r) < tau) & (facing > least_facing)
        in_front = (r > tau) & ~agrees
        judged = r > -tolerances[2]
        agreeing += agrees
        ahead += in_front
        behind += judged & ~agrees & ~in_front
        squares += (r / spread) ** 2 if agrees else 0.0
        x = (r / width) ** 2
        cost += _kernel_cost(x) if judged else 0.0
        rows[0, used], rows[1, used], rows[2, used] = na, nb, nc
        rows[7, used], rows[8, used] = _kernel_weight(x) * facing, r
        some[used] = n
        used += (facing >= least_facing) & (abs(r) <= cutoff * width)
    counts[0] += agreeing
    counts[1] += ahead
    counts[2] += behind
    counts[3] += squares
    counts[4] += cost
    return used


@compiled
def _derive(points, turn, c, some, count, rows):
    """Derivatives of the distances by the increment, into the first seven of `rows`; `turn` turns the normals."""
    for m in range(count):
        n = some[m]
        na, nb, nc = rows[0, m], rows[1, m], rows[2, m]
        a = turn[0, 0] * na + turn[0, 1] * nb + turn[0, 2] * nc
        b = turn[1, 0] * na + turn[1, 1] * nb + turn[1, 2] * nc
        d = turn[2, 0] * na + turn[2, 1] * nb + turn[2, 2] * nc
        X, Y, Z = points[0, n] - c[0], points[1, n] - c[1], points[2, n] - c[2]
        rows[0, m], rows[1, m], rows[2, m] = a, b, d
        rows[3, m], rows[4, m], rows[5, m] = Y * d - Z * b, Z * a - X * d, X * b - Y * a
        rows[6, m] = a * X + b * Y + d * Z


@compiled_sums
def _add_normal_equations(rows, count, H, g):
    """Of derivatives, weights and distances."""
    for i in range(7):
        total = 0.0
        for n in range(count):
            total += rows[7, n] * rows[i, n] * rows[8, n]
        g[i] += total
        for j in range(i + 1):
            total = 0.0
            for n in range(count):
                total += rows[7, n] * rows[i, n] * rows[j, n]
            H[i, j] += total
    for i in range(7):
        for j in range(i):
            H[j, i] = H[i, j]
