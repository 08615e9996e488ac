"""Similarities from which the registration of a pair starts."""

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
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
    """A guess, rotated about what may be the object."""
    return Hypotheses.joined([_rotated(rotations(search), view.centre, guess) for view in target.views])


def _rotated(turn: Float64[ndarray, "k 3 3"], pivot: Float64[ndarray, "3"], guess: Similarity) -> Hypotheses:
    t = pivot + np.einsum("kij,j->ki", turn, guess.t - pivot)
    scale = np.full(len(turn), guess.scale)
    return Hypotheses(scale, turn @ guess.R, t, np.log(scale))


def without_guess(source: SurfaceMap, target: SurfaceMap, search: Search, scales: tuple[float, ...]) -> Hypotheses:
    """Rotations of two cameras that look at the object from the same side.

    The frames' guesses of where the object is are put onto each other, one after the other. `scales` are relative to
    the one at which their sizes are equal.
    """
    turn, parts = rotations(search), []
    for a, b in zip(source.views, target.views, strict=True):
        for scale in (factor * b.size / a.size for factor in scales):
            size = np.full(len(turn), scale)
            parts.append(Hypotheses(size, turn, b.centre - scale * turn @ a.centre, np.log(size)))
    return Hypotheses.joined(parts)
