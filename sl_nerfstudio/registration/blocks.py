"""Blocks of frames against the rest: each may belong to another side of what nearly looks the same from several sides.

Frames are joined one after the other, so a join that was nearly open may have put a whole block of them where it fits
less well. Every turn of the world that some pair says is tried on the block for which it gains most, by the log-odds of
all pairs of frames across its border: which frames belong to it is a cut of a graph (Kernighan and Lin, 1970). Where
the object looks the same after a turn, all frames that face each other say it, registered or not. Blocks move to where
they are likelier. Then each frame alone is tried at all places that its pairs say, by all frames that
face it there: the pair that held it may have slipped. A block that is nearly as likely elsewhere is not decided, and
stays apart.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.assembly import ADJUSTED_DEG, LARGEST_BASELINE, Assembly, Elsewhere
from sl_nerfstudio.registration.evidence import MOST_OF_A_PAIR
from sl_nerfstudio.registration.pairs import LEAST_ODDS, LEAST_SIDE_DEG, SAME_TURN_DEG, TONE_ODDS, PairMatch
from sl_nerfstudio.registration.pose_graph import Component, optimise_at_places, optimise_known

MOST_TURNS = 48  # of the world that are tried
MOST_MOVES = 12  # of blocks, one after the other
LEAST_GAIN = 1.0  # nats by which a block must fit better elsewhere to be moved
STARTS = 24  # frames from which a block is grown


@dataclass(frozen=True)
class OpenBlock:
    """Frames that are nearly as likely elsewhere, where they are likeliest."""

    nodes: Component
    turn_deg: float  # between the two places
    log_odds: float  # of this one, nats


@dataclass(frozen=True)
class Settled:
    """A component with every block where it is likeliest."""

    decided: Component
    open: tuple[OpenBlock, ...]  # in the same world


@dataclass(frozen=True)
class Sides:
    """What surfaces alone say of the sides of an object."""

    by_order: tuple[int, ...] = ()  # frames that they would have left open, and the order of capture did not
    turns_deg: tuple[float, ...] = ()  # by which blocks may be turned, as far as they tell


@dataclass(frozen=True)
class Turn:
    """A turn of the world, and what each pair of frames (first moved, second stays) gains by it, nats."""

    S_world_world: Similarity
    alike: bool  # the surface looks the same after it
    by_surface: Float64[ndarray, "n n"]
    by_order: Float64[ndarray, "n n"]


@dataclass(frozen=True)
class Cut:
    """A block of frames, and what its turn gains, nats."""

    gain: float
    block: Bool[ndarray, "n"]
    S_world_world: Similarity
    alike: bool  # the surface looks the same after it


class BlockReview:
    """Looks for blocks that fit as well elsewhere: by pairs that were registered, then by all frames that face them."""

    def __init__(self, assembly: Assembly, component: Component) -> None:
        self._assembly, self._pivots, self._prior = assembly, assembly.pivots, assembly.prior
        self._edges = [e for e in assembly.edges if e.source in component and e.target in component]
        self._elsewhere: dict[int, tuple[Component, list[Elsewhere]]] = {}  # places of frames, and among which others
        self._turns_tried: list[Turn] = []
        self._left_open: list[OpenBlock] = []
        self._degree = Counter(k for e in self._edges for k in (e.source, e.target))
        self.nodes = optimise_at_places(self._edges, self._pivots, component).S_world_camera

    def settled(self) -> Settled:
        """Move blocks to where they are likeliest; take out those whose place is not decided."""
        turns, returned = self._turns(), set[frozenset[int]]()
        for _ in range(MOST_MOVES):
            moves = ((self._frames(cut.block), cut) for cut in self._moves(turns))
            moved, cut = next(((moved, cut) for moved, cut in moves if moved not in returned), (frozenset[int](), None))
            if cut is None:
                break
            nodes = {k: cut.S_world_world @ S if k in moved else S for k, S in self.nodes.items()}
            there = optimise_known(self._edges, self._pivots, nodes).S_world_camera
            rest = {k: S for k, S in self.nodes.items() if k not in moved}
            if not self._assembly.differ(rest, {k: self.nodes[k] for k in moved}, self.nodes, there):
                returned.add(moved)  # its pairs take it back
                continue
            self.nodes = there
            self._elsewhere.clear()
            turns = self._turns()
        self._turns_tried, self._left_open = turns, self._open(turns, with_order=True)
        out = {k for block in self._left_open for k in block.nodes}
        return Settled({k: S for k, S in self.nodes.items() if k not in out}, tuple(self._left_open))

    def sides(self) -> Sides:
        """What surfaces alone say of blocks, after `settled`."""
        open_ = self._left_open
        without = open_ if self._prior is None else self._open(self._turns_tried, with_order=False)
        undecided, left = ({k for block in blocks for k in block.nodes} for blocks in (without, open_))
        return Sides(
            tuple(sorted(undecided - left)),
            _distinct(sorted(block.turn_deg for block in without if block.turn_deg >= LEAST_SIDE_DEG)),
        )

    def _moves(self, turns: Sequence[Turn]) -> Iterator[Cut]:
        """Blocks that are likelier elsewhere, then single frames."""
        cuts = sorted((best_block(t.by_surface + t.by_order, t) for t in turns), key=lambda cut: -cut.gain)
        yield from filter(self._gains, cuts)
        yield from filter(self._gains, self._single_frames(np.ones(len(self.nodes), dtype=bool)))

    def _gains(self, cut: Cut) -> bool:
        """Whether a block is likelier elsewhere; by one measure for all blocks, or they would move to and fro."""
        return cut.gain > LEAST_GAIN and self._verified(cut) > LEAST_GAIN

    def _open(self, turns: Sequence[Turn], with_order: bool) -> list[OpenBlock]:
        """Blocks whose place is not decided, one after the other: of two parts the smaller is taken out.

        Between places so close to each other that the joint adjustment leads from one to the other it decides.
        """
        n, left = len(self.nodes), np.arange(len(self.nodes))
        found: list[OpenBlock] = []
        while len(left) > 1:
            cuts: list[Cut] = []
            for turn in turns:
                if angle_deg(turn.S_world_world.R) < ADJUSTED_DEG:
                    continue
                by_order = with_order and is_another_side(turn.S_world_world)
                gain = turn.by_surface + turn.by_order if by_order else turn.by_surface
                part = best_block(gain[np.ix_(left, left)], turn)
                block = np.zeros(n, dtype=bool)
                block[left[part.block]] = True
                cuts.append(replace(part, block=block))
            inside = np.isin(np.arange(n), left)
            likely = [cut for cut in sorted(cuts, key=lambda cut: -cut.gain) if cut.gain > -LEAST_ODDS]
            verified = (
                replace(cut, gain=self._verified(cut, inside, with_order and is_another_side(cut.S_world_world)))
                for cut in likely
            )
            cut = next((one for one in verified if one.gain > -LEAST_ODDS), None)
            cut = cut or next(iter(self._single_frames(inside, with_order, ADJUSTED_DEG)), None)
            if cut is None or cut.gain <= -LEAST_ODDS:
                break
            block = cut.block if 2 * cut.block.sum() <= len(left) else inside & ~cut.block
            nodes = {k: self.nodes[k] for k in sorted(self._frames(block))}
            found.append(OpenBlock(nodes, angle_deg(cut.S_world_world.R), -cut.gain))
            left = np.flatnonzero(inside & ~block)
        return found

    def _single_frames(self, inside: Bool[ndarray, "n"], with_order: bool = True, from_deg: float = 0.0) -> list[Cut]:
        """What single frames gain elsewhere by all others inside, whichever of their pairs says so; the most first."""
        found: list[Cut] = []
        rest = {k: S for (k, S), here in zip(self.nodes.items(), inside, strict=True) if here}
        for number, (frame, S) in enumerate(self.nodes.items()):
            places = self._places_of(frame, S, rest) if inside[number] and len(rest) > 1 else []
            for place in places:
                if angle_deg(place.S_world_world.R) < from_deg:
                    continue
                by_order = place.by_order if with_order and is_another_side(place.S_world_world) else 0.0
                block = np.arange(len(self.nodes)) == number
                found.append(Cut(place.by_surface + by_order, block, place.S_world_world, alike=False))
        return sorted(found, key=lambda cut: -cut.gain)

    def _places_of(self, frame: int, here: Similarity, rest: Component) -> list[Elsewhere]:
        """Other places of a frame among the others; asked again when some of these are out."""
        known = self._elsewhere.get(frame)
        if known is None or len(known[0]) != len(rest):
            others = {k: S for k, S in rest.items() if k != frame}
            known = self._elsewhere[frame] = rest, self._assembly.elsewhere(others, frame, here)
        return known[1]

    def _frames(self, block: Bool[ndarray, "n"]) -> frozenset[int]:
        return frozenset(np.array(list(self.nodes))[block].tolist())

    def _verified(self, cut: Cut, inside: Bool[ndarray, "n"] | None = None, with_order: bool = True) -> float:
        """What a turn gains, in nats, by all frames that face each other across the border, before it or after it."""
        moved = self._frames(cut.block)
        kept = self._frames(~cut.block if inside is None else inside & ~cut.block)
        first, second = ({k: self.nodes[k] for k in sorted(part)} for part in (kept, moved))
        places = (Similarity.identity(), cut.S_world_world)
        nodes = [self._assembly.settled(first, second, S) for S in places]
        if not self._assembly.differ(first, second, *nodes):
            return -np.inf  # its frames move back
        found = self._assembly.compare(first, second, nodes, cut.alike)
        if found.odds[1] < LEAST_ODDS:
            return -np.inf  # nothing speaks for it: what contradicts at one place need not be at another
        gain = float(found.leads[1, 0])
        if with_order:
            gain += self._assembly.usual(first, second, nodes[1]) - self._assembly.usual(first, second, nodes[0])
        return gain

    def _turns(self) -> list[Turn]:
        """All turns with what they gain."""
        column = {k: n for n, k in enumerate(self.nodes)}
        pairs: list[tuple[PairMatch, Similarity, float | None]] = []  # the world in the target's axes, odds as it is
        for e in self._edges:
            back = self.nodes[e.target].inverse()
            pairs.append((e, back, e.log_odds_at(back @ self.nodes[e.source])))
        ordered: list[tuple[int, int, Similarity, float]] = []  # frames whose place the order of capture tells
        if self._prior is not None:
            for j, S in self.nodes.items():
                back = S.inverse()
                usual = ((i, self._prior(j, i, back @ S_i)) for i, S_i in self.nodes.items() if i != j)
                ordered += [(i, j, back, odds) for i, odds in usual if odds]
        return [self._turn(S, column, pairs, ordered) for S in turns_said(self._edges, self.nodes)]

    def _turn(
        self, turn: Similarity, column: Mapping[int, int], pairs: Sequence[tuple[PairMatch, Similarity, float | None]],
        ordered: Sequence[tuple[int, int, Similarity, float]],
    ) -> Turn:  # fmt: skip
        order = np.zeros((len(column), len(column)))
        inverse = turn.inverse()
        alike = self._assembly.looks_alike(self.nodes, turn)
        surface = self._assembly.gains_among_alike(self.nodes, turn) if alike else np.zeros_like(order)
        for e, S, here in pairs:
            i, j = column[e.source], column[e.target]
            weight = 2 / (self._degree[e.source] + self._degree[e.target])  # see Assembly.compare
            for moved, kept, way in ((i, j, S @ turn), (j, i, S @ inverse)):
                there = e.log_odds_at(way @ self.nodes[e.source])
                if e.by_tone:
                    surface[moved, kept] += weight * TONE_ODDS * (float(there is not None) - float(here is not None))
                elif not alike:
                    before, after = (-MOST_OF_A_PAIR if odds is None else odds for odds in (here, there))
                    surface[moved, kept] += weight * (after - before)
        if self._prior is not None:
            for i, j, back, usual in ordered:
                order[column[i], column[j]] = self._prior(j, i, back @ turn @ self.nodes[i]) - usual
        return Turn(turn, alike, surface, order)


def is_another_side(turn: Similarity) -> bool:
    """Whether the order of capture may decide a turn: smaller ones are slides along a surface."""
    return angle_deg(turn.R) >= LEAST_SIDE_DEG


def _distinct(sorted_deg: Sequence[float]) -> tuple[float, ...]:
    """Angles without those that are close to the one before."""
    found: list[float] = []
    for angle in sorted_deg:
        if not found or angle > found[-1] + SAME_TURN_DEG:
            found.append(angle)
    return tuple(found)


def turns_said(edges: Sequence[PairMatch], nodes: Component) -> list[Similarity]:
    """Clearly different turns of the world after which some pair fits as well or nearly; the most likely first."""
    said: list[tuple[float, Similarity]] = []
    for e in edges:
        target, source = nodes[e.target], nodes[e.source].inverse()
        here = e.log_odds_at(target.inverse() @ nodes[e.source])
        here = -MOST_OF_A_PAIR if here is None else here
        for one in e.places:
            turn, gain = target @ one.S_target_source @ source, one.log_odds - here
            said += [(gain, turn), (gain, turn.inverse())]
    found: list[Similarity] = []
    known = np.tile(np.eye(3), (1 + MOST_TURNS, 1, 1))  # rotations of none, and of those that were found
    closest = 1 + 2 * np.cos(np.radians(SAME_TURN_DEG))  # trace of a rotation by that angle
    for _, turn in sorted(said, key=lambda one: -one[0]):
        if len(found) == MOST_TURNS:
            break
        if abs(np.log(turn.scale)) > np.log(LARGEST_BASELINE):
            continue
        if np.einsum("kij,ij->k", known[: 1 + len(found)], turn.R).max() < closest:
            found.append(turn)
            known[len(found)] = turn.R
    return found


def best_block(gain: Float64[ndarray, "n n"], turn: Turn) -> Cut:
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
    return Cut(most, best, turn.S_world_world, turn.alike)
