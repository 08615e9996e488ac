"""Frames are put together into components, the most certain pairs first.

Two components are joined at the place between them at which all frames that face each other there, registered or not,
are together most likely to belong: a pair that fits by accident decides nothing on its own once components have grown.
Joins that lead all others clearly come first; then the likeliest of the rest. What they leave undecided is looked at
when all are in (see blocks).
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.evidence import MOST_OF_A_PAIR, Comparison, ScanEvidence
from sl_nerfstudio.registration.pairs import LEAST_ODDS, SAME_PLACE_DEG, SAME_PLACE_SHIFT, TONE_ODDS, PairMatch
from sl_nerfstudio.registration.pose_graph import Component, Pivots, optimise_at_places

MOST_COMPARED = 12  # clearly different similarities between two components
MOST_PAIRS = 10  # of frames across two components that are compared
MOST_ALIKE = 4  # frames that each faces at a place, by which blocks of what looks alike are found
ADJUSTED_DEG = 6.0  # between two places, up to which the joint adjustment leads from one to the other
BASELINE_SIGMA = 0.5  # of the logarithm of a ratio of baselines: nobody moves two devices much farther apart
LARGEST_BASELINE = 5.0  # such a ratio, beyond which a surface has collapsed onto a patch of another
LEAST_SIGHT_COSINE = float(np.cos(np.radians(75.0)))  # between lines of sight: beyond it frames share no surface


@dataclass(frozen=True)
class Decision:
    """Where two components belong, and by how many nats that leads all other places."""

    S_first_second: Similarity
    lead: float


@dataclass(frozen=True)
class Elsewhere:
    """Another place of a frame."""

    S_world_world: Similarity  # that moves it there
    by_surface: float  # by how many nats it is more likely there
    by_order: float  # the same by the order of capture


Prior = Callable[[int, int, Similarity], float]


class Assembly:
    """Components of frames, grown along registered pairs.

    Two components are joined at the place at which all frames across them that face each other there, registered or
    not, are together most likely to belong; if that leads all others by enough.
    """

    def __init__(
        self, scan: ScanEvidence, pivots: Pivots, edges: Sequence[PairMatch], prior: Prior | None = None
    ) -> None:  # fmt: skip
        """Start with every frame as a component of its own.

        Args:
            scan: compares frames.
            pivots: of every frame, for the pose graph.
            edges: pairs that say where components may belong.
            prior: log-odds, in nats, of the place of two frames by the order of capture: of `S_i_j` for frames i and j.
        """
        self._scan, self.pivots, self.prior = scan, pivots, prior
        self.edges = sorted(edges, key=lambda e: -e.lead)
        self._decisions: dict[tuple[int, int], Decision | None] = {}  # by the numbers of two components
        self.components: list[Component] = [{k: Similarity.identity()} for k in range(len(pivots))]
        self._number = list(range(len(pivots)))  # of each frame's component
        self._joins = 0

    def grow(self) -> list[Component]:
        """Join components until nothing more is likely to belong together; the largest first."""
        while (found := self._next_join()) is not None:
            first, second, S = found
            self.components = [c for c in self.components if c is not first and c is not second]
            self.components.append(self._joined(first, second, S))
            self._joins += 1
            for k in self.components[-1]:
                self._number[k] = len(self.pivots) - 1 + self._joins
        return sorted(self.components, key=lambda c: (-len(c), min(c)))

    def _next_join(self) -> tuple[Component, Component, Similarity] | None:
        """The first join that is decided; if none is, the one that leads most."""
        best: tuple[float, Component, Component, Similarity] | None = None
        for edge in self.edges:
            a, b = self._number[edge.target], self._number[edge.source]
            if a == b:
                continue
            key = min(a, b), max(a, b)
            ends = (edge.target, edge.source) if a < b else (edge.source, edge.target)
            first, second = (next(c for c in self.components if frame in c) for frame in ends)
            if key not in self._decisions:
                self._decisions[key] = self._decision(first, second)
            decision = self._decisions[key]
            if decision is None:
                continue
            if decision.lead >= LEAST_ODDS:
                return first, second, decision.S_first_second
            if best is None or decision.lead > best[0]:
                best = decision.lead, first, second, decision.S_first_second
        return None if best is None else best[1:]

    def _joined(self, first: Component, second: Component, S: Similarity) -> Component:
        """Merge both in the world of the first, with all pairs inside optimised together."""
        both = {**first, **{k: S @ S_second for k, S_second in second.items()}}
        found = optimise_at_places(self.edges, self.pivots, both).S_world_camera
        return {k: found[k] for k in both}

    def decide(self, first: Component, second: Component) -> Similarity | None:
        """The similarity between two components; None where it is not certain."""
        decision = self._decision(first, second)
        return None if decision is None or decision.lead < LEAST_ODDS else decision.S_first_second

    def _decision(self, first: Component, second: Component) -> Decision | None:
        """The likeliest similarity between two components; None where nothing says that they belong together."""
        places = self._proposed(first, second)
        if not places:
            return None
        nodes = [self.settled(first, second, S) for S in places]
        found = self.compare(first, second, nodes)
        usual = np.array([self.usual(first, second, at) for at in nodes])
        settled = [self._between_worlds(first, second, at) for at in nodes]
        best, both = self._likeliest(first, second, settled, found, usual[:, None] - usual)
        if found.odds[best] < LEAST_ODDS:
            return None
        others = [k for k, S in enumerate(settled) if k != best and self._differ(settled[best], S, second)]
        return Decision(settled[best], float(min(both[others], default=found.odds[best])))

    def _likeliest(
        self, first: Component, second: Component, places: Sequence[Similarity], found: Comparison,
        by_order: Float64[ndarray, "k k"],
    ) -> tuple[int, Float64[ndarray, "k"]]:  # fmt: skip
        """The place that leads the others, at worst, by most; and by how many nats it leads each.

        Whether the surface looks alike at two places takes long to find out: it is asked of those that the likeliest
        place leads clearly only if it does not.
        """
        alike, asked = found.alike.copy(), np.eye(len(places), dtype=bool)
        while True:
            if_not, if_so = (replace(found, alike=a).leads + by_order for a in (alike, np.ones_like(alike)))
            best = int(np.argmax(if_not.min(1)))
            matters = (if_not != if_so)[best] & (np.minimum(if_not, if_so)[best] < LEAST_ODDS) & ~asked[best]
            if not matters.any():
                return best, if_not[best]
            for k in np.flatnonzero(matters).tolist():
                asked[best, k] = asked[k, best] = True
                alike[best, k] |= self._known_alike(first, second, places[best], places[k])
                alike[k, best] = alike[best, k]

    def elsewhere(self, rest: Component, frame: int, here: Similarity) -> list[Elsewhere]:
        """Clearly different places of one frame of a component that its pairs say, if they may be about as likely.

        A place beside one at which the surface looks the same is judged as that one: it has slid from there.
        `rest`: the other frames of the component, `here`: the frame's node.
        """
        second = {frame: here}
        places = [Similarity.identity()]
        places += [S for S in self._proposed(rest, second) if self._differ(S, places[0], second)]
        if len(places) == 1:
            return []
        nodes = [self._placed(rest, frame, S @ here) for S in places]
        found = self.compare(rest, second, nodes)
        usual = [self.usual(rest, second, at) for at in nodes]
        if_not, if_so = (replace(found, alike=np.full_like(found.alike, so)).leads[:, 0] for so in (False, True))
        either = np.maximum(found.leads[:, 0], if_so)
        turns = [at[frame] @ nodes[0][frame].inverse() for at in nodes]
        out: list[Elsewhere] = []
        for k in range(1, len(places)):
            order = usual[k] - usual[0]
            unlikely = found.odds[k] < LEAST_ODDS or either[k] + max(order, 0) <= -LEAST_ODDS
            if unlikely or not self.differ(rest, second, nodes[0], nodes[k]):
                continue
            alike = if_not[k] != if_so[k] and any(
                self.looks_alike(rest, turn) for turn in turns[1:] if angle_deg(turn.R @ turns[k].R.T) < ADJUSTED_DEG
            )
            out.append(Elsewhere(turns[k], float(if_so[k] if alike else if_not[k]), order))
        return out

    def _proposed(self, first: Component, second: Component) -> list[Similarity]:
        """The clearly different similarities between two components that pairs across say, the most likely first."""
        said = [place for e in self._between(first, second) for place in self._said(e, first, second)]
        ratio = log_baseline(second) - log_baseline(first)
        said = [(odds, S) for odds, S in said if abs(np.log(S.scale) + ratio) < np.log(LARGEST_BASELINE)]
        distinct: list[Similarity] = []
        for _, S in sorted(said, key=lambda one: -one[0]):
            if len(distinct) == MOST_COMPARED:
                break
            if all(self._differ(S, other, second) for other in distinct):
                distinct.append(S)
        return distinct

    def settled(self, first: Component, second: Component, S_first_second: Similarity) -> Component:
        """Put two components together and let their frames move to where the pairs want them that know their places.

        Components have errors of scale that add up around an object: rigid ones would not fit on both of their ends.
        """
        both = {**first, **{k: S_first_second @ S for k, S in second.items()}}
        known = self._known_across(first, second, both)
        inside = [e for part in (first, second) for e in self.edges if e.source in part and e.target in part]
        return optimise_at_places([*inside, *known], self.pivots, both).S_world_camera

    def _placed(self, rest: Component, frame: int, S_world_camera: Similarity) -> Component:
        """The same for one frame among others that stay."""
        both = {**rest, frame: S_world_camera}
        known = self._known_across(rest, {frame: S_world_camera}, both)
        return optimise_at_places(known, self.pivots, both, [frame]).S_world_camera

    def _known_across(self, first: Component, second: Component, nodes: Component) -> list[PairMatch]:
        """The pairs across two components that know where their frames are."""
        return [e for e in self._between(first, second) if e.knows(nodes)]

    @staticmethod
    def _between_worlds(first: Component, second: Component, both: Component) -> Similarity:
        """The similarity between two components whose frames are at given nodes."""
        i, j = next(iter(first)), next(iter(second))
        return first[i] @ relative(both, j, i) @ second[j].inverse()

    def compare(
        self, first: Component, second: Component, nodes: Sequence[Component],
        alike: Bool[ndarray, "k k"] | bool = False,
    ) -> Comparison:  # fmt: skip
        """Compare places of two components by all of their frames that face each other there.

        The errors of a frame are the same in all of its pairs. Where each frame has d pairs across, they count as
        2 / (d + d') of independent ones. `nodes`: all frames at each place. `alike`: at which places the surface is
        known to look the same (all of them, if True); frames that face each other at two of them show it as well.
        """
        found = Comparison.none(len(nodes))
        near = [set(facing({i: at[i] for i in first}, {j: at[j] for j in second})) for at in nodes]
        counts = [Counter(k for pair in pairs for k in pair) for pairs in near]
        degree = {k: max(count[k] for count in counts) for k in set().union(*counts)}
        for i, j in sorted(set().union(*near)):
            here = [relative(at, j, i) if see_same_side(at[i], at[j]) else None for at in nodes]
            found += self._scan.comparison(j, i, here).bounded().scaled(2 / (degree[i] + degree[j]))
        found += self._by_tone(first, second, nodes)
        found += by_odds([self._usual_baselines(first, second, at) for at in nodes])
        return replace(found, alike=found.alike | alike)

    def _by_tone(self, first: Component, second: Component, nodes: Sequence[Component]) -> Comparison:
        """What the tones of frames across say, which hold them where surfaces would slip."""
        across = [e for e in self._between(first, second) if e.by_tone]
        degree = Counter(k for e in across for k in (e.source, e.target))
        odds = np.zeros(len(nodes))
        for e in across:
            for k, at in enumerate(nodes):
                if e.knows(at):
                    odds[k] += TONE_ODDS * 2 / (degree[e.source] + degree[e.target])
        return by_odds(odds)

    @staticmethod
    def _usual_baselines(first: Component, second: Component, nodes: Component) -> float:
        """Log-odds of the ratio of the baselines of two components: a surface that collapses fits anywhere."""
        one, two = (log_baseline({k: nodes[k] for k in part}) for part in (first, second))
        return -0.5 * ((one - two) / BASELINE_SIGMA) ** 2

    def looks_alike(self, nodes: Component, turn: Similarity) -> bool:
        """Whether the surface looks the same after a turn of the world, as a box does.

        Some registered pair has to say so. Then those frames decide that face each other best both before one of them
        is moved and after it: whether they agree at both places, or one of these contradicts.
        """
        if not any(self._fits_as_well(e, nodes, T) for e in self.edges for T in (turn, turn.inverse())):
            return False
        said = 0.0
        for i, j in facing_after(nodes, turn):
            found = self._scan.comparison(j, i, [relative(nodes, j, i), nodes[i].inverse() @ turn @ nodes[j]])
            if found.alike[0, 1]:
                said += LEAST_ODDS
            else:
                contradicted = replace(found, alike=np.ones((2, 2), dtype=bool)).leads[0, 1]
                said -= min(abs(float(contradicted)), MOST_OF_A_PAIR)
        return said > 0

    def gains_among_alike(self, nodes: Component, turn: Similarity) -> Float64[ndarray, "m m"]:
        """What a turn after which the surface looks the same gains if one frame (row) moves and another stays, nats.

        By the frames that face each other best as they are, or after one of both is moved.
        """
        frames, gain = list(nodes), np.zeros((len(nodes), len(nodes)))
        sight = np.array([S.R[:, 2] for S in nodes.values()])
        after = sight @ turn.R.T @ sight.T  # the first moves
        rows, near = np.arange(len(frames))[:, None], np.zeros(gain.shape, dtype=bool)
        for cosine in (sight @ sight.T, after, after.T.copy()):
            np.fill_diagonal(cosine, -1.0)
            best = np.argsort(cosine, axis=1, kind="stable")[:, -MOST_ALIKE:]
            near[rows, best] |= np.take_along_axis(cosine, best, 1) > LEAST_SIGHT_COSINE
        near |= near.T
        degree = near.sum(1)
        for a, b in zip(*np.nonzero(np.triu(near, 1)), strict=True):
            i, j = nodes[frames[a]], nodes[frames[b]]
            worlds = ((i, j), (turn @ i, j), (i, turn @ j))
            places = [q.inverse() @ p if see_same_side(p, q) else None for p, q in worlds]
            found = self._scan.comparison(frames[a], frames[b], places).bounded()
            leads = replace(found, alike=np.ones((3, 3), dtype=bool)).leads * 2 / (degree[a] + degree[b])
            gain[a, b], gain[b, a] = leads[1, 0], leads[2, 0]
        return gain

    @staticmethod
    def _fits_as_well(e: PairMatch, nodes: Component, turn: Similarity) -> bool:
        """Whether a pair fits as well after its source is moved by a turn of the world."""
        if not e.rivals or e.source not in nodes or e.target not in nodes:
            return False
        here = e.log_odds_at(relative(nodes, e.source, e.target))
        there = e.log_odds_at(nodes[e.target].inverse() @ turn @ nodes[e.source])
        return here is not None and there is not None and abs(here - there) < LEAST_ODDS

    def _known_alike(self, first: Component, second: Component, place: Similarity, other: Similarity) -> bool:
        """Whether the frames of one of the components are known to look the same at two places."""
        return self.looks_alike(first, place @ other.inverse()) or self.looks_alike(second, place.inverse() @ other)

    def differ(self, first: Component, second: Component, a: Component, b: Component) -> bool:
        """Whether two components are at clearly different places, to each other, in two worlds."""
        S_a, S_b = self._between_worlds(first, second, a), self._between_worlds(first, second, b)
        return self._differ(S_a, S_b, second)

    def usual(self, first: Component, second: Component, nodes: Component) -> float:
        """Log-odds of a place of two components by the order of capture."""
        if self.prior is None:
            return 0.0
        return sum(self.prior(i, j, relative(nodes, j, i)) for i in first for j in second)

    def _between(self, first: Component, second: Component) -> list[PairMatch]:
        return [
            e
            for e in self.edges
            if (e.source in first and e.target in second) or (e.source in second and e.target in first)
        ]

    @staticmethod
    def _said(e: PairMatch, first: Component, second: Component) -> list[tuple[float, Similarity]]:
        """Similarities between two components that a pair across says, each with its log-odds against nothing."""
        forward = e.source in second
        i, j = (e.target, e.source) if forward else (e.source, e.target)
        places = [(e.log_odds + one.log_odds, one.S_target_source) for one in e.places]
        return [(odds, first[i] @ (S if forward else S.inverse()) @ second[j].inverse()) for odds, S in places]

    def _differ(self, a: Similarity, b: Similarity, second: Component) -> bool:
        """Whether two similarities put the frames of `second` at clearly different places."""
        if angle_deg(a.R @ b.R.T) > SAME_PLACE_DEG:
            return True
        shifts = []
        for k, S in second.items():
            p, radius = S.points(self.pivots.centre[k][None]), a.scale * S.scale * self.pivots.radius[k]
            shifts.append(float(np.linalg.norm(a.points(p) - b.points(p))) / radius)
        return bool(min(shifts) > SAME_PLACE_SHIFT)


def by_odds(odds: Sequence[float] | Float64[ndarray, "k"]) -> Comparison:
    """Places compared by log-odds of each."""
    each = np.array(odds, dtype=np.float64)
    return replace(Comparison.none(len(each)), shared=each[:, None] - each, odds=each)


def log_baseline(part: Component) -> float:
    """Mean logarithm of the baselines of some frames, in their world."""
    return float(np.mean([np.log(S.scale) for S in part.values()]))


def relative(nodes: Component, source: int, target: int) -> Similarity:
    """The similarity from one frame to another."""
    return nodes[target].inverse() @ nodes[source]


def facing(first: Component, second: Component, most: int = MOST_PAIRS) -> list[tuple[int, int]]:
    """The pairs of frames of two components in one world whose cameras look most nearly the same way."""
    here, there = list(first), list(second)
    if not here or not there:
        return []
    sight = np.array([first[i].R[:, 2] for i in here]), np.array([second[j].R[:, 2] for j in there])
    cosine = (sight[0][:, None] * sight[1]).sum(-1).ravel()
    near = np.argsort(-cosine, kind="stable")[:most]
    return [(here[k // len(there)], there[k % len(there)]) for k in near if cosine[k] > LEAST_SIGHT_COSINE]


def facing_after(nodes: Component, turn: Similarity, most: int = MOST_PAIRS) -> list[tuple[int, int]]:
    """The pairs of frames that face each other best both as they are and after the second is moved by a turn."""
    frames, sight = np.array(list(nodes)), np.array([S.R[:, 2] for S in nodes.values()])
    cosine = np.minimum(sight @ sight.T, sight @ turn.R @ sight.T)
    np.fill_diagonal(cosine, -1)
    near = np.argsort(-cosine, axis=None, kind="stable")[:most]
    first, second = np.unravel_index(near[cosine.flat[near] > LEAST_SIGHT_COSINE], cosine.shape)
    return list(zip(frames[first].tolist(), frames[second].tolist(), strict=True))


def see_same_side(a: Similarity, b: Similarity) -> bool:
    """Whether the lines of sight of two cameras differ little enough to see a common surface."""
    return float(a.R[:, 2] @ b.R[:, 2]) > LEAST_SIGHT_COSINE
