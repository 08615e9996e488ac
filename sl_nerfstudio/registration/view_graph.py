"""The view graph: which pairs of frames have been registered with each other, and which to try next."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.geometry.numerics import component_labels
from sl_nerfstudio.parallel import tracked
from sl_nerfstudio.registration.agreement import AGREEING_SIGMAS, COARSE_POINTS, Hypotheses, Side, Tolerance, agreement
from sl_nerfstudio.registration.assembly import Assembly, see_same_side
from sl_nerfstudio.registration.blocks import BlockReview, OpenBlock, Sides
from sl_nerfstudio.registration.evidence import Commonness, Frame, KeptResiduals, ScanEvidence
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
from sl_nerfstudio.registration.pose_graph import Component, Pivots, PoseGraphSolution, optimise_known
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
LEAST_STEP_DEG = 2.0  # spread of the turns of successive frames
LEAST_SPREAD = 0.3  # the same, relative to the usual turn
SPREAD_COUNT = 4.0  # turns that this spread counts as
LARGEST_STEP_DEG = 40.0  # of someone who walks around an object
NO_ORDER_DEG = 25.0  # spread of the turns of frames in no order that see a common surface
SMALL_STEP_DEG = 10.0  # of steps that surfaces allow alike smaller ones are likelier: scale of their distribution
ORDER_ODDS = 5.0  # nats by which an order must be likelier than none: sets in order have 12 to 45, others -6 to 0
SHARED_ERRORS = 3.0  # by which nats of places are divided there: errors that pixels share let wrong ones lead by a few
LEAST_LIKELIHOOD = 1e-300  # so that what nothing explains has a logarithm
STEP_STARTS, STEP_ROUNDS = 80, 12  # of the search for the usual step
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
    """How the camera usually turns from one frame to the next: someone walks around an object one way."""

    mean_deg: Float64[ndarray, "3"]  # rotation vector in the earlier camera's axes
    covariance: Float64[ndarray, "3 3"]  # square degrees

    @property
    def deg(self) -> float:
        """Angle of the usual turn."""
        return float(np.linalg.norm(self.mean_deg))

    def repeated(self, count: int) -> "UsualStep":
        """Several steps, one after the other."""
        return UsualStep(count * self.mean_deg, count * self.covariance)

    @property
    def rms_deg(self) -> float:
        """Root mean square of the turns' angles."""
        return float(np.hypot(self.deg, np.sqrt(np.trace(self.covariance))))

    def log_density(self, turn_deg: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n"]:
        """Of rotation vectors."""
        size = float(np.linalg.slogdet(2 * np.pi * self.covariance)[1])
        return -0.5 * (self.squared_sigmas(turn_deg) + size)

    def squared_sigmas(self, turn_deg: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n"]:
        """How far rotation vectors are from the usual one."""
        d = turn_deg - self.mean_deg
        return np.einsum("ni,ni->n", d, np.linalg.solve(self.covariance, d.T).T)


NO_ORDER = UsualStep(np.zeros(3), NO_ORDER_DEG**2 * np.eye(3))


class ViewGraph:
    """Pairs that were tried, with the best result of each."""

    def __init__(
        self, frames: list[Frame], start: Component, rng: np.random.Generator, captures: Sequence[int] | None = None
    ) -> None:
        """Start without any pair; `start`: nodes that are known roughly. `captures`: see `register`."""
        self.frames = frames
        self.captures = list(range(len(frames)) if captures is None else captures)
        self.maps = [frame.map for frame in frames]
        self.rng = rng
        self._start = start  # S_world_camera of frames where it is known roughly
        self.pivots = Pivots(np.stack([m.centroid for m in self.maps]), np.array([m.radius for m in self.maps]))
        self.sides = [Side.sampled(m, COARSE_POINTS, rng) for m in self.maps]
        self.step: UsualStep | None = None  # None: the order of capture says nothing
        self._residuals = KeptResiduals([frame.evidence for frame in frames])
        self._tried: dict[Pair, PairMatch | None] = {}
        self._searched: set[tuple[Pair, Search]] = set()
        self.open: list[OpenBlock] = []  # what the last assembly left undecided
        self._reviews: list[BlockReview] = []  # of the last assembly
        self._components: list[Component] | None = None  # of it, while nothing new is known

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
        if self._components is None:
            self._components = self._assembled()
        return self._components

    def _assembled(self) -> list[Component]:
        edges, scan = self.edges, self.evidence()
        self._reviews, self.open = [], []
        assembly = self.assembly([e for e in edges if e.holds], scan)
        components = assembly.grow()
        if len(components[0]) == 1:
            return self.assembly(edges, scan).grow()
        found: list[Component] = []
        left: list[tuple[Component, OpenBlock | None]] = [(component, None) for component in components]
        while left:
            component, block = left.pop(0)
            if len(component) == 1:
                found.append(component)
                self.open += [] if block is None else [block]
                continue
            self._reviews.append(BlockReview(assembly, component))
            one = self._reviews[-1].settled()
            found.append(one.decided)
            self.open += [] if block is None else [replace(block, nodes=one.decided)]
            left += [(inner.nodes, inner) for inner in one.open]  # what holds together inside is not known yet
        return sorted(found, key=lambda c: (-len(c), min(c)))

    def sides_of_object(self) -> Sides:
        """What surfaces alone say of the sides of the object, in the last assembly."""
        found = [review.sides() for review in self._reviews]
        return Sides(
            tuple(sorted({k for one in found for k in one.by_order})),
            tuple(sorted({turn for one in found for turn in one.turns_deg})),
        )

    def assembly(self, edges: Sequence[PairMatch], scan: ScanEvidence) -> Assembly:
        """Frames that pairs may join."""
        return Assembly(scan, self.pivots, edges, self.usual_step)

    def evidence(self) -> ScanEvidence:
        """All frames, with what pairs have shown of their points."""
        common = [Commonness.none(len(frame.evidence.points)) for frame in self.frames]
        noise: list[list[float]] = [[] for _ in self.frames]
        for match in self.matches:
            for k, each, size in zip((match.source, match.target), match.common, match.noise, strict=True):
                common[k] = common[k] + each
                noise[k].append(size)
        return ScanEvidence(self._residuals, common, np.array([np.median(each) if each else 1.0 for each in noise]))

    def learn_step(self) -> None:
        """How the camera usually turns between successive frames: what makes the places of their pairs likeliest.

        None if turns do not grow with the number of frames that lie between, as those in no order do not.
        """
        self.step = self._components = None
        pairs = [e for e in self.edges if abs(self._steps(e.source, e.target)) <= LARGEST_GAP and e.holds]
        if sum(abs(e.target - e.source) == 1 for e in pairs) <= LEAST_STEPS * (len(self.frames) - 1):
            return
        turns = Turns.of(pairs, [self._steps(e.source, e.target) for e in pairs])
        (step, odds), (_, without) = likeliest_step(turns), likeliest_step(turns.in_no_order())
        usual = step.rms_deg <= LARGEST_STEP_DEG and turns.probability(step).mean() >= LEAST_STEPS
        if usual and odds >= without + ORDER_ODDS:
            self.step = step

    def usual_step(self, i: int, j: int, S_i_j: Similarity) -> float:
        """Log-odds of the place of one frame on another by the order of capture."""
        if self.step is None or abs(i - j) > 1:
            return 0.0
        turn = turn_deg(S_i_j if j > i else S_i_j.inverse())
        usual = self.step.repeated(abs(self._steps(i, j)))  # captures between them may show nothing
        return -min(0.5 * float(usual.squared_sigmas(turn[None])[0]), MOST_BY_ORDER)

    def _steps(self, first: int, second: int) -> int:
        """Steps of the camera from one frame to another."""
        return self.captures[second] - self.captures[first]

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
            partial(register_pair, (self.frames[i], self.frames[j]), (i, j), search, rng, guess, self._known((i, j)))
            for ((i, j), search, guess), rng in zip(trials, rngs, strict=True)
        ]
        if trials:
            self._components = None
        for (pair, _, _), match in zip(trials, tracked(tasks, words), strict=True):
            if match is not None or pair not in self._tried:
                self._tried[pair] = match

    def _likeness(self, pairs: Sequence[Pair]) -> list[float]:
        """Score of the best of all starts of each pair."""
        rngs = self.rng.spawn(len(pairs))
        tasks = [
            partial(search_score, (self.maps[i], self.maps[j]), ANYWHERE, rng)
            for (i, j), rng in zip(pairs, rngs, strict=True)
        ]
        return tracked(tasks, "comparing frames")

    def _known(self, pair: Pair) -> list[Similarity]:
        """Where an earlier search has found that a pair may belong."""
        match = self._tried.get(pair)
        return [] if match is None else [one.S_target_source for one in match.places if one.log_odds > -LEAST_ODDS]

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
                source, target = (Side.sampled(self.maps[k], COARSE_POINTS, self.rng) for k in (i, j))
                found = agreement(source, target, Hypotheses.of(b.inverse() @ a), tolerance)
                shares[i, j] = shares[j, i] = found.agreeing[0]
        pairs: set[Pair] = set()
        for i in range(n):
            for j in np.argsort(-shares[i], kind="stable")[:PARTNERS].tolist():
                if shares[i, j] > EXPECTED_OVERLAP:
                    pairs.add((min(i, j), max(i, j)))
        edges = {pair for pair, match in self._tried.items() if match is not None and is_accepted(match)}
        return sorted(pairs - edges)


def turn_deg(S_earlier_later: Similarity) -> Float64[ndarray, "3"]:
    """Rotation vector from one camera to a later one."""
    return np.asarray(np.degrees(Rotation.from_matrix(S_earlier_later.R).as_rotvec()))


@dataclass(frozen=True)
class Turns:
    """By how much cameras of pairs turn from one frame to the next, at all places that the pairs allow."""

    turn_deg: Float64[ndarray, "n 3"]
    steps: Float64[ndarray, "n"]  # from one frame of the pair to the other
    weight: Float64[ndarray, "n"]  # share of the place among those of its pair
    pair: Int64[ndarray, "n"]

    @staticmethod
    def of(pairs: Sequence[PairMatch], steps: Sequence[int]) -> "Turns":
        """Stack the places of pairs; `steps`: of the camera, from the source of each to its target."""
        turn, weight, number = list[Float64[ndarray, "3"]](), list[Float64[ndarray, "m"]](), list[int]()
        for k, (e, count) in enumerate(zip(pairs, steps, strict=True)):
            weight.append(softmax(np.array([one.log_odds for one in e.places]) / SHARED_ERRORS))
            number += [k] * len(e.places)
            for one in e.places:
                S = one.S_target_source.inverse() if count > 0 else one.S_target_source
                turn.append(turn_deg(S) / abs(count))
        each = np.array(number, dtype=np.int64)
        return Turns(np.stack(turn), np.abs(np.array(steps, dtype=np.float64))[each], np.concatenate(weight), each)

    def in_no_order(self) -> "Turns":
        """The same as if the frames of each pair followed each other."""
        return replace(self, turn_deg=self.turn_deg * self.steps[:, None], steps=np.ones_like(self.steps))

    def likelihood(self, step: UsualStep) -> Float64[ndarray, "n"]:
        """Of the turn between both frames, at each place."""
        return self.weight * np.exp(step.log_density(self.turn_deg)) / self.steps**3

    @property
    def unusual(self) -> Float64[ndarray, "n"]:
        """The same of frames in no order."""
        return self.weight * np.exp(NO_ORDER.log_density(self.turn_deg * self.steps[:, None]))

    def places(self, step: UsualStep) -> Float64[ndarray, "n"]:
        """Probability that each place is the right one and its pair turned by the usual step."""
        each = self.likelihood(step)
        return each / np.bincount(self.pair, each + self.unusual + LEAST_LIKELIHOOD)[self.pair]

    def probability(self, step: UsualStep) -> Float64[ndarray, "pairs"]:
        """That each pair turned by the usual step, and not as frames in no order do."""
        return np.bincount(self.pair, self.places(step))

    def log_likelihood(self, step: UsualStep) -> float:
        """Of all pairs."""
        return float(np.log(np.bincount(self.pair, self.likelihood(step) + self.unusual) + LEAST_LIKELIHOOD).sum())


def likeliest_step(turns: Turns) -> tuple[UsualStep, float]:
    """The normal distribution of turns that makes those of all pairs likeliest, and their log-likelihood.

    Expectation maximisation (Dempster et al., 1977) from many starts.
    """
    likely = np.flatnonzero(np.linalg.norm(turns.turn_deg, axis=1) <= LARGEST_STEP_DEG)
    likely = likely[np.argsort(-turns.weight[likely], kind="stable")[:STEP_STARTS]]
    starts = [NO_ORDER, *(UsualStep(mean, spread_deg(mean) ** 2 * np.eye(3)) for mean in turns.turn_deg[likely])]
    best, most = NO_ORDER, -np.inf
    for step in starts:
        for _ in range(STEP_ROUNDS):
            w = turns.places(step)
            mean = w @ turns.turn_deg / (w.sum() + LEAST_LIKELIHOOD)
            d = turns.turn_deg - mean
            spread = spread_deg(mean) ** 2 * np.eye(3)
            step = UsualStep(mean, ((w[:, None] * d).T @ d + SPREAD_COUNT * spread) / (w.sum() + SPREAD_COUNT))
        found = turns.log_likelihood(step) - step.deg / SMALL_STEP_DEG
        if found > most:
            best, most = step, found
    return best, most


def spread_deg(mean_deg: Float64[ndarray, "3"]) -> float:
    """Spread of turns that is expected before they are known."""
    return max(LEAST_SPREAD * float(np.linalg.norm(mean_deg)), LEAST_STEP_DEG)


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
    number = {frame: k for k, frame in enumerate(component)}
    first, second = np.array([(number[i], number[j]) for i, j in inside]).T
    return bool((component_labels(first, second, len(component)) == 0).all())


def _relative(nodes: Component, pair: Pair) -> Similarity | None:
    """The second frame of a pair from the first, where both are known."""
    a, b = nodes.get(pair[0]), nodes.get(pair[1])
    return None if a is None or b is None else b.inverse() @ a
