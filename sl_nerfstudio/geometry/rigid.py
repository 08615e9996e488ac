"""Rigid motions of single points, for compiled loops."""

from sl_nerfstudio.compiled import compiled


@compiled
def moved(T, x, y, z):
    """A point under a rigid motion."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@compiled
def row_times_rotation(a, b, c, T):
    """A row vector times the rotation of a rigid motion."""
    return (
        a * T[0, 0] + b * T[1, 0] + c * T[2, 0],
        a * T[0, 1] + b * T[1, 1] + c * T[2, 1],
        a * T[0, 2] + b * T[1, 2] + c * T[2, 2],
    )
