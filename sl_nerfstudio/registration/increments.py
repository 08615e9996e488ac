"""Increments (v, w, l) of similarities about a pivot c: `p -> c + exp(l) exp(w) (p - c) + radius v`."""

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity


def log_at(D: Similarity, centre: Float64[ndarray, "3"], radius: float) -> Float64[ndarray, "7"]:
    """Increment (v, w, l) about a pivot that is the similarity D."""
    v = (D.points(centre[None])[0] - centre) / radius
    return np.concatenate([v, Rotation.from_matrix(D.R).as_rotvec(), [np.log(D.scale)]])
