"""All frames into one world: pairs, loops, a robust graph, and by name every frame that does not fit.

The result is a camera pose and the length of the baseline of every frame. Lengths are relative: the geometric mean of
the registered frames' baselines is 1 until `known_length` says what one length really is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.progress import track
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.registration.pair_registration import (
    ANYWHERE,
    NEARBY,
    NEIGHBOURS,
    ROUGHLY,
    PairMatch,
    Search,
    agreement_at,
    register_pair,
)
from sl_nerfstudio.registration.pose_graph import Anchoring, Placement, at, loop_support, place
from sl_nerfstudio.registration.rough_poses import about_one_middle, starting_similarities
from sl_nerfstudio.registration.surface_map import SurfaceMap, build_surface_map

_FITNESS = 0.6  # of a pair, below which it is not believed
_AGREEING = 0.15
_UNDECIDED = 0.85  # score of the second best placement, relative to the best
_DOUBTFUL, _LEAST_TRUST = 0.05, 0.02  # fitness below that of good pairs, and what a pair weighs at least
_SLACK_DEG = 3.0  # a rotation known worse than this is not known
_NEIGHBOURS = (1, 2)  # of a sequence: frame n with n + 1 and n + 2
_OVERLAP = 0.25  # expected share of common surface that makes a pair worth registering
_LOOSE = 0.12  # radii: how well surfaces must coincide to count as overlapping before loops are closed
_PARTNERS = 8  # pairs of a frame that are tried for closing loops
_ROUNDS = 2  # of closing loops
_FRAME_FITNESS = 0.55  # of a frame with those it overlaps, in the end


@dataclass(frozen=True)
class Edge:
    """Two frames that were registered with each other."""

    frames: tuple[str, str]
    overlap: float  # share of the points that agree
    fitness: float  # share of those that could be judged
    used: bool  # False: contradicted by the other pairs
    undecided: bool  # a clearly different placement fits nearly as well
    slack_deg: float  # standard deviation of the rotation that this pair determines least


@dataclass(frozen=True)
class Registration:
    """Camera poses in the axes of the first registered frame's camera (looking along -z), and baselines."""

    names: tuple[str, ...]
    T_world_camera: Float64[ndarray, "n 4 4"]  # NaN where not registered
    baseline: Float64[ndarray, "n"]  # camera to projector; geometric mean 1 over the registered frames; NaN elsewhere
    registered: Bool[ndarray, "n"]
    fitness: Float64[ndarray, "n"]  # of each frame with those it overlaps, as placed; NaN where not registered
    edges: tuple[Edge, ...]
    reasons: dict[str, str]  # why a frame was not registered, and what to do
    remarks: tuple[str, ...]  # what is uncertain about the frames that were


def register(
    clouds: Sequence[FrameCloud],
    sequence: bool = True,
    seed: int = 0,
    start: Float64[ndarray, "n 4 4"] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Registration:
    """Place all frames.

    Args:
        clouds: the frames, in the order of capture if `sequence`.
        sequence: each frame overlaps its neighbours; if not, every pair is tried.
        seed: of the choice of points.
        start: camera poses (camera to world) that are known roughly, within about 20 degrees; NaN where unknown.
        progress: told what is being done, in a few words.
    """
    tell = progress or (lambda _: None)
    rng = np.random.default_rng(seed)
    maps = [build_surface_map(c) for c in track(clouds, "averaging surfaces")]
    anchoring = Anchoring(np.stack([m.centroid for m in maps]), np.array([m.radius for m in maps]))
    rough = [None] * len(maps) if start is None else starting_similarities(start, maps)
    middled = about_one_middle(rough, maps)
    state = _State(maps, anchoring, rng, middled)
    tell("registering pairs")
    if start is not None:
        state.pairs_near(rough, _PARTNERS)
        state.pairs_near(middled, _PARTNERS)
    elif sequence:
        for gap in _NEIGHBOURS:
            state.try_pairs([(k, k + gap) for k in range(len(maps) - gap)], NEIGHBOURS)
    else:
        state.try_pairs([(i, j) for i in range(len(maps)) for j in range(i + 1, len(maps))], ANYWHERE)
    for _ in range(_ROUNDS):
        tell("closing loops")
        state.bridge()
        placement = state.placed()
        state.pairs_near(placement.S_world_camera, _PARTNERS)
    return _result(clouds, state)


class _State:
    """Pairs tried so far, and what came of them."""

    def __init__(
        self,
        maps: list[SurfaceMap],
        anchoring: Anchoring,
        rng: np.random.Generator,
        start: Sequence[Similarity | None],
    ) -> None:
        self.maps = maps
        self.anchoring = anchoring
        self.rng = rng
        self.start = start  # rough placement of frames where one is known
        self.tried: dict[tuple[int, int], PairMatch | None] = {}
        self.searched: set[tuple[tuple[int, int], Search]] = set()

    @property
    def edges(self) -> list[PairMatch]:
        """Pairs that are believed for the time being."""
        return [e for e in self.tried.values() if e is not None and e.fitness > _FITNESS and e.agreeing > _AGREEING]

    def try_pairs(self, pairs: Sequence[tuple[int, int]], search: Search) -> None:
        """Register pairs without a guess, or from about where both are known to be."""
        for pair in track([p for p in pairs if (p, search) not in self.searched], "registering pairs"):
            self.searched.add((pair, search))
            a, b = self.start[pair[0]], self.start[pair[1]]
            guess = None if a is None or b is None else b.inverse() @ a
            how = search if guess is None else ROUGHLY
            self._keep(pair, register_pair((self.maps[pair[0]], self.maps[pair[1]]), pair, how, self.rng, guess))

    def pairs_near(self, S_world_camera: Sequence[Similarity | None], partners: int) -> None:
        """Register pairs that overlap as placed, starting from there."""
        for i, j in track(self._overlapping(S_world_camera, partners), "closing loops"):
            a, b = S_world_camera[i], S_world_camera[j]
            if a is None or b is None:
                continue
            guess = b.inverse() @ a
            self._keep((i, j), register_pair((self.maps[i], self.maps[j]), (i, j), NEARBY, self.rng, guess))

    def _keep(self, pair: tuple[int, int], match: PairMatch | None) -> None:
        known = self.tried.get(pair)
        if known is None or (match is not None and _worth(match) > _worth(known)):
            self.tried[pair] = match

    def _overlapping(self, S: Sequence[Similarity | None], partners: int) -> list[tuple[int, int]]:
        """For every frame the pairs with the largest expected overlap that were not tried yet."""
        pairs: set[tuple[int, int]] = set()
        n = len(S)
        shares = np.zeros((n, n))
        for i in range(n):
            for j in range(i + 1, n):
                a, b = S[i], S[j]
                if a is not None and b is not None and _facing_alike(a, b):
                    found = agreement_at((self.maps[i], self.maps[j]), b.inverse() @ a, self.rng, _LOOSE)
                    shares[i, j] = shares[j, i] = found.agreeing[0]
        for i in range(n):
            for j in np.argsort(-shares[i], kind="stable")[:partners]:
                if shares[i, j] > _OVERLAP:
                    pairs.add((min(i, int(j)), max(i, int(j))))
        return sorted(p for p in pairs if self.tried.get(p) is None or self.tried[p] not in self.edges)

    def placed(self) -> Placement:
        """The largest group of frames that believed pairs hold together."""
        edges = self.edges
        root = _best_root(edges, len(self.maps))
        trust = trust_in(edges)
        # A spanning tree should prefer loops that close, then surfaces that agree without a rival.
        strength = 5 * loop_support(edges, self.anchoring, trust) + np.array([_worth(e) for e in edges])
        return place(edges, self.anchoring, root, strength, trust)

    def bridge(self) -> None:
        """Where groups of frames hang apart, search between them everywhere: one may stand on its head."""
        groups = _groups(self.edges, len(self.maps))
        if len(groups) < 2:
            return
        main = groups[0]
        outside = [k for group in groups[1:] for k in group]
        pairs = set()
        for k in outside:
            pairs |= {(min(k, m), max(k, m)) for m in sorted(main, key=lambda m: abs(m - k))[:4]}
        self.try_pairs(sorted(pairs), ANYWHERE)


def trust_in(edges: Sequence[PairMatch]) -> Float64[ndarray, "edges"]:
    """What each pair weighs: less where its surfaces agree less than those of the scan's good pairs do.

    On smooth surfaces frames slide: neighbours that are placed wrongly all in the same way support each other in loops,
    and outnumber the right pairs. But they fit a little worse.
    """
    fitness = np.array([e.fitness for e in edges])
    if not len(fitness):
        return fitness
    doubt = np.maximum(np.quantile(fitness, 0.75) - fitness, 0) / _DOUBTFUL
    undecided = np.array([0.5 if e.rival > _UNDECIDED else 1.0 for e in edges])
    return np.maximum(np.exp(-(doubt**2)) * undecided, _LEAST_TRUST)


def _worth(e: PairMatch) -> float:
    return e.agreeing * e.fitness**2 * (1.0 if e.rival < _UNDECIDED else 0.5)


def _facing_alike(a: Similarity, b: Similarity) -> bool:
    """Whether two cameras look into directions less than 75 degrees apart."""
    return bool(a.R[:, 2] @ b.R[:, 2] > np.cos(np.radians(75)))


def _groups(edges: Sequence[PairMatch], n: int) -> list[list[int]]:
    """Connected groups of frames, the largest first."""
    label = list(range(n))
    for e in edges:
        a, b = label[e.source], label[e.target]
        label = [a if x == b else x for x in label]
    groups = [[k for k in range(n) if label[k] == x] for x in dict.fromkeys(label)]
    return sorted(groups, key=len, reverse=True)


def _best_root(edges: Sequence[PairMatch], n: int) -> int:
    return _groups(edges, n)[0][0]


def _result(clouds: Sequence[FrameCloud], state: _State) -> Registration:
    """Poses and lengths of what holds together; everything else with its reason."""
    edges = state.edges
    placement = state.placed()
    held = _held(edges, placement, len(clouds))
    fitness = np.array([_fitness_of(k, placement, held, state) for k in range(len(clouds))])
    registered = held & (fitness >= _FRAME_FITNESS)
    poses, baseline = np.full((len(clouds), 4, 4), np.nan), np.full(len(clouds), np.nan)
    placed = [k for k in np.flatnonzero(registered).tolist() if placement.S_world_camera[k] is not None]
    if placed:
        world = [at(placement.S_world_camera, k) for k in placed]
        unit = float(np.exp(np.mean([np.log(S.scale) for S in world])))
        gauge = Similarity(1 / unit, np.eye(3), np.zeros(3)) @ Similarity(1.0, world[0].R, world[0].t).inverse()
        for k, S in zip(placed, (gauge @ S for S in world), strict=True):
            baseline[k] = S.scale
            poses[k] = np.eye(4)
            poses[k, :3, :3], poses[k, :3, 3] = S.R, S.t
    names = tuple(c.name for c in clouds)
    return Registration(
        names,
        poses,
        baseline,
        registered,
        np.where(registered, fitness, np.nan),
        tuple(
            Edge((names[e.source], names[e.target]), e.agreeing, e.fitness, bool(used), e.rival > _UNDECIDED,
                 e.slack_deg)
            for e, used in zip(edges, placement.used, strict=True)
        ),
        {names[k]: _reason(k, names, state, held, fitness) for k in np.flatnonzero(~registered).tolist()},
        _remarks(names, edges, placement, registered),
    )  # fmt: skip


def _held(edges: Sequence[PairMatch], placement: Placement, n: int) -> Bool[ndarray, "n"]:
    """Frames of the largest group that pairs hold together which agree with the placement."""
    good = [e for e, used in zip(edges, placement.used, strict=True) if used]
    group = _groups(good, n)[0]
    held = np.zeros(n, dtype=bool)
    if len(group) > 1:
        held[group] = True
    return held


def _fitness_of(k: int, placement: Placement, held: Bool[ndarray, "n"], state: _State) -> float:
    """Of a frame's points that other frames could judge, the share that agrees, as placed."""
    S = placement.S_world_camera[k]
    if S is None or not held[k]:
        return 0.0
    agreeing = judged = 0.0
    for j in np.flatnonzero(held).tolist():
        other = placement.S_world_camera[j]
        if j == k or other is None or not _facing_alike(S, other):
            continue
        found = agreement_at((state.maps[k], state.maps[j]), other.inverse() @ S, state.rng)
        agreeing += found.agreeing[0]
        judged += found.agreeing[0] + found.in_front[0] + found.behind[0]
    return agreeing / judged if judged else 0.0


def _reason(
    k: int, names: Sequence[str], state: _State, held: Bool[ndarray, "n"], fitness: Float64[ndarray, "n"]
) -> str:
    mine = [e for e in state.tried.values() if e is not None and k in (e.source, e.target)]
    if held[k]:
        return (
            f"where its pairs put it, only {fitness[k]:.0%} of its surface agrees with that of other frames; "
            "the object moved, or the relative pose of this frame is wrong: capture this view again"
        )
    if not mine:
        return "nothing of its surface was found in another frame; capture views in between"
    best = max(mine, key=_worth)
    other = names[best.target if best.source == k else best.source]
    if best.fitness > _FITNESS and best.agreeing > _AGREEING:
        return (
            f"its best partner, {other}, contradicts where the other frames put it (or hangs apart from them, too); "
            "capture views in between"
        )
    return (
        f"its best partner, {other}, shares {best.agreeing:.0%} of the surface, and {best.fitness:.0%} of what both "
        f"saw agrees (needed: {_AGREEING:.0%} and {_FITNESS:.0%}); capture views in between"
    )


def _remarks(
    names: Sequence[str], edges: Sequence[PairMatch], placement: Placement, registered: Bool[ndarray, "n"]
) -> tuple[str, ...]:
    """What the registered frames' placement rests on, where that is little."""
    good = [e for e, used in zip(edges, placement.used, strict=True) if used]
    out = []
    for k in np.flatnonzero(registered).tolist():
        mine = [e for e in good if k in (e.source, e.target)]
        if mine and all(e.rival > _UNDECIDED for e in mine):
            out.append(f"{names[k]}: a clearly different placement fits nearly as well (symmetric surface?)")
        elif mine and min(e.slack_deg for e in mine) > _SLACK_DEG:
            out.append(
                f"{names[k]}: its rotation is known to {min(e.slack_deg for e in mine):.1f} deg only (surface of "
                "revolution?)"
            )
    return tuple(out)
