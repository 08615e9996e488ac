"""Cycle consistency: whether edges of the pose graph agree with what other edges say about the same frames."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.graph_residuals import Pivots
from sl_nerfstudio.registration.pair_match import PairMatch
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, PoseGraphSettings


def cycle_consistency(
    edges: Sequence[PairMatch],
    pivots: Pivots,
    weight: Float64[ndarray, "edges"],
    settings: PoseGraphSettings = REGISTRATION_DEFAULTS.pose_graph,
) -> Float64[ndarray, "edges"]:
    """For every edge the number of triangles it closes less those it fails to close.

    A triangle counts as the product of the weights of its two other edges.
    """
    by_pair = {frozenset((e.source, e.target)): k for k, e in enumerate(edges)}
    count = np.zeros(len(edges))
    for k, e in enumerate(edges):
        for third in {n for pair in by_pair for n in pair} - {e.source, e.target}:
            a, b = by_pair.get(frozenset((e.source, third))), by_pair.get(frozenset((third, e.target)))
            if a is None or b is None:
                continue
            around = edges[b].between(third, e.target) @ edges[a].between(e.source, third)
            closes = _close(around, e.S_target_source, e.target, pivots, settings)
            count[k] += weight[a] * weight[b] * (1 if closes else -1)
    return count


def _close(a: Similarity, b: Similarity, target: int, pivots: Pivots, settings: PoseGraphSettings) -> bool:
    D = a @ b.inverse()
    c, radius = pivots.centre[target], pivots.radius[target]
    angle_deg = np.degrees(Rotation.from_matrix(D.R).magnitude())
    shift = np.linalg.norm(D.points(c[None])[0] - c) / radius
    return bool(
        angle_deg < settings.cycle_rotation_deg
        and shift < settings.cycle_shift
        and abs(np.log(D.scale)) < settings.cycle_log_scale
    )
