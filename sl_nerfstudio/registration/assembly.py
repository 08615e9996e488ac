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
from jaxtyping import Bool
from numpy import ndarray

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.evidence import Comparison, ScanEvidence
from sl_nerfstudio.registration.pairs import (
    LEAST_ODDS,
    SAME_PLACE_DEG,
    SAME_PLACE_SHIFT,
    TONE_ODDS,
    PairMatch,
)
from sl_nerfstudio.registration.pose_graph import Component, Pivots, optimise_at_places

MOST_COMPARED = 12  # clearly different similarities between two components
MOST_PAIRS = 10  # of frames across two components that are compared
LEAST_SIGHT_COSINE = float(np.cos(np.radians(75.0)))  # between lines of sight: beyond it frames share no surface


@dataclass(frozen=True)
class Link:
    """A similarity between two components that a pair across says."""

    S_first_second: Similarity
    log_odds: float  # of the pair's place against nothing


@dataclass(frozen=True)
class Decision:
    """Where two components belong, and by how many nats that leads all other places."""

    S_first_second: Similarity
    lead: float


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
            prior: log-odds, in nats, of the place of a frame on another by the order of capture.
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
            first, second, key = (
                self._component_of(edge.target),
                self._component_of(edge.source),
                (min(a, b), max(a, b)),
            )
            if a > b:
                first, second = second, first
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

    def _component_of(self, frame: int) -> Component:
        return next(c for c in self.components if frame in c)

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
        found = self.compare(first, second, places, self._known_alike(first, second, places))
        usual = np.array([self.usual(first, second, S) for S in places])
        both = found.leads + usual[:, None] - usual
        best = int(np.argmax(both.min(1)))
        if found.odds[best] < LEAST_ODDS:
            return None
        others = [k for k in range(len(places)) if k != best]
        return Decision(places[best], float(min(both[best, others], default=found.odds[best])))

    def _proposed(self, first: Component, second: Component) -> list[Similarity]:
        """The clearly different similarities between two components that pairs across say, the most likely first."""
        links = [link for e in self._between(first, second) for link in self._links(e, first, second)]
        distinct: list[Similarity] = []
        for link in sorted(links, key=lambda one: -one.log_odds):
            if len(distinct) == MOST_COMPARED:
                break
            if all(self.differ(link.S_first_second, other, second) for other in distinct):
                distinct.append(link.S_first_second)
        return distinct

    def compare(
        self, first: Component, second: Component, places: Sequence[Similarity],
        alike: Bool[ndarray, "k k"] | bool = False,
    ) -> Comparison:  # fmt: skip
        """Compare places by all frames that face each other there.

        The errors of a frame are the same in all of its pairs. Where each frame has d pairs across, they count as
        2 / (d + d') of independent ones. `alike`: at which places the surface is known to look the same (all of
        them, if True); frames that face each other at two of them show it as well.
        """
        found = Comparison.none(len(places))
        near = [set(facing(first, second, S)) for S in places]
        counts = [Counter(k for pair in pairs for k in pair) for pairs in near]
        degree = {k: max(count[k] for count in counts) for k in set().union(*counts)}
        for i, j in sorted(set().union(*near)):
            here = [
                first[i].inverse() @ S @ second[j] if see_same_side(first[i], S @ second[j]) else None for S in places
            ]
            found += self._scan.comparison(j, i, here).scaled(2 / (degree[i] + degree[j]))
        found += self._by_tone(first, second, places)
        return replace(found, alike=found.alike | alike)

    def _by_tone(self, first: Component, second: Component, places: Sequence[Similarity]) -> Comparison:
        """What the tones of frames across say, which hold them where surfaces would slip."""
        across = [e for e in self._between(first, second) if e.by_tone]
        degree = Counter(k for e in across for k in (e.source, e.target))
        odds = np.zeros(len(places))
        for e in across:
            for k, S in enumerate(places):
                both = {**first, **{j: S @ one for j, one in second.items() if j in (e.source, e.target)}}
                if e.log_odds_at(both[e.target].inverse() @ both[e.source]) is not None:
                    odds[k] += TONE_ODDS * 2 / (degree[e.source] + degree[e.target])
        return replace(Comparison.none(len(places)), shared=odds[:, None] - odds, odds=odds)

    def _known_alike(self, first: Component, second: Component, places: Sequence[Similarity]) -> Bool[ndarray, "k k"]:
        """Between which places the frames of one of the components are known to look the same."""
        out = np.zeros((len(places), len(places)), dtype=bool)
        for k, S in enumerate(places):
            for m, other in enumerate(places[:k]):
                turns = ((first, S @ other.inverse()), (second, S.inverse() @ other))
                out[k, m] = out[m, k] = any(looks_alike(self.edges, part, turn) for part, turn in turns)
        return out

    def usual(self, first: Component, second: Component, S: Similarity) -> float:
        """Log-odds of a place by the order of capture."""
        if self.prior is None:
            return 0.0
        return sum(self.prior(i, j, first[i].inverse() @ S @ second[j]) for i in first for j in second)

    def _between(self, first: Component, second: Component) -> list[PairMatch]:
        return [
            e
            for e in self.edges
            if (e.source in first and e.target in second) or (e.source in second and e.target in first)
        ]

    @staticmethod
    def _links(e: PairMatch, first: Component, second: Component) -> list[Link]:
        """What a pair across says: its best similarity and its rivals."""
        forward = e.source in second
        target, source = (e.target, e.source) if forward else (e.source, e.target)
        places = [(one.S_target_source, e.log_odds + one.log_odds) for one in e.places]
        return [
            Link(first[target] @ (S if forward else S.inverse()) @ second[source].inverse(), odds) for S, odds in places
        ]

    def differ(self, a: Similarity, b: Similarity, second: Component) -> bool:
        """Whether two similarities put the frames of `second` at clearly different places."""
        if angle_deg(a.R @ b.R.T) > SAME_PLACE_DEG:
            return True
        shifts = []
        for k, S in second.items():
            p, radius = S.points(self.pivots.centre[k][None]), a.scale * S.scale * self.pivots.radius[k]
            shifts.append(float(np.linalg.norm(a.points(p) - b.points(p))) / radius)
        return bool(min(shifts) > SAME_PLACE_SHIFT)


def looks_alike(edges: Sequence[PairMatch], nodes: Component, turn: Similarity) -> bool:
    """Whether a pair of frames fits as well after one of them is moved by a turn of their world: as on a box."""
    inverse = turn.inverse()
    for e in edges:
        if e.rivals and e.source in nodes and e.target in nodes:
            back = nodes[e.target].inverse()
            here = e.log_odds_at(back @ nodes[e.source])
            for T in (turn, inverse):
                there = e.log_odds_at(back @ T @ nodes[e.source])
                if here is not None and there is not None and abs(here - there) < LEAST_ODDS:
                    return True
    return False


def facing(first: Component, second: Component, S: Similarity, most: int = MOST_PAIRS) -> list[tuple[int, int]]:
    """The pairs of frames across two components whose cameras look most nearly the same way."""
    here, there = list(first), list(second)
    if not here or not there:
        return []
    sight = np.array([first[i].R[:, 2] for i in here]), np.array([(S.R @ second[j].R)[:, 2] for j in there])
    cosine = (sight[0][:, None] * sight[1]).sum(-1).ravel()
    near = np.argsort(-cosine, kind="stable")[:most]
    return [(here[k // len(there)], there[k % len(there)]) for k in near if cosine[k] > LEAST_SIGHT_COSINE]


def see_same_side(a: Similarity, b: Similarity) -> bool:
    """Whether the lines of sight of two cameras differ little enough to see a common surface."""
    return float(a.R[:, 2] @ b.R[:, 2]) > LEAST_SIGHT_COSINE
