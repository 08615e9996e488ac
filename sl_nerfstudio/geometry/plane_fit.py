"""Least-squares planes from sums over points, for use in compiled loops."""

from sl_nerfstudio.compiled import compiled


@compiled
def solve_plane(n, sx, sy, sxx, sxy, syy, s, sxs, sys, least_determinant):
    """`(solvable, c, u, v)` of the least-squares plane `s = c + u x + v y` through n points, given their sums.

    Not solvable if the determinant of [[n, sx, sy], [sx, sxx, sxy], [sy, sxy, syy]] is below `least_determinant`,
    because the points are (nearly) on a line.
    """
    c00, c01, c02 = sxx * syy - sxy * sxy, sxy * sy - sx * syy, sx * sxy - sxx * sy
    c11, c12, c22 = n * syy - sy * sy, sx * sy - n * sxy, n * sxx - sx * sx
    det = n * c00 + sx * c01 + sy * c02
    if det < least_determinant:
        return False, 0.0, 0.0, 0.0
    c = (c00 * s + c01 * sxs + c02 * sys) / det
    u = (c01 * s + c11 * sxs + c12 * sys) / det
    v = (c02 * s + c12 * sxs + c22 * sys) / det
    return True, c, u, v
