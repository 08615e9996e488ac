"""Turns after which the surface looks the same, so that pairs of frames contradict each other (a nut, a gear, a box).

Each side of such an object fits wherever another one is. Pairs of frames then agree perfectly and still say different
things, and which of them is right, surfaces do not tell. A pair that fits by accident moves the rest of the surface to
where it contradicts; a symmetry does not. Nor does any turn about the axis of something round, a vase or a medal: but
parts of that turn contradict no more, so it is no other side. Nor does half a turn of a leaf on a table, which covers
most of its place: parts of it contradict only twice as much. Half the turn of a nut contradicts forty times as much.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity, angle_deg
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.pairs.surface_agreement import Side
from sl_nerfstudio.registration.pose_graph import PoseGraphSolution
from sl_nerfstudio.registration.settings import RegistrationSettings
from sl_nerfstudio.registration.symmetry.exact_turn import exact_turn
from sl_nerfstudio.registration.symmetry.judged import judged
from sl_nerfstudio.registration.symmetry.turns_said import distinct_turns, is_known


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
    said = distinct_turns([*edges, *others], with_others, settings)[: s.most_compared]
    if not fitness or not said:
        return ()
    usual = float(np.quantile(fitness, settings.edge.good_quantile))
    as_it_is = judged(sides, nodes, Similarity.identity(), s.neighbours, settings)
    by_errors = as_it_is.share if as_it_is.total else 0.0
    # as much as a good connection may have: what assembly would take for right is not told from what is
    misfit = by_errors + settings.assembly.misfit_factor * max(settings.assembly.least_misfit, 1 - usual)
    turns: list[Similarity] = []
    for one in said:
        turn = exact_turn(sides, nodes, one, settings)
        if angle_deg(turn.R @ one.R.T) > s.same_rotation_deg or is_known(turn, turns, settings):
            continue
        turned = judged(sides, nodes, turn, s.neighbours, settings)
        if turned.total < s.least_agreeing * as_it_is.total or turned.share > misfit:
            continue
        within = max(judged(sides, nodes, part, s.neighbours, settings).share for part in _parts(turn))
        if within - by_errors > s.least_excess * max(turned.share - by_errors, 0.0):
            turns.append(turn)
    return tuple(sorted(angle_deg(turn.R) for turn in turns))


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
