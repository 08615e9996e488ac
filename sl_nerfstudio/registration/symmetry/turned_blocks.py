"""Blocks of frames at the wrong one of several sides from which an object looks nearly the same.

Components grow pair by pair. Half a bearing block fits on its other half but for an oil cup: two blocks of frames that
were joined like this agree over most of their surface. But all pairs across the two contradict each other more than
those inside, and there is a turn of the world after which one block contradicts the other no more. Which frames belong
to it is the cut of a graph: weights of its edges are what pairs contradict before the turn, less what they do after it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.pairs.surface_agreement import Side
from sl_nerfstudio.registration.pose_graph import PoseGraphSolution
from sl_nerfstudio.registration.settings import RegistrationSettings
from sl_nerfstudio.registration.symmetry.judged import Judged, judged, share
from sl_nerfstudio.registration.symmetry.turns_said import distinct_turns


@dataclass(frozen=True)
class TurnedBlock:
    """Frames that contradict the others less after a turn of the world."""

    frames: tuple[int, ...]
    turn: Similarity
    relief: float  # by how much less, in frames: 1 is all points of one frame


def turned_blocks(
    sides: Sequence[Side],
    edges: Sequence[PairMatch],
    solution: PoseGraphSolution,
    before: Judged,
    settings: RegistrationSettings,
) -> list[TurnedBlock]:
    """Of each turn that pairs of frames say, the block whose contradictions end by it; the greatest relief first.

    `before`: the frames of the solution as they are.
    """
    s, nodes = settings.blocks, solution.S_world_camera
    frames = [k for k, S in enumerate(nodes) if S is not None]
    if len(frames) < s.fewest_frames:
        return []
    usual = _usual(before, settings)
    contradicting, found = _excess(before, usual), list[TurnedBlock]()
    if contradicting.sum() < s.least_contradicting:
        return []
    for turn in distinct_turns(edges, solution, settings)[: s.most_compared]:
        after = judged(sides, nodes, turn, s.neighbours, settings)
        block = _best_cut(contradicting - _excess(after, usual), s.starts)
        if block is None:
            continue
        agreed, contradicted = before.across(block)
        agrees, contradicts = after.across(block)
        if agrees < max(s.least_agreeing, s.least_overlap * agreed):
            continue
        if share(agrees, contradicts) < s.largest_remainder * share(agreed, contradicted):
            inside = tuple(np.array(frames)[block].tolist())
            found.append(TurnedBlock(inside, turn, contradicted - contradicts))
    return sorted(found, key=lambda one: -one.relief)


def _usual(found: Judged, settings: RegistrationSettings) -> float:
    """Share of the points that may contradict: a little more than in the better part of the pairs."""
    s, total = settings.blocks, found.agreeing + found.contradicting
    shares = found.contradicting[total > s.least_judged] / total[total > s.least_judged]
    better = float(np.quantile(shares, s.better_quantile)) if len(shares) else 0.0
    return s.usual_factor * max(better, s.least_misfit)


def _excess(found: Judged, usual: float) -> Float64[ndarray, "n n"]:
    """What contradicts beyond the usual."""
    return np.maximum(found.contradicting - usual * (found.agreeing + found.contradicting), 0.0)


def _best_cut(relief: Float64[ndarray, "n n"], starts: int) -> Bool[ndarray, "n"] | None:
    """The frames whose turn relieves the pairs across most; None if none does.

    Blocks grow from each of the frames that would be relieved most alone, by the frame that is best then, until all but
    one are in it (as in Kernighan and Lin, 1970).
    """
    n, most, best = len(relief), 0.0, None
    for first in np.argsort(-relief.sum(1), kind="stable")[:starts].tolist():
        block = np.zeros(n, dtype=bool)
        gain, sum_, nearest = relief.sum(1), 0.0, first  # gain: of each frame outside, if it came in
        for _ in range(n - 1):
            sum_ += float(gain[nearest])
            block[nearest] = True
            gain -= relief[:, nearest] + relief[nearest]
            if sum_ > most:
                most, best = sum_, block.copy()
            nearest = int(np.where(block, -np.inf, gain).argmax())
    return best
