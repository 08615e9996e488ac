"""Camera poses that a user knows roughly, as a start of registration: the baselines' lengths must be found to them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.surface_map import SurfaceMap


def starting_similarities(
    T_world_camera: Float64[ndarray, "n 4 4"], maps: Sequence[SurfaceMap]
) -> list[Similarity | None]:
    """`S_world_camera` of frames with known camera poses; None where a pose holds NaN.

    Every frame's cloud must lie about the same place: the lengths of the baselines are those for which all centroids,
    each on its own ray, come nearest to one point (linear least squares).
    """
    known = [k for k in range(len(maps)) if np.isfinite(T_world_camera[k]).all()]
    if not known:
        return [None] * len(maps)
    A, b = np.zeros((3 * len(known), len(known) + 3)), np.zeros(3 * len(known))
    for row, k in enumerate(known):
        T, rows = T_world_camera[k], slice(3 * row, 3 * row + 3)
        ray = T[:3, :3] @ maps[k].centroid
        # Divided by the ray's length: directions count, whatever unit the baseline makes.
        A[rows, row] = ray / np.linalg.norm(ray)
        A[rows, len(known) :] = -np.eye(3)
        b[rows] = -T[:3, 3]
    solution = np.linalg.lstsq(A, b, rcond=None)[0]
    out: list[Similarity | None] = [None] * len(maps)
    positive = solution[: len(known)][solution[: len(known)] > 0]
    typical = float(np.median(positive)) if len(positive) else 1.0
    for row, k in enumerate(known):
        distance = solution[row] if solution[row] > 0.2 * typical else typical
        T = T_world_camera[k]
        out[k] = Similarity(float(distance / np.linalg.norm(maps[k].centroid)), T[:3, :3], T[:3, 3])
    return out


def about_one_middle(
    S_world_camera: Sequence[Similarity | None], maps: Sequence[SurfaceMap]
) -> list[Similarity | None]:
    """The same, each moved until the middles of what the frames see lie in one place.

    A camera that is turned wrongly by a few degrees looks past the object by more than the object's size. Its rotation
    is still a good start.
    """
    middles = [None if S is None else S.points(m.middle[None])[0] for S, m in zip(S_world_camera, maps, strict=True)]
    known = [p for p in middles if p is not None]
    centre = np.median(known, axis=0) if known else np.zeros(3)
    return [
        None if S is None or p is None else Similarity(S.scale, S.R, S.t + centre - p)
        for S, p in zip(S_world_camera, middles, strict=True)
    ]
