"""Objects that look the same, or nearly, from several sides: symmetric turns, turned blocks, the order of capture."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.parallel import tracked
from sl_nerfstudio.registration.agreement import Hypotheses, Side, Tolerance, agreement
from sl_nerfstudio.registration.assembly import (
    CROSS_SIGMAS,
    LEAST_MISFIT,
    LEAST_SIGHT_COSINE,
    MISFIT_FACTOR,
    SAME_SIDE_DEG,
    Component,
    PoseGraphSolution,
)
from sl_nerfstudio.registration.pairs import (
    AMBIGUOUS_RATIO,
    BOUNDED_SLIP_DEG,
    GOOD_QUANTILE,
    KERNEL_SIGMAS,
    PairMatch,
    Search,
    is_accepted,
    quality,
    register_pair,
)
from sl_nerfstudio.registration.surfaces import SurfaceMap
from sl_nerfstudio.registration.view_graph import ViewGraph

# By the order of capture.
SEQUENCE_GAPS = (1, 2)  # differences between the numbers of frames that are paired in a sequence
LEAST_STEPS = 0.5  # share of the successive frames that must agree for their usual step to be known
DIFFERENT_SIDES_DEG = 20.0  # rotation between two results of a pair beyond which they show different sides
LARGEST_STEP = 2.0  # rotation between successive frames, in usual steps
SPACING = 0.5  # of the rotations from which a step is searched for, in usual steps
LEAST_RATIO = 0.5  # score of a small step, relative to the best result of its pair, from which it may be right

# Symmetric turns.
LARGEST_LOG_SCALE_OF_TURN = 0.05  # which is 0 but for the errors of the pairs
LEAST_COVERED = 0.25  # points that must agree after a turn, relative to before it: one side covers little upside down
TURN_NEIGHBOURS = 6  # frames with which each one is compared after a turn
MOST_TURNS = 12  # that are tried
EXACT_WIDTHS = (0.06, 0.04, 0.03, 0.02, 0.01, 0.0, 0.0)  # of the kernel in each step that makes a turn exact, radii
EXACT_RCOND = 1e-6  # singular values, relative to the largest, along which a turn stays: what is round slips
LEAST_EXCESS = (
    8.0  # times as much must contradict after a part of a turn as after all of it; less: it is round, or long
)

# Turned blocks. Points are counted in frames: 1 is all points of one.
FEWEST_FRAMES = 3  # of a component in which blocks are looked for
BLOCK_NEIGHBOURS = 16  # frames with which each one is compared
LEAST_JUDGED = 0.1  # minimum overlap for a pair to enter the usual share of contradictions
BETTER_QUANTILE = 0.25  # of those shares: pairs inside a block, even if blocks contradict each other
BLOCK_MISFIT = 0.003  # share that may contradict in such pairs: points at edges do in every pair
USUAL_FACTOR = 1.5  # on that share: what counts against nobody
LEAST_CONTRADICTING = 0.5  # points that must contradict beyond the usual for a block to be looked for
STARTS = 24  # frames from which a block is grown
BLOCK_AGREEING = 1.0  # points of a block that must agree with the other frames after the turn
BLOCK_OVERLAP = 0.1  # the same, relative to those that agreed before it
LARGEST_REMAINDER = 0.5  # share that contradicts across a block after the turn, relative to before it
LEAST_IMPROVEMENT = 0.8  # share that contradicts among all frames after the turn, relative to before it
MOST_TRIED = 2  # turned blocks of a component, those that contradict most
MOST_TURNED = 4  # blocks one after the other

# The order of capture tells sides apart that surfaces do not: each frame of a sequence is turned little against the one
# before. So every pair of successive frames is searched for among small rotations only, and the chain of them says
# which side each frame shows. All other pairs then start there.


def typical_step_deg(matches: Sequence[PairMatch]) -> float | None:
    """Median turn of successive frames, in degrees; None if too few pairs are fully constrained."""
    steps = [m for m in matches if m.target - m.source == 1]
    said = [angle_deg(m.S_target_source.R) for m in steps if _holds(m)]
    return float(np.median(said)) if len(said) > LEAST_STEPS * len(steps) else None


def sides_are_open(matches: Sequence[PairMatch]) -> bool:
    """Whether a pair of frames of a sequence fits nearly as well after a clearly different rotation."""
    return any(
        rival.ratio > AMBIGUOUS_RATIO
        and angle_deg(rival.S_target_source.R @ m.S_target_source.R.T) > DIFFERENT_SIDES_DEG
        for m in matches
        if m.target - m.source <= max(SEQUENCE_GAPS) and _holds(m)
        for rival in m.rivals
    )


def _holds(match: PairMatch) -> bool:
    """Whether two surfaces agree, and hold each other in place."""
    return is_accepted(match) and match.shape_slip_deg <= BOUNDED_SLIP_DEG


def chain_of_small_steps(maps: Sequence[SurfaceMap], step_deg: float, rng: np.random.Generator) -> Component:
    """`S_world_camera` of the longest run of successive frames that small steps connect."""
    largest = LARGEST_STEP * step_deg
    search = Search(largest, SPACING * step_deg)
    tasks = [
        partial(register_pair, (maps[k], maps[k + 1]), (k, k + 1), search, own, None)
        for k, own in enumerate(rng.spawn(len(maps) - 1))
    ]
    return _longest_run([_small(match, largest) for match in tracked(tasks, "following the order of capture")])


def _longest_run(steps: Sequence[Similarity | None]) -> Component:
    """Frames one after the other from the first of them; `steps[k]` maps frame k to the next, None where unknown."""
    nodes, runs = [Similarity.identity()], [[0]]
    for k, S_next_this in enumerate(steps, start=1):
        if S_next_this is None:
            runs.append([])
        nodes.append(Similarity.identity() if S_next_this is None else nodes[-1] @ S_next_this.inverse())
        runs[-1].append(k)
    longest = max(runs, key=len)
    return {k: nodes[k] for k in longest} if len(longest) > 1 else {}


def _small(match: PairMatch | None, largest_deg: float) -> Similarity | None:
    """The best of a pair's results, or one that clearly turns less; None if it is larger than a step can be."""
    if match is None or not is_accepted(match):
        return None
    S = match.S_target_source
    for rival in match.rivals:
        less = angle_deg(S.R) - angle_deg(rival.S_target_source.R)
        if rival.ratio >= LEAST_RATIO and less > DIFFERENT_SIDES_DEG:
            S = rival.S_target_source
    return S if angle_deg(S.R) <= largest_deg else None


# How much of the frames agrees, and contradicts, if each is moved by a turn of the world and the others stay.


@dataclass(frozen=True)
class Judged:
    """Points of pairs of frames that have poses, in frames: 1 is all points of one. Row i is moved, column j stays."""

    agreeing: Float64[ndarray, "n n"]
    contradicting: Float64[ndarray, "n n"]

    def across(self, block: Bool[ndarray, "n"]) -> tuple[float, float]:
        """Points that agree and points that contradict, of the pairs of a frame of the block and another."""
        pairs = np.ix_(block, ~block)
        return float(self.agreeing[pairs].sum()), float(self.contradicting[pairs].sum())

    @property
    def total(self) -> float:
        """Sum of all points that agree."""
        return float(self.agreeing.sum())

    @property
    def share(self) -> float:
        """Share of the points that could be judged which contradict."""
        return share(self.total, float(self.contradicting.sum()))


def share(agreeing: float, contradicting: float) -> float:
    """Share of points that contradict; 1 if there are none at all."""
    return contradicting / (agreeing + contradicting) if agreeing + contradicting else 1.0


def judged(sides: Sequence[Side], nodes: Component, turn: Similarity, neighbours: int) -> Judged:
    """Compare every frame, moved, with `neighbours` others that then look most nearly its way."""
    row = {k: n for n, k in enumerate(nodes)}
    agreeing, contradicting = np.zeros((2, len(row), len(row)))
    for i, j, S in facing(nodes, turn, neighbours):
        found = agreement(sides[i], sides[j], Hypotheses.of(S), Tolerance(0.0, CROSS_SIGMAS))
        agreeing[row[i], row[j]] = found.agreeing[0]
        contradicting[row[i], row[j]] = found.contradicting[0]
    return Judged(agreeing, contradicting)


def facing(nodes: Component, turn: Similarity, neighbours: int) -> Iterator[tuple[int, int, Similarity]]:
    """A moved frame, another that looks nearly its way, and the first in the second's axes."""
    frames = list(nodes)
    sight = np.array([S.R[:, 2] for S in nodes.values()])
    for n, i in enumerate(frames):
        moved = turn @ nodes[i]
        cosine = np.asarray(sight @ moved.R[:, 2], dtype=np.float64)
        cosine[n] = -np.inf
        for k in np.argsort(-cosine, kind="stable")[:neighbours].tolist():
            if cosine[k] > LEAST_SIGHT_COSINE:
                yield i, frames[k], nodes[frames[k]].inverse() @ moved


# A turn that a pair of frames says is off by degrees and by per cents of scale, which moves edges of the object past
# each other. A turn that leaves an object as it is has no scale, and every frame says something of it.


def exact_turn(sides: Sequence[Side], nodes: Component, turn: Similarity) -> Similarity:
    """Gauss-Newton from `turn`: rigid, by the point-to-plane distances of every frame, moved, from those it faces."""
    centre = np.mean([S.points(sides[k].map.centroid[None])[0] for k, S in nodes.items()], axis=0)
    turn = Similarity(1.0, turn.R, turn.points(centre[None])[0] - turn.R @ centre)
    for radii in EXACT_WIDTHS:
        width = Tolerance(radii, KERNEL_SIGMAS)
        H, g = np.zeros((6, 6)), np.zeros(6)
        for i, j, S in facing(nodes, turn, TURN_NEIGHBOURS):
            sums = agreement(sides[i], sides[j], Hypotheses.of(S), width)
            M = _motion_in_camera(nodes[j], sides[j].map.centroid, centre)
            H += M.T @ sums.H[0] @ M
            g += M.T @ sums.g[0] * nodes[j].scale
        step = -np.linalg.lstsq(H, g, rcond=EXACT_RCOND)[0]
        R = Rotation.from_rotvec(step[3:]).as_matrix()
        turn = Similarity(1.0, R, centre - R @ centre + step[:3]) @ turn
    return turn


def _motion_in_camera(
    S_world_camera: Similarity, c_camera: Float64[ndarray, "3"], centre: Float64[ndarray, "3"]
) -> Float64[ndarray, "7 6"]:
    """Matrix by which a motion (v, w) of the world about `centre` moves a camera's points, (v, w, l) about its centre.

    Weighted by the camera's unit, so that distances of all cameras count alike.
    """
    to_camera = S_world_camera.R.T
    arm = S_world_camera.points(c_camera[None])[0] - centre
    M = np.zeros((7, 6))
    M[:3, :3] = to_camera / S_world_camera.scale
    M[:3, 3:] = to_camera @ np.cross(np.eye(3), arm).T / S_world_camera.scale
    M[3:6, 3:] = to_camera
    return M * S_world_camera.scale


def distinct_turns(edges: Sequence[PairMatch], solution: PoseGraphSolution) -> list[Similarity]:
    """Clearly different turns of the world; those that the best pairs say come first."""
    found: list[Similarity] = []
    for turn in _said(edges, solution):
        if abs(np.log(turn.scale)) < LARGEST_LOG_SCALE_OF_TURN and not is_known(turn, found):
            found.append(turn)
    return found


def is_known(turn: Similarity, found: Sequence[Similarity]) -> bool:
    """Whether a turn is the identity, or a duplicate of one of those found, forwards or backwards."""
    known = (Similarity.identity(), *found, *(T.inverse() for T in found))
    return any(angle_deg((turn @ T.inverse()).R) <= SAME_SIDE_DEG for T in known)


def _said(edges: Sequence[PairMatch], solution: PoseGraphSolution) -> Iterator[Similarity]:
    """Motions of the world by which pairs, or their rivals, differ from the solution."""
    nodes, pairs = solution.S_world_camera, zip(edges, solution.consistent, strict=True)
    placed = [(e, used) for e, used in pairs if e.source in nodes and e.target in nodes]
    for e, used in sorted(placed, key=lambda one: (one[1], -quality(one[0]))):
        target, source = nodes[e.target], nodes[e.source].inverse()
        results = [*([] if used else [e.S_target_source]), *(rival.S_target_source for rival in e.rivals)]
        yield from (target @ S @ source for S in results)


# Turns after which the surface looks the same (a nut, a gear, a box): each side of such an object fits wherever another
# one is. Pairs of frames then agree perfectly and still say different things, and which of them is right, surfaces do
# not tell. A pair that fits by accident moves the rest of the surface to where it contradicts; a symmetry does not. Nor
# does any turn about the axis of something round, a vase or a medal: but parts of that turn contradict no more, so it
# is no other side. Nor does half a turn of a leaf on a table, which covers most of its place: parts of it contradict
# only twice as much. Half the turn of a nut contradicts forty times as much.


def symmetric_turns_deg(
    sides: Sequence[Side], edges: Sequence[PairMatch], solution: PoseGraphSolution, others: Sequence[PairMatch] = ()
) -> tuple[float, ...]:
    """Angles of the turns, in degrees, that pairs of registered frames say and that leave the surface as it is.

    `others`: pairs that are not edges of the solution, which may say turns as well.
    """
    nodes = solution.S_world_camera
    fitness = [e.fitness for e, used in zip(edges, solution.consistent, strict=True) if used]
    unused = np.zeros(len(others), dtype=bool)
    with_others = replace(solution, consistent=np.append(solution.consistent, unused))
    said = distinct_turns([*edges, *others], with_others)[:MOST_TURNS]
    if not fitness or not said:
        return ()
    usual = float(np.quantile(fitness, GOOD_QUANTILE))
    as_it_is = judged(sides, nodes, Similarity.identity(), TURN_NEIGHBOURS)
    by_errors = as_it_is.share if as_it_is.total else 0.0
    # as much as a good connection may have: what assembly would take for right is not told from what is
    misfit = by_errors + MISFIT_FACTOR * max(LEAST_MISFIT, 1 - usual)
    turns: list[Similarity] = []
    for one in said:
        turn = exact_turn(sides, nodes, one)
        if angle_deg(turn.R @ one.R.T) > SAME_SIDE_DEG or is_known(turn, turns):
            continue
        turned = judged(sides, nodes, turn, TURN_NEIGHBOURS)
        if turned.total < LEAST_COVERED * as_it_is.total or turned.share > misfit:
            continue
        within = max(judged(sides, nodes, part, TURN_NEIGHBOURS).share for part in _parts(turn))
        if within - by_errors > LEAST_EXCESS * max(turned.share - by_errors, 0.0):
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


# Blocks of frames at the wrong one of several sides: half a bearing block fits on its other half but for an oil cup,
# and two blocks of frames that were joined like this agree over most of their surface. But all pairs across the two
# contradict each other more than those inside, and there is a turn of the world after which one block contradicts the
# other no more. Which frames belong to it is the cut of a graph: weights of its edges are what pairs contradict before
# the turn, less what they do after it.


@dataclass(frozen=True)
class TurnedBlock:
    """Frames that contradict the others less after a turn of the world."""

    frames: tuple[int, ...]
    turn: Similarity
    relief: float  # by how much less, in frames: 1 is all points of one frame


def turned_blocks(
    sides: Sequence[Side], edges: Sequence[PairMatch], solution: PoseGraphSolution, before: Judged
) -> list[TurnedBlock]:
    """The block whose contradictions end by each turn that pairs of frames say; the greatest relief first.

    `before`: the frames of the solution as they are.
    """
    nodes, usual, found = solution.S_world_camera, _usual(before), list[TurnedBlock]()
    contradicting = _excess(before, usual)
    if len(nodes) < FEWEST_FRAMES or contradicting.sum() < LEAST_CONTRADICTING:
        return []
    for turn in distinct_turns(edges, solution)[:MOST_TURNS]:
        after = judged(sides, nodes, turn, BLOCK_NEIGHBOURS)
        block = _best_cut(contradicting - _excess(after, usual))
        if block is None:
            continue
        agreed, contradicted = before.across(block)
        agrees, contradicts = after.across(block)
        if agrees < max(BLOCK_AGREEING, BLOCK_OVERLAP * agreed):
            continue
        if share(agrees, contradicts) < LARGEST_REMAINDER * share(agreed, contradicted):
            inside = tuple(np.array(list(nodes))[block].tolist())
            found.append(TurnedBlock(inside, turn, contradicted - contradicts))
    return sorted(found, key=lambda one: -one.relief)


def _usual(found: Judged) -> float:
    """Share of the points that may contradict: a little more than in the better part of the pairs."""
    total = found.agreeing + found.contradicting
    shares = found.contradicting[total > LEAST_JUDGED] / total[total > LEAST_JUDGED]
    better = float(np.quantile(shares, BETTER_QUANTILE)) if len(shares) else 0.0
    return USUAL_FACTOR * max(better, BLOCK_MISFIT)


def _excess(found: Judged, usual: float) -> Float64[ndarray, "n n"]:
    """What contradicts beyond the usual."""
    return np.maximum(found.contradicting - usual * (found.agreeing + found.contradicting), 0.0)


def _best_cut(relief: Float64[ndarray, "n n"]) -> Bool[ndarray, "n"] | None:
    """The frames whose turn relieves the pairs across most; None if none does.

    Blocks grow from each of the frames that would be relieved most alone, by the frame that is best then, until all but
    one are in it (as in Kernighan and Lin, 1970).
    """
    n, most, best = len(relief), 0.0, None
    for first in np.argsort(-relief.sum(1), kind="stable")[:STARTS].tolist():
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


def turn_blocks_back(graph: ViewGraph) -> None:
    """Register pairs across turned blocks anew, in all components, until no block contradicts the rest of its own."""
    for _ in range(MOST_TURNED):
        if not any(turned_back(graph, component) for component in graph.assemble()):
            return


def turned_back(graph: ViewGraph, component: Component) -> bool:
    """Turn the block of a component back that contradicts most; whether there was one."""
    solution = graph.solve(component)
    before = _as_they_are(graph, solution)
    blocks = turned_blocks(graph.sides, graph.holding(component), solution, before)
    for block in blocks[:MOST_TRIED]:
        moved = {k: solution.S_world_camera[k] for k in component}
        moved |= {k: block.turn @ moved[k] for k in block.frames}
        known = graph.snapshot()
        graph.set_aside(moved, [(i, j) for i in block.frames for j in moved if j not in block.frames])
        graph.try_overlapping(moved)
        if _confirmed(graph, moved, before.share):
            return True
        graph.restore(known)
    return False


def _confirmed(graph: ViewGraph, moved: Component, before: float) -> bool:
    """Whether pairs hold all frames together where they are now, and less contradicts."""
    solution = graph.solve(moved)
    if not graph.connected(moved, solution.consistent):
        return False
    return _as_they_are(graph, solution).share < LEAST_IMPROVEMENT * before


def _as_they_are(graph: ViewGraph, solution: PoseGraphSolution) -> Judged:
    """Judge the frames of a solution where they are."""
    return judged(graph.sides, solution.S_world_camera, Similarity.identity(), BLOCK_NEIGHBOURS)
