"""By which motions of the world pairs of frames differ from the poses that were found."""

from collections.abc import Iterator, Sequence

import numpy as np

from sl_nerfstudio.geometry.similarity import Similarity, angle_deg
from sl_nerfstudio.registration.graph_residuals import node_at
from sl_nerfstudio.registration.pairs.edge_weights import quality
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.pose_graph import PoseGraphSolution
from sl_nerfstudio.registration.settings import EdgeSettings, RegistrationSettings


def distinct_turns(
    edges: Sequence[PairMatch], solution: PoseGraphSolution, settings: RegistrationSettings
) -> list[Similarity]:
    """Clearly different turns of the world; those that the best pairs say come first."""
    s, found = settings.symmetry, list[Similarity]()
    for turn in _said(edges, solution, settings.edge):
        if abs(np.log(turn.scale)) < s.largest_log_scale and not is_known(turn, found, settings):
            found.append(turn)
    return found


def is_known(turn: Similarity, found: Sequence[Similarity], settings: RegistrationSettings) -> bool:
    """Whether a turn is none, or about one of those found, forwards or backwards."""
    known = (Similarity.identity(), *found, *(T.inverse() for T in found))
    return any(angle_deg((turn @ T.inverse()).R) <= settings.symmetry.same_rotation_deg for T in known)


def _said(edges: Sequence[PairMatch], solution: PoseGraphSolution, settings: EdgeSettings) -> Iterator[Similarity]:
    """By which motions of the world pairs, or their rivals, differ from the solution."""
    nodes = solution.S_world_camera
    placed = [
        (e, used)
        for e, used in zip(edges, solution.consistent, strict=True)
        if nodes[e.source] is not None and nodes[e.target] is not None
    ]
    for e, used in sorted(placed, key=lambda one: (one[1], -quality(one[0], settings))):
        target, source = node_at(nodes, e.target), node_at(nodes, e.source).inverse()
        results = [*([] if used else [e.S_target_source]), *(rival.S_target_source for rival in e.rivals)]
        yield from (target @ S @ source for S in results)
