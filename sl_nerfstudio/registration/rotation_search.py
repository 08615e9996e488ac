"""Similarities from which the registration of a pair starts."""

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.hypotheses import Hypotheses
from sl_nerfstudio.registration.settings import Search
from sl_nerfstudio.registration.surface_map import SurfaceMap


def rotations(search: Search) -> Float64[ndarray, "k 3 3"]:
    """Rotation matrices of a search, the identity first."""
    step, reach = np.radians(search.spacing_deg), np.radians(search.angle_deg)
    n = int(np.ceil(reach / step))
    lattice = np.stack(np.meshgrid(*[np.arange(-n, n + 1) * step] * (2 if search.all_rolls else 3)), -1)
    vectors = lattice.reshape(-1, lattice.shape[-1])
    vectors = vectors[np.linalg.norm(vectors, axis=1) <= reach + 1e-9]
    vectors = vectors[np.argsort(np.linalg.norm(vectors, axis=1), kind="stable")]
    if not search.all_rolls:
        return Rotation.from_rotvec(vectors).as_matrix()
    tilt = Rotation.from_rotvec(np.pad(vectors, ((0, 0), (0, 1)))).as_matrix()
    angles = np.arange(round(2 * np.pi / step)) * (2 * np.pi / round(2 * np.pi / step))
    roll = Rotation.from_euler("z", angles).as_matrix()
    return np.einsum("aij,bjk->abik", tilt, roll).reshape(-1, 3, 3)


def around_guess(target: SurfaceMap, search: Search, guess: Similarity) -> Hypotheses:
    """A guess, rotated about the object."""
    turn, pivot = rotations(search), target.object_centre
    t = pivot + np.einsum("kij,j->ki", turn, guess.t - pivot)
    return Hypotheses(np.full(len(turn), guess.scale), turn @ guess.R, t)


def without_guess(source: SurfaceMap, target: SurfaceMap, search: Search, scales: tuple[float, ...]) -> Hypotheses:
    """Rotations of two cameras that look at the object from the same side.

    `scales` are relative to the one that makes the visible parts equally large.
    """
    turn = rotations(search)
    size = target.radius / source.radius
    k, parts = len(turn), [(f * size, target.object_centre - f * size * turn @ source.object_centre) for f in scales]
    return Hypotheses(
        np.repeat([scale for scale, _ in parts], k),
        np.concatenate([turn] * len(parts)),
        np.concatenate([t for _, t in parts]),
    )
