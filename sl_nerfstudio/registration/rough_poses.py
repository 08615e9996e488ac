"""Camera poses that a user knows roughly, as a start of registration: the baselines that fit them are found here."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, StartSettings
from sl_nerfstudio.registration.surface_map import SurfaceMap


def starting_similarities(
    T_world_camera: Float64[ndarray, "n 4 4"],
    maps: Sequence[SurfaceMap],
    settings: StartSettings = REGISTRATION_DEFAULTS.start,
) -> list[Similarity | None]:
    """`S_world_camera` of frames with known camera poses; None where a pose holds NaN.

    The clouds of all frames must lie at about the same place. The baselines are therefore those for which all
    centroids, each on its own ray, come nearest to one point (linear least squares).
    """
    known = [k for k in range(len(maps)) if np.isfinite(T_world_camera[k]).all()]
    if not known:
        return [None] * len(maps)
    A, b = np.zeros((3 * len(known), len(known) + 3)), np.zeros(3 * len(known))
    for row, k in enumerate(known):
        T, rows = T_world_camera[k], slice(3 * row, 3 * row + 3)
        ray = T[:3, :3] @ maps[k].centroid
        # Unit rays: only their directions count, whatever unit the baseline makes.
        A[rows, row] = ray / np.linalg.norm(ray)
        A[rows, len(known) :] = -np.eye(3)
        b[rows] = -T[:3, 3]
    distances = np.linalg.lstsq(A, b, rcond=None)[0][: len(known)]
    positive = distances[distances > 0]
    typical = float(np.median(positive)) if len(positive) else 1.0
    out: list[Similarity | None] = [None] * len(maps)
    for k, found in zip(known, distances, strict=True):
        distance = found if found > settings.least_distance * typical else typical
        T = T_world_camera[k]
        out[k] = Similarity(float(distance / np.linalg.norm(maps[k].centroid)), T[:3, :3], T[:3, 3])
    return out


def with_common_centre(
    S_world_camera: Sequence[Similarity | None], maps: Sequence[SurfaceMap]
) -> list[Similarity | None]:
    """The same, each moved so that the centres of what the frames see lie in one place.

    A camera that is rotated wrongly by a few degrees looks past the object by more than the object's size. Its rotation
    is still a good start.
    """
    pairs = zip(S_world_camera, maps, strict=True)
    centres = [None if S is None else S.points(m.views[0].centre[None])[0] for S, m in pairs]
    known = [p for p in centres if p is not None]
    common = np.median(known, axis=0) if known else np.zeros(3)
    return [
        None if S is None or p is None else Similarity(S.scale, S.R, S.t + common - p)
        for S, p in zip(S_world_camera, centres, strict=True)
    ]
