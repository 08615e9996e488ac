"""Blocks of frames against the rest: each may belong to another side of what nearly looks the same from several sides.

Frames are joined one after the other, so a wrong pair may have put a whole block of them where it fits less well. Every
turn of the world that some pair says is tried on the block for which it gains most, by the log-odds of all pairs of
frames across it: which frames belong to it is a cut of a graph (as in Kernighan and Lin, 1970). What the best cut does
not decide stays apart.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.assembly import (
    Component,
    Pivots,
    PoseGraphSolution,
    Prior,
    facing,
    optimise_pose_graph,
)
from sl_nerfstudio.registration.evidence import ScanEvidence
from sl_nerfstudio.registration.pairs import LEAST_ODDS, SAME_PLACE_DEG, PairMatch, edge_weights

FACING = 8  # frames with which each is compared, before a turn and after it
MOST_TURNS = 16  # of the world that are tried
MOST_MOVES = 12  # of blocks, one after the other
LEAST_GAIN = 1.0  # nats by which a block must fit better elsewhere
STARTS = 24  # frames from which a block is grown
SAME_TURN_DEG = 4.0  # between two turns of the world below which they are one


def at_places(edges: Sequence[PairMatch], nodes: Component) -> list[PairMatch]:
    """The pairs, each at that of its places which is nearest to where its frames are."""
    out: list[PairMatch] = []
    for e in edges:
        if e.source not in nodes or e.target not in nodes:
            out.append(e)
            continue
        here = nodes[e.target].inverse() @ nodes[e.source]
        places = [e.S_target_source, *(rival.S_target_source for rival in e.rivals)]
        nearest = min(places, key=lambda S: angle_deg(S.R @ here.R.T))
        out.append(e if nearest is e.S_target_source else replace(e, S_target_source=nearest))
    return out


def turns_said(edges: Sequence[PairMatch], nodes: Component) -> list[Similarity]:
    """Clearly different turns of the world after which pairs fit as well or better; the most likely first."""
    said: list[tuple[float, Similarity]] = []
    for e in edges:
        if e.source not in nodes or e.target not in nodes:
            continue
        target, source = nodes[e.target], nodes[e.source].inverse()
        places = [(0.0, e.S_target_source), *((r.log_odds, r.S_target_source) for r in e.rivals)]
        said += [(odds, target @ S @ source) for odds, S in places]
    found: list[Similarity] = []
    for _, turn in sorted(said, key=lambda one: -one[0]):
        known = (Similarity.identity(), *found)
        if len(found) < MOST_TURNS and all(angle_deg(turn.R @ T.R.T) > SAME_TURN_DEG for T in known):
            found.append(turn)
    return found


def gains(
    scan: ScanEvidence, nodes: Component, turn: Similarity, prior: Prior | None
) -> Float64[ndarray, "n n"]:
    """Nats that are gained across each pair of frames if the first is moved by a turn and the second stays."""
    frames = list(nodes)
    out = np.zeros((len(frames), len(frames)))
    for row, i in enumerate(frames):
        own, others = {i: nodes[i]}, {j: S for j, S in nodes.items() if j != i}
        before = {j for _, j in facing(own, others, Similarity.identity(), FACING)}
        after = {j for _, j in facing({i: turn @ nodes[i]}, others, Similarity.identity(), FACING)}
        for j in before | after:
            now, moved = nodes[j].inverse() @ nodes[i], nodes[j].inverse() @ turn @ nodes[i]
            leads, _ = scan.comparison(i, j, [now if j in before else None, moved if j in after else None])
            out[row, frames.index(j)] = leads[1, 0]
        if prior is not None:
            for column, j in enumerate(frames):
                if j != i:
                    S = nodes[j].inverse()
                    out[row, column] += prior(i, j, S @ turn @ nodes[i]) - prior(i, j, S @ nodes[i])
    return out


def best_block(gain: Float64[ndarray, "n n"]) -> tuple[float, Bool[ndarray, "n"]]:
    """The block of frames, neither none nor all, whose turn gains most across its border.

    Blocks grow from each of the frames that would gain most alone, by the frame that is best then.
    """
    n = len(gain)
    most, best = -np.inf, np.zeros(n, dtype=bool)
    for first in np.argsort(-gain.sum(1), kind="stable")[:STARTS].tolist():
        block = np.zeros(n, dtype=bool)
        more, total, nearest = gain.sum(1), 0.0, first  # more: of each frame outside, if it came in
        for _ in range(n - 1):
            total += float(more[nearest])
            block[nearest] = True
            more = more - gain[:, nearest] - gain[nearest]
            if total > most:
                most, best = total, block.copy()
            nearest = int(np.where(block, -np.inf, more).argmax())
    return most, best


def settled(
    scan: ScanEvidence, pivots: Pivots, edges: Sequence[PairMatch], start: PoseGraphSolution, prior: Prior | None
) -> tuple[PoseGraphSolution, list[Component]]:
    """A component with its blocks where they are most likely, and those of them whose place is not decided."""
    solution = start
    for _ in range(MOST_MOVES):
        nodes = solution.S_world_camera
        found = [(*best_block(gains(scan, nodes, turn, prior)), turn) for turn in turns_said(edges, nodes)]
        gain, block, turn = max(found, key=lambda one: one[0], default=(0.0, np.zeros(0, bool), Similarity.identity()))
        if gain < LEAST_GAIN:
            break
        frames = np.array(list(nodes))[block].tolist()
        moved = {k: turn @ S if k in frames else S for k, S in nodes.items()}
        solution = optimised(edges, pivots, moved)
    open_ = [np.array(list(solution.S_world_camera))[block].tolist() for gain, block, _ in found if gain > -LEAST_ODDS]
    return solution, [{k: solution.S_world_camera[k] for k in frames} for frames in open_]


def optimised(edges: Sequence[PairMatch], pivots: Pivots, nodes: Component) -> PoseGraphSolution:
    """All pairs optimised together, each at its place nearest to where its frames are."""
    placed = at_places(edges, nodes)
    return optimise_pose_graph(placed, pivots, nodes, edge_weights(placed))
