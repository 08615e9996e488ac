"""Objects that look the same from several sides: the turns of the world after which a scan is as likely."""

from collections.abc import Sequence

import numpy as np

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.pairs import LEAST_ODDS, PairMatch
from sl_nerfstudio.registration.pose_graph import PoseGraphSolution

LEAST_TURN_DEG = 20.0  # between two sides
SAME_TURN_DEG = 8.0  # between two turns below which they are one
LARGEST_LOG_SCALE_OF_TURN = 0.05  # which is 0 but for the errors of the pairs
LEAST_FRAMES = 0.5  # share of the frames whose pairs must say a turn


def symmetric_turns_deg(matches: Sequence[PairMatch], solution: PoseGraphSolution) -> tuple[float, ...]:
    """Angles of the turns of the world, in degrees, after which most frames fit as well."""
    nodes = solution.S_world_camera
    turns: list[tuple[Similarity, set[int]]] = []
    for e in matches:
        if e.source not in nodes or e.target not in nodes or not e.holds:
            continue
        places = [(e.S_target_source, 0.0), *((r.S_target_source, r.log_odds) for r in e.rivals)]
        here = nodes[e.target].inverse() @ nodes[e.source]
        odds = [odds for S, odds in places if angle_deg(S.R @ here.R.T) < SAME_TURN_DEG]
        if not odds:
            continue
        for S, other in places:
            turn = nodes[e.target] @ S @ nodes[e.source].inverse()
            far = angle_deg(turn.R) > LEAST_TURN_DEG and abs(np.log(turn.scale)) < LARGEST_LOG_SCALE_OF_TURN
            if not far or other < max(odds) - LEAST_ODDS:
                continue
            same = [said for T, said in turns if _is_same(turn, T)]
            if same:
                same[0].update((e.source, e.target))
            else:
                turns.append((turn, {e.source, e.target}))
    enough = LEAST_FRAMES * len(nodes)
    return tuple(sorted(angle_deg(turn.R) for turn, said in turns if len(said) >= enough and len(nodes) > 1))


def _is_same(a: Similarity, b: Similarity) -> bool:
    """Whether two turns are one, forwards or backwards."""
    return any(angle_deg(a.R @ R.T) < SAME_TURN_DEG for R in (b.R, b.R.T))
