"""Objects that look the same after a turn, placed by the order of capture: surfaces do not tell their sides apart.

Each frame of a sequence is turned little against the one before. So every pair of successive frames is searched for
among small rotations only, and the chain of them says which side each frame shows. All other pairs then start there.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from sl_nerfstudio.geometry.similarity import Similarity, angle_deg
from sl_nerfstudio.registration.graph_residuals import Nodes
from sl_nerfstudio.registration.pairs.edge_weights import is_accepted
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.pairs.pair_registration import register_pair
from sl_nerfstudio.registration.settings import RegistrationSettings, Search
from sl_nerfstudio.registration.surface_map import SurfaceMap
from sl_nerfstudio.side_by_side import tracked


def typical_step_deg(matches: Sequence[PairMatch], settings: RegistrationSettings) -> float | None:
    """By how much successive frames are turned, in degrees (median); None if few of them hold each other in place."""
    steps = [m for m in matches if m.target - m.source == 1]
    said = [angle_deg(m.S_target_source.R) for m in steps if _holds(m, settings)]
    return float(np.median(said)) if len(said) > settings.order.least_steps * len(steps) else None


def sides_are_open(matches: Sequence[PairMatch], settings: RegistrationSettings) -> bool:
    """Whether a pair of frames of a sequence fits nearly as well after a clearly different rotation."""
    return any(
        rival.ratio > settings.edge.ambiguous_ratio
        and angle_deg(rival.S_target_source.R @ m.S_target_source.R.T) > settings.order.different_sides_deg
        for m in matches
        if m.target - m.source <= max(settings.selection.sequence_gaps) and _holds(m, settings)
        for rival in m.rivals
    )


def _holds(match: PairMatch, settings: RegistrationSettings) -> bool:
    """Whether two surfaces agree, and hold each other in place."""
    return is_accepted(match, settings.edge) and match.shape_slip_deg <= settings.pair.bounded_slip_deg


def chain_of_small_steps(
    maps: Sequence[SurfaceMap], step_deg: float, rng: np.random.Generator, settings: RegistrationSettings
) -> Nodes:
    """`S_world_camera` of the longest run of successive frames that small steps connect; None for all others."""
    largest = settings.order.largest_step * step_deg
    search = Search(largest, settings.order.spacing * step_deg)
    tasks = [
        partial(register_pair, (maps[k], maps[k + 1]), (k, k + 1), search, own, None, settings.pair)
        for k, own in enumerate(rng.spawn(len(maps) - 1))
    ]
    steps = [_small(match, largest, settings) for match in tracked(tasks, "following the order of capture")]
    return _longest_run(steps)


def _longest_run(steps: Sequence[Similarity | None]) -> Nodes:
    """Frames one after the other from the first of them; `steps[k]` maps frame k to the next, None where unknown."""
    nodes = [Similarity.identity()]
    runs = [[0]]
    for k, S_next_this in enumerate(steps, start=1):
        if S_next_this is None:
            runs.append([])
        nodes.append(Similarity.identity() if S_next_this is None else nodes[-1] @ S_next_this.inverse())
        runs[-1].append(k)
    longest = max(runs, key=len)
    return [S if k in longest and len(longest) > 1 else None for k, S in enumerate(nodes)]


def _small(match: PairMatch | None, largest_deg: float, settings: RegistrationSettings) -> Similarity | None:
    """The best of a pair's results, or one that clearly turns less; None if it is larger than a step can be."""
    if match is None or not is_accepted(match, settings.edge):
        return None
    S = match.S_target_source
    for rival in match.rivals:
        less = angle_deg(S.R) - angle_deg(rival.S_target_source.R)
        if rival.ratio >= settings.order.least_ratio and less > settings.order.different_sides_deg:
            S = rival.S_target_source
    return S if angle_deg(S.R) <= largest_deg else None
