"""Pairs that only tones hold, confirmed by a third frame.

Where the shape leaves a turn open, two tones may agree by accident anywhere. Three pairs that close a cycle do not.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from sl_nerfstudio.geometry.similarity import Similarity, angle_deg
from sl_nerfstudio.registration.graph_residuals import Pivots
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.settings import PairSettings


def with_confirmed_tones(edges: Sequence[PairMatch], pivots: Pivots, settings: PairSettings) -> list[PairMatch]:
    """The pairs in their order; those that tones hold and no cycle of three confirms are taken to slip."""
    if not any(e.by_tone for e in edges):
        return list(edges)
    held: defaultdict[int, dict[int, PairMatch]] = defaultdict(dict)
    for e in edges:
        if e.slip_deg <= settings.bounded_slip_deg:
            held[e.source][e.target] = held[e.target][e.source] = e
    return [
        e.without_tone() if e.by_tone and not _confirmed(e, held[e.source], held[e.target], pivots, settings) else e
        for e in edges
    ]


def _confirmed(
    e: PairMatch,
    of_source: dict[int, PairMatch],
    of_target: dict[int, PairMatch],
    pivots: Pivots,
    settings: PairSettings,
) -> bool:
    """Whether the way over a third frame leads to the same similarity."""
    around = (
        of_target[k].between(k, e.target) @ of_source[k].between(e.source, k) for k in of_source if k in of_target
    )
    return any(_same(e.S_target_source, S, pivots, e.source, settings) for S in around)


def _same(a: Similarity, b: Similarity, pivots: Pivots, frame: int, settings: PairSettings) -> bool:
    """Whether two similarities turn a frame alike, and put its centre at about the same place."""
    if angle_deg(a.R @ b.R.T) > settings.same_rotation_deg:
        return False
    centre = pivots.centre[frame][None]
    shift = float(np.linalg.norm(a.points(centre) - b.points(centre)))
    return shift < settings.same_shift * a.scale * float(pivots.radius[frame])
