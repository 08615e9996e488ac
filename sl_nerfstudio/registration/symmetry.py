"""Turns after which the surface looks the same, so that pairs of frames contradict each other (a nut, a gear, a box).

Each side of such an object fits wherever another one is. Pairs of frames then agree perfectly and still say different
things, and which of them is right, surfaces do not tell. A pair that fits by accident moves the rest of the surface to
where it contradicts; a symmetry does not. Nor does any turn about the axis of something round, a vase or a medal: but
parts of that turn contradict no more, so it is no other side. Nor does half a turn of a leaf on a table, which covers
most of its place: parts of it contradict only twice as much. Half the turn of a nut contradicts forty times as much.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity, angle_deg
from sl_nerfstudio.registration.graph_residuals import Nodes, node_at
from sl_nerfstudio.registration.pairs.edge_weights import quality
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.pairs.surface_agreement import Side, Tolerance, agreement
from sl_nerfstudio.registration.pose_graph import PoseGraphSolution
from sl_nerfstudio.registration.settings import EdgeSettings, RegistrationSettings


def symmetric_turns_deg(
    sides: Sequence[Side],
    edges: Sequence[PairMatch],
    solution: PoseGraphSolution,
    settings: RegistrationSettings,
    others: Sequence[PairMatch] = (),
) -> tuple[float, ...]:
    """Angles of the turns, in degrees, that pairs of registered frames say and that leave the surface as it is.

    `others`: pairs that are not edges of the solution, which may say turns as well.
    """
    s, nodes = settings.symmetry, solution.S_world_camera
    fitness = [e.fitness for e, used in zip(edges, solution.consistent, strict=True) if used]
    unused = np.zeros(len(others), dtype=bool)
    with_others = replace(solution, consistent=np.append(solution.consistent, unused))
    said = _distinct([*edges, *others], with_others, settings)[: s.most_compared]
    if not fitness or not said:
        return ()
    usual = float(np.quantile(fitness, settings.edge.good_quantile))
    agreeing, as_it_is = _moved(sides, nodes, Similarity.identity(), settings)
    by_errors = _share((agreeing, as_it_is)) if agreeing else 0.0
    # as much as a good connection may have: what assembly would take for right is not told from what is
    misfit = by_errors + settings.assembly.misfit_factor * max(settings.assembly.least_misfit, 1 - usual)
    turns = []
    for turn in said:
        same, contradicting = _moved(sides, nodes, turn, settings)
        if same < s.least_agreeing * agreeing or contradicting > misfit * (same + contradicting):
            continue
        within = max(_share(_moved(sides, nodes, part, settings)) for part in _parts(turn))
        if within - by_errors > s.least_excess * max(_share((same, contradicting)) - by_errors, 0.0):
            turns.append(angle_deg(turn.R))
    return tuple(sorted(turns))


def _share(found: tuple[float, float]) -> float:
    """Of points that contradict."""
    agreeing, contradicting = found
    return contradicting / (agreeing + contradicting) if agreeing + contradicting else 1.0


def _parts(turn: Similarity) -> tuple[Similarity, Similarity]:
    """Half of a turn and three eighths of it, about the same axis."""
    half = _half(turn)
    quarter = _half(half)
    return half, quarter @ _half(quarter)


def _half(turn: Similarity) -> Similarity:
    """The turn that gives `turn` if it is made twice: about the same axis, by half the angle."""
    scale = turn.scale**0.5
    R = Rotation.from_rotvec(Rotation.from_matrix(turn.R).as_rotvec() / 2).as_matrix()
    return Similarity(scale, R, np.linalg.solve(np.eye(3) + scale * R, turn.t))


def _distinct(
    edges: Sequence[PairMatch], solution: PoseGraphSolution, settings: RegistrationSettings
) -> list[Similarity]:
    """Clearly different turns of the world; those that the best pairs say come first."""
    s, found = settings.symmetry, list[Similarity]()
    for turn in _said(edges, solution, settings.edge):
        known = (Similarity.identity(), *found, *(T.inverse() for T in found))
        if abs(np.log(turn.scale)) < s.largest_log_scale and all(
            angle_deg((turn @ T.inverse()).R) > s.same_rotation_deg for T in known
        ):
            found.append(turn)
    return found


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


def _moved(
    sides: Sequence[Side], nodes: Nodes, turn: Similarity, settings: RegistrationSettings
) -> tuple[float, float]:
    """Points that agree with the registered frames, and that contradict them, if the surface of each is moved."""
    agreeing = contradicting = 0.0
    least_cosine = np.cos(np.radians(settings.selection.largest_view_angle_deg))
    width = Tolerance(0.0, settings.assembly.tolerance_sigmas)
    frames = [k for k, S in enumerate(nodes) if S is not None]
    sight = np.array([node_at(nodes, k).R[:, 2] for k in frames])
    for i in frames:
        moved = turn @ node_at(nodes, i)
        cosine = np.asarray(sight @ moved.R[:, 2], dtype=np.float64)
        for k in np.argsort(-cosine, kind="stable")[: settings.symmetry.neighbours].tolist():
            j = frames[k]
            if j != i and cosine[k] > least_cosine:
                S, pair = Hypotheses.of(node_at(nodes, j).inverse() @ moved), settings.pair
                found = agreement(sides[i], sides[j], S, width, width, pair.agreement)
                agreeing += float(found.agreeing[0])
                contradicting += float(found.in_front[0] + pair.agreement.behind * found.behind[0])
    return agreeing, contradicting
