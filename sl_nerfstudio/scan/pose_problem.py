"""Whether a matrix is a pose: a rigid motion from device to world."""

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.scan.problem import Problem

TOLERANCE = 1e-4  # of the entries of R^T R: text with five digits passes, a scale error of 0.01 % does not
FARTHEST = 1e12  # units from the origin: beyond, numbers of 16 digits do not hold a position exactly enough


def pose_problem(T: Float64[ndarray, "..."]) -> Problem | None:
    """The first reason why `T` is not a rigid motion, None if it is one."""
    if T.shape == (3, 4):
        return Problem("is 3 x 4", "the last row was left out", "add the row 0, 0, 0, 1")
    if T.shape != (4, 4):
        size = " x ".join(map(str, T.shape)) or "one number"
        return Problem(
            f"is {size} instead of 4 x 4", "it is another kind of matrix", "give the 4 x 4 matrix from device to world"
        )
    if not np.isfinite(T).all():
        return Problem(
            "holds NaN or infinity",
            "registration or calibration failed for this frame",
            "calibrate it again or leave the frame out",
        )
    if np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-9:
        return _last_row_problem(T)
    return _rotation_problem(T[:3, :3]) or _position_problem(T[:3, 3])


def _last_row_problem(T: Float64[ndarray, "4 4"]) -> Problem:
    row = ", ".join(f"{x:g}" for x in T[3])
    if np.abs(T[:, 3] - (0, 0, 0, 1)).max() < 1e-9:
        return Problem(
            f"has the last row {row} and the last column 0, 0, 0, 1",
            "the matrix is transposed (stored column by column)",
            "transpose it: the translation is the last column",
        )
    return Problem(
        f"has the last row {row} instead of 0, 0, 0, 1",
        "the matrix is projective or scaled, or its rows are in another order",
        "give a rigid motion from device to world",
    )


def _position_problem(position: Float64[ndarray, "3"]) -> Problem | None:
    reach = float(np.abs(position).max())
    if reach <= FARTHEST:
        return None
    return Problem(
        f"puts the device {reach:.2g} units from the origin",
        "registration or calibration diverged for this frame, or the number was damaged",
        "calibrate it again or leave the frame out",
    )


def _rotation_problem(R: Float64[ndarray, "3 3"]) -> Problem | None:
    with np.errstate(over="ignore", invalid="ignore"):
        gram = R.T @ R
        determinant = float(np.linalg.det(R))
    if np.abs(gram - np.eye(3)).max() <= TOLERANCE:
        if determinant > 0:
            return None
        return Problem(
            "is a reflection (the determinant of its rotation is -1)",
            "one axis was negated, or the axes are left-handed (as in Unity or DirectX)",
            "convert to right-handed axes: device looks along -z, +x right, +y up",
        )
    scale = float(np.cbrt(abs(determinant)))
    if scale > 0 and np.abs(gram / scale**2 - np.eye(3)).max() <= TOLERANCE:
        return Problem(
            f"is scaled: its rotation is {scale:.6g} times {'a reflection' if determinant < 0 else 'a rotation'}",
            "a similarity (which includes a scale or a change of unit) was stored as a pose",
            "divide the upper left 3 x 3 block by its scale, and give positions in the scan's unit",
        )
    return Problem(
        "has no rotation in its upper left 3 x 3 block: its columns are not unit vectors at right angles",
        "it was rounded to few digits, is sheared, or is not a pose matrix",
        "give the rotation with at least six digits",
    )
