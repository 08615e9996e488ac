"""The view graph: which pairs of frames have been registered with each other, and which to try next."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.parallel import tracked
from sl_nerfstudio.registration.agreement import AGREEING_SIGMAS, COARSE_POINTS, Side, Tolerance, agreement_at
from sl_nerfstudio.registration.assembly import Assembly, see_same_side
from sl_nerfstudio.registration.blocks import BlockReview, OpenBlock
from sl_nerfstudio.registration.evidence import Commonness, Frame, ScanEvidence
from sl_nerfstudio.registration.pairs import (
    ANYWHERE,
    LEAST_ODDS,
    NEARBY,
    ROUGH,
    SAME_ROTATION_DEG,
    SAME_SHIFT,
    PairMatch,
    Search,
    is_accepted,
    register_pair,
    search_score,
)
from sl_nerfstudio.registration.pose_graph import (
    Component,
    Pivots,
    PoseGraphSolution,
    optimise_known,
)
from sl_nerfstudio.registration.surfaces import SurfaceMap

EXPECTED_OVERLAP = 0.25  # share of common surface that makes a pair worth registering
OVERLAP_TOLERANCE = 0.12  # radii within which surfaces count as overlapping before cycles are closed
PARTNERS = 8  # pairs of each frame that are tried for closing cycles
COMPARED_FRAMES = 40  # with which each frame is compared to find those: the nearest lines of sight, or random ones
LIKELY_PARTNERS = 8  # frames with which each is registered where no order is known: those that look most alike
BRIDGED = 4  # components, the largest ones, that are bridged with all others
BRIDGES = 8  # pairs of frames across two components that are registered in order to join them
BRIDGES_COMPARED = 40  # pairs across of which those that look most alike are chosen
BRIDGES_NEARBY = 3  # how many of the bridges are pairs taken one soon after the other
LEAST_STEPS = 0.5  # share of the successive frames that must fit each other, and turn by the usual step, for one
LEAST_STEP_DEG = 2.0  # of successive frames
STEPS_DEG = np.geomspace(1.0, 100.0, 60)  # that are compared
LARGEST_STEP_DEG = 40.0  # of someone who walks around an object
UNUSUAL_DENSITY = 1 / 180  # of a turn that is not the usual one, per degree
LEAST_SPREAD = 0.3  # of the usual step, relative to it
LARGEST_GAP = 2  # between frames by which the usual step is learnt
MOST_BY_ORDER = 25.0  # nats against a place by the order: someone may have walked to the other side
LEAST_DISTANCE = 0.2  # of a camera from the object, relative to the median, for its rough pose to be used

# Pairs that only tones hold: where the shape leaves a turn open, two tones may agree by accident anywhere. Three pairs
# that close a cycle do not.


def with_confirmed_tones(edges: Sequence[PairMatch], pivots: Pivots) -> list[PairMatch]:
    """The pairs in their order; those that tones hold and no cycle of three confirms are taken to slip."""
    held: defaultdict[int, dict[int, PairMatch]] = defaultdict(dict)
    for e in edges:
        if e.holds:
            held[e.source][e.target] = held[e.target][e.source] = e

    def confirmed(e: PairMatch) -> bool:
        """Whether the way over a third frame leads to the same similarity."""
        here, there = held[e.source], held[e.target]
        around = (there[k].between(k, e.target) @ here[k].between(e.source, k) for k in here.keys() & there.keys())
        return any(_same(e.S_target_source, S, pivots, e.source) for S in around)

    return [e.by_shape if e.by_shape is not None and not confirmed(e) else e for e in edges]


def _same(a: Similarity, b: Similarity, pivots: Pivots, frame: int) -> bool:
    """Whether two similarities turn a frame alike, and put its centre at about the same place."""
    if angle_deg(a.R @ b.R.T) > SAME_ROTATION_DEG:
        return False
    centre = pivots.centre[frame][None]
    shift = float(np.linalg.norm(a.points(centre) - b.points(centre)))
    return shift < SAME_SHIFT * a.scale * float(pivots.radius[frame])


# Camera poses that a user knows roughly, as a start of registration: the baselines that fit them are found here.


def starting_similarities(T_world_camera: Float64[ndarray, "n 4 4"], maps: Sequence[SurfaceMap]) -> Component:
    """`S_world_camera` of the frames with known camera poses; a pose that holds NaN is unknown.

    The clouds of all frames must lie at about the same place. The baselines are therefore those for which all
    centroids, each on its own ray, come nearest to one point (linear least squares).
    """
    known = [k for k in range(len(maps)) if np.isfinite(T_world_camera[k]).all()]
    if not known:
        return {}
    A, b = np.zeros((3 * len(known), len(known) + 3)), np.zeros(3 * len(known))
    for row, k in enumerate(known):
        T, rows = T_world_camera[k], slice(3 * row, 3 * row + 3)
        ray = T[:3, :3] @ maps[k].centroid
        # Unit rays: only their directions count, whatever unit the baseline makes.
        A[rows, row] = ray / np.linalg.norm(ray)
        A[rows, len(known) :] = -np.eye(3)
        b[rows] = -T[:3, 3]
    distances = np.linalg.lstsq(A, b, rcond=None)[0][: len(known)]
    positive = distances[distances > 0]
    typical = float(np.median(positive)) if len(positive) else 1.0
    out: Component = {}
    for k, found in zip(known, distances, strict=True):
        distance = found if found > LEAST_DISTANCE * typical else typical
        T = T_world_camera[k]
        out[k] = Similarity(float(distance / np.linalg.norm(maps[k].centroid)), T[:3, :3], T[:3, 3])
    return out


def with_common_centre(S_world_camera: Component, maps: Sequence[SurfaceMap]) -> Component:
    """Move each so that the centres of what the frames see lie in one place.

    A camera that is rotated wrongly by a few degrees looks past the object by more than the object's size. Its rotation
    is still a good start.
    """
    centres = {k: S.points(maps[k].views[0].centre[None])[0] for k, S in S_world_camera.items()}
    common = np.median(list(centres.values()), axis=0) if centres else np.zeros(3)
    return {k: Similarity(S.scale, S.R, S.t + common - centres[k]) for k, S in S_world_camera.items()}


Pair = tuple[int, int]


@dataclass(frozen=True)
class UsualStep:
    """The angle by which cameras of successive frames usually turn, and its standard deviation, degrees."""

    deg: float
    sigma_deg: float


class ViewGraph:
    """Pairs that were tried, with the best result of each."""

    def __init__(self, frames: list[Frame], start: Component, rng: np.random.Generator) -> None:
        self.frames = frames
        self.maps = [frame.map for frame in frames]
        self.rng = rng
        self._start = start  # S_world_camera of frames where it is known roughly
        self.pivots = Pivots(np.stack([m.centroid for m in self.maps]), np.array([m.radius for m in self.maps]))
        self.sides = [Side.sampled(m, COARSE_POINTS, rng) for m in self.maps]
        self.step: UsualStep | None = None  # None: the order of capture says nothing
        self._tried: dict[Pair, PairMatch | None] = {}
        self._searched: set[tuple[Pair, Search]] = set()
        self.open: list[OpenBlock] = []  # what the last assembly left undecided
        self.turns_deg: tuple[float, ...] = ()  # after which surfaces look the same
        self.by_order = False  # the order of capture has decided places that surfaces did not

    @property
    def matches(self) -> list[PairMatch]:
        """All pairs in which anything agreed."""
        return [match for match in self._tried.values() if match is not None]

    @property
    def edges(self) -> list[PairMatch]:
        """Pairs that agree well enough; what only the tones of two frames say counts if a third frame confirms it."""
        accepted = [match for match in self.matches if is_accepted(match)]
        return with_confirmed_tones(accepted, self.pivots)

    def try_pairs(self, pairs: Sequence[Pair], search: Search) -> None:
        """Register pairs without a guess, or from the rough poses of both where there are any."""
        new = [p for p in pairs if (p, search) not in self._searched]
        self._searched |= {(p, search) for p in new}
        guesses = [_relative(self._start, p) for p in new]
        trials = [(p, ROUGH if g else search, g) for p, g in zip(new, guesses, strict=True)]
        self._register(trials, "registering pairs")

    def try_overlapping(self, S_world_camera: Component) -> None:
        """Register pairs that should overlap by the given poses, starting from there."""
        pairs = self._overlapping(S_world_camera)
        guesses = [_relative(S_world_camera, p) for p in pairs]
        trials = [(p, NEARBY, g) for p, g in zip(pairs, guesses, strict=True) if g]
        self._register(trials, "closing loops")

    def try_all(self) -> None:
        """Register every frame with those that look most like it, wherever they are in the order."""
        n = len(self.maps)
        likeness = np.full((n, n), -np.inf)
        rank = np.zeros((n, n)) if n - 1 <= COMPARED_FRAMES else self.rng.random((n, n))
        compared = compared_pairs(rank, COMPARED_FRAMES)
        for (i, j), score in zip(compared, self._likeness(compared), strict=True):
            likeness[i, j] = likeness[j, i] = score
        pairs = {
            (min(i, j), max(i, j))
            for i in range(n)
            for j in np.argsort(-likeness[i], kind="stable")[:LIKELY_PARTNERS].tolist()
            if i != j
        }
        self.try_pairs(sorted(pairs), ANYWHERE)

    def bridge(self, components: Sequence[Component]) -> None:
        """Search between the largest components and all others, everywhere: one may be upside down."""
        pairs: set[Pair] = set()
        for number, first in enumerate(components[:BRIDGED]):
            for second in components[number + 1 :]:
                pairs |= set(self.bridges(first, second))
        self.try_pairs(sorted(pairs), ANYWHERE)

    def bridges(self, first: Component, second: Component) -> list[Pair]:
        """Pairs across two components: those taken one soon after the other, and those that look most alike."""
        pairs = [(min(i, j), max(i, j)) for i in first for j in second]
        nearby = sorted(pairs, key=lambda p: p[1] - p[0])[:BRIDGES_NEARBY]
        others = [p for p in pairs if p not in nearby]
        some = [others[k] for k in self.rng.permutation(len(others))[:BRIDGES_COMPARED]]
        alike = np.argsort(-np.array(self._likeness(some)), kind="stable")
        return nearby + [some[k] for k in alike[: BRIDGES - len(nearby)]]

    def assemble(self) -> list[Component]:
        """Components of frames whose connection is certain, the largest first.

        Pairs that may slip connect nothing, unless all of them may: then the surface is one of revolution, and its
        frames are put together all the same.
        """
        edges, scan = self.edges, self.evidence()
        self.by_order, self.open, self.turns_deg = False, [], ()
        assembly = self.assembly([e for e in edges if e.holds], scan)
        components = assembly.grow()
        if len(components[0]) == 1:
            return self.assembly(edges, scan).grow()
        found, turns = list[Component](), set[float]()
        for component in components:
            if len(component) == 1:
                found.append(component)
                continue
            one = BlockReview(assembly, component).settled()
            found += [one.decided, *(block.nodes for block in one.open)]
            self.open += one.open
            turns |= set(one.turns_deg)
            self.by_order |= one.by_order
        self.turns_deg = tuple(sorted(turns))
        return sorted(found, key=lambda c: (-len(c), min(c)))

    def assembly(self, edges: Sequence[PairMatch], scan: ScanEvidence) -> Assembly:
        """Frames that pairs may join."""
        return Assembly(scan, self.pivots, edges, self.usual_step)

    def evidence(self) -> ScanEvidence:
        """All frames, with what pairs have shown of their points."""
        frames = [frame.evidence for frame in self.frames]
        common = [Commonness.none(len(frame.points)) for frame in frames]
        noise: list[list[float]] = [[] for _ in frames]
        for match in self.matches:
            for k, each, size in zip((match.source, match.target), match.common, match.noise, strict=True):
                common[k] = common[k] + each
                noise[k].append(size)
        return ScanEvidence(frames, common, np.array([np.median(each) if each else 1.0 for each in noise]))

    def learn_step(self) -> None:
        """By how much successive frames usually turn: what makes the places that all their pairs allow most likely.

        Large turns are those of frames in no order.
        """
        pairs = [e for e in self.edges if abs(e.target - e.source) <= LARGEST_GAP and e.holds]
        if sum(abs(e.target - e.source) == 1 for e in pairs) <= LEAST_STEPS * (len(self.frames) - 1):
            self.step = None
            return
        steps = [UsualStep(deg, max(LEAST_SPREAD * deg, LEAST_STEP_DEG)) for deg in STEPS_DEG]
        step = max(steps, key=lambda step: sum(math.log(sum(_densities(e, step))) for e in pairs))
        usual = [_densities(e, step) for e in pairs]
        share = np.mean([known / (known + unusual) for known, unusual in usual])
        self.step = step if step.deg <= LARGEST_STEP_DEG and share >= LEAST_STEPS else None

    def usual_step(self, i: int, j: int, S_i_j: Similarity) -> float:
        """Log-odds of the place of one frame on another by the order of capture."""
        if self.step is None or abs(i - j) > 1:
            return 0.0
        off = (angle_deg(S_i_j.R) - self.step.deg) / self.step.sigma_deg
        return -min(0.5 * off**2, MOST_BY_ORDER)

    def solve(self, component: Component) -> PoseGraphSolution:
        """A component with the pairs that hold it optimised together, each where its frames are."""
        return optimise_known(self.holding(component), self.pivots, component)

    def holding(self, component: Component) -> list[PairMatch]:
        """The pairs, without those inside a component that may slip, if the others hold it together."""
        return without_slipping(self.edges, component)

    def _register(self, trials: Sequence[tuple[Pair, Search, Similarity | None]], words: str) -> None:
        """Register pairs, and keep the better result of a pair that was tried before."""
        rngs = self.rng.spawn(len(trials))
        tasks = [
            partial(register_pair, self._frames(pair), pair, search, rng, guess, self._known(pair))
            for (pair, search, guess), rng in zip(trials, rngs, strict=True)
        ]
        for (pair, _, _), match in zip(trials, tracked(tasks, words), strict=True):
            if match is not None or pair not in self._tried:
                self._tried[pair] = match

    def _likeness(self, pairs: Sequence[Pair]) -> list[float]:
        """Score of the best of all starts of each pair."""
        rngs = self.rng.spawn(len(pairs))
        tasks = [partial(search_score, self._maps(pair), ANYWHERE, rng) for pair, rng in zip(pairs, rngs, strict=True)]
        return tracked(tasks, "comparing frames")

    def _frames(self, pair: Pair) -> tuple[Frame, Frame]:
        return self.frames[pair[0]], self.frames[pair[1]]

    def _known(self, pair: Pair) -> list[Similarity]:
        """Places of a pair that an earlier search has found."""
        match = self._tried.get(pair)
        return [] if match is None else likely_places(match)

    def _maps(self, pair: Pair) -> tuple[SurfaceMap, SurfaceMap]:
        return self.maps[pair[0]], self.maps[pair[1]]

    def _overlapping(self, S_world_camera: Component) -> list[Pair]:
        """For every frame the pairs with the largest expected overlap, without those that are edges already."""
        n = len(self.maps)
        tolerance = Tolerance(OVERLAP_TOLERANCE, AGREEING_SIGMAS)
        shares = np.zeros((n, n))
        sight = np.full((n, 3), np.nan)
        for k, S in S_world_camera.items():
            sight[k] = S.R[:, 2]
        for i, j in compared_pairs(-sight @ sight.T, COMPARED_FRAMES):
            a, b = S_world_camera.get(i), S_world_camera.get(j)
            if a is not None and b is not None and see_same_side(a, b):
                maps, S = (self.maps[i], self.maps[j]), b.inverse() @ a
                found = agreement_at(maps, S, self.rng, tolerance)
                shares[i, j] = shares[j, i] = found.agreeing[0]
        pairs: set[Pair] = set()
        for i in range(n):
            for j in np.argsort(-shares[i], kind="stable")[:PARTNERS].tolist():
                if shares[i, j] > EXPECTED_OVERLAP:
                    pairs.add((min(i, j), max(i, j)))
        edges = {pair for pair, match in self._tried.items() if match is not None and is_accepted(match)}
        return sorted(pairs - edges)


def _densities(e: PairMatch, step: UsualStep) -> tuple[float, float]:
    """Of the turn of a pair, over the places that it allows: by the usual step, and of a turn by anything."""
    angle = np.array([angle_deg(one.S_target_source.R) for one in e.places])
    odds = np.array([one.log_odds for one in e.places])
    odds = np.exp(odds - odds.max())
    off = (angle / abs(e.target - e.source) - step.deg) / step.sigma_deg
    usual = np.exp(-0.5 * off**2) / (step.sigma_deg * math.sqrt(2 * math.pi))
    return float((usual * odds).sum() / odds.sum()), UNUSUAL_DENSITY


def likely_places(match: PairMatch) -> list[Similarity]:
    """Where a pair may belong: its best place, and those that are nearly as likely."""
    return [one.S_target_source for one in match.places if one.log_odds > -LEAST_ODDS]


def compared_pairs(rank: Float64[ndarray, "n n"], most: int) -> list[Pair]:
    """Pairs (i, j) with i < j of each frame and the `most` others that rank lowest with it (NaN: last), in order."""
    n = len(rank)
    others = rank.copy()
    np.fill_diagonal(others, np.nan)
    nearest = np.argsort(others, axis=1, kind="stable")[:, : min(most, n - 1)]
    chosen = np.zeros((n, n), dtype=bool)
    chosen[np.arange(n)[:, None], nearest] = True
    first, second = np.nonzero(np.triu(chosen | chosen.T, 1))
    return list(zip(first.tolist(), second.tolist(), strict=True))


def without_slipping(edges: Sequence[PairMatch], component: Component) -> list[PairMatch]:
    """The pairs without those inside a component that may slip, if the others connect it."""
    if not _connected(component, [e for e in edges if e.holds]):
        return list(edges)
    return [e for e in edges if e.holds or e.source not in component or e.target not in component]


def _connected(component: Component, edges: Sequence[PairMatch]) -> bool:
    """Whether pairs inside a component lead from each of its frames to every other."""
    inside = [(e.source, e.target) for e in edges if e.source in component and e.target in component]
    if not inside:
        return len(component) < 2
    place = {frame: k for k, frame in enumerate(component)}
    rows, columns = np.array([(place[i], place[j]) for i, j in inside]).T
    size = len(component)
    links = coo_array((np.ones(len(inside)), (rows, columns)), shape=(size, size))
    return bool(connected_components(links, directed=False)[0] == 1)


def _relative(nodes: Component, pair: Pair) -> Similarity | None:
    """The second frame of a pair from the first, where both are known."""
    a, b = nodes.get(pair[0]), nodes.get(pair[1])
    return None if a is None or b is None else b.inverse() @ a
