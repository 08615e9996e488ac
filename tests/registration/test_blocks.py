"""Blocks of frames that fit as well, or better, elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.assembly import Assembly, Prior, by_odds, relative
from sl_nerfstudio.registration.blocks import BlockReview, Settled, Turn, best_block
from sl_nerfstudio.registration.evidence import Comparison, ScanEvidence
from sl_nerfstudio.registration.pairs import PairMatch, Rival
from tests.registration.graph_edges import edge, pivots_of

FRAMES, TURN = 24, 40.0  # frames still face each other after a turn


def about_axis(degrees: float) -> Similarity:
    """A turn of the world about the object's axis."""
    return Similarity(1.0, Rotation.from_euler("y", degrees, degrees=True).as_matrix(), np.zeros(3))


def camera(degrees: float) -> Similarity:
    """Four units before the object, which it looks at."""
    return about_axis(degrees) @ Similarity(1.0, np.eye(3), np.array([0.0, 0.0, 4.0]))


NODES = [camera(15.0 * k) for k in range(FRAMES)]


def pairs(odds_turned: float) -> list[PairMatch]:
    """All pairs of near frames, each of which may be turned, at some log-odds."""
    found = []
    for i in range(FRAMES):
        for j in ((i + 1) % FRAMES, (i + 2) % FRAMES):
            places = [NODES[j].inverse() @ about_axis(t) @ NODES[i] for t in (0, TURN, -TURN)]
            rivals = tuple(Rival(S, odds_turned) for S in places[1:])
            found.append(edge(NODES, i, j, rivals=rivals))
    return found


class SaidOfPairs(ScanEvidence):
    """Evidence that registered pairs have of their places, and others not."""

    def __init__(self, edges: list[PairMatch]) -> None:
        self.edges = {(e.source, e.target): e for e in edges}

    def comparison(self, source, target, places) -> Comparison:
        lead, face = np.zeros(len(places)), np.array([S is not None for S in places])
        for ends, way in (((source, target), lambda S: S), ((target, source), Similarity.inverse)):
            if (e := self.edges.get(ends)) is not None:
                odds = [None if S is None else e.log_odds_at(way(S)) for S in places]
                lead = np.array([-60.0 if one is None else one for one in odds])
        return replace(Comparison.none(len(places)), shared=np.where(face[:, None] & face, lead[:, None] - lead, 0.0))


class Said(Assembly):
    """An assembly in which the pairs themselves say by how much one place leads another."""

    def __init__(self, edges: list[PairMatch], prior: Prior | None) -> None:
        self.edges, self.pivots, self.prior, self._scan = edges, pivots_of(NODES), prior, SaidOfPairs(edges)

    def looks_alike(self, nodes, turn) -> bool:
        return any(self._fits_as_well(e, nodes, turn) for e in self.edges)

    def compare(self, first, second, nodes, alike=False) -> Comparison:
        across = self._between(first, second)
        lead, odds = np.zeros((2, len(nodes)))
        for k, at in enumerate(nodes):
            known = [e.log_odds_at(relative(at, e.source, e.target)) for e in across]
            lead[k] = sum(-60.0 if one is None else one for one in known)
            odds[k] = sum(0.0 if one is None else 100.0 + one for one in known)
        return replace(Comparison.none(len(nodes)), shared=lead[:, None] - lead, odds=odds)


def review(edges: list[PairMatch], start: dict[int, Similarity], prior=None) -> Settled:
    return BlockReview(Said(edges, prior), start).settled()


def off_deg(nodes: dict[int, Similarity]) -> float:
    """The largest rotation against the truth, to the first frame."""
    first = min(nodes)
    world = NODES[first] @ nodes[first].inverse()
    return max(angle_deg((world @ S).R @ NODES[k].R.T) for k, S in nodes.items())


@pytest.mark.parametrize("moved", [[4], [3, 4, 5], [0, 1, 2, 9, 10, 11]])
def test_a_block_on_the_wrong_side_is_put_where_its_pairs_say(moved):
    start = {k: about_axis(TURN) @ S if k in moved else S for k, S in enumerate(NODES)}
    found = review(pairs(-30.0), start)
    assert sorted(found.decided) == list(range(FRAMES)) and not found.open
    assert off_deg(found.decided) < 0.1


def test_what_no_pair_decides_is_taken_out_with_its_turn_and_its_odds():
    """Frames 3, 4 and 5 show a side that is the same farther on."""
    edges = [e for e in pairs(-40.0) if len({e.source, e.target} & {3, 4, 5}) != 1]
    open_ = [e for e in pairs(-1.0) if len({e.source, e.target} & {3, 4, 5}) == 1]
    one = BlockReview(Said([*edges, *open_], None), dict(enumerate(NODES)))
    found = one.settled()
    assert sorted(found.decided) == [k for k in range(FRAMES) if k not in (3, 4, 5)]
    (block,) = found.open
    assert sorted(block.nodes) == [3, 4, 5] and block.turn_deg == pytest.approx(TURN, abs=0.1)
    assert 0 <= block.log_odds < 10
    assert off_deg({**found.decided, **block.nodes}) < 0.1 and not one.sides().by_order


class Seen(Said):
    """An assembly in which surfaces say by how much frames are off, whatever the pairs say."""

    def looks_alike(self, nodes, turn) -> bool:
        return False

    def compare(self, first, second, nodes, alike=False) -> Comparison:
        off = [
            sum(
                angle_deg(relative(at, i, j).R @ relative(dict(enumerate(NODES)), i, j).R.T)
                for i in first
                for j in second
            )
            for at in nodes
        ]
        return by_odds(1e4 - np.array(off))


def test_a_frame_that_one_pair_holds_at_a_wrong_place_is_put_where_the_others_see_it():
    """The wrong pair is ten times as certain, and no other knows its place better than the right one."""
    slipped = about_axis(8.0) @ NODES[4]
    edges = []
    for e in pairs(-30.0):
        if {e.source, e.target} == {4, 5}:
            wrong = NODES[e.target].inverse() @ slipped if e.source == 4 else slipped.inverse() @ NODES[e.source]
            edges.append(replace(e, S_target_source=wrong, rivals=(), information=e.information))
        elif 4 in (e.source, e.target):
            there = NODES[e.target].inverse() @ slipped if e.source == 4 else slipped.inverse() @ NODES[e.source]
            edges.append(replace(e, rivals=(Rival(there, -8.0),), information=e.information / 100))
        else:
            edges.append(e)
    start = {**dict(enumerate(NODES)), 4: slipped}
    found = BlockReview(Seen(edges, None), start).settled()
    assert sorted(found.decided) == list(range(FRAMES)) and not found.open
    assert off_deg(found.decided) < 0.1


@pytest.mark.slow
def test_the_order_of_capture_keeps_what_surfaces_leave_open_and_that_is_said():
    def prior(i: int, j: int, S: Similarity) -> float:
        return -25.0 * float(abs(i - j) == 1 and abs(angle_deg(S.R) - 30) > 10)

    one = BlockReview(Said(pairs(0.0), prior), dict(enumerate(NODES)))
    found = one.settled()
    assert sorted(found.decided) == list(range(FRAMES)) and one.sides().by_order
    assert set(one.sides().by_order) < set(range(FRAMES))
    assert len(review(pairs(0.0), dict(enumerate(NODES))).decided) < FRAMES


@settings(max_examples=40)
@given(st.integers(2, 7), st.integers(0, 10**6))
def test_a_block_gains_what_is_said_and_at_least_as_much_as_any_single_frame(n, seed):
    gain = np.random.default_rng(seed).normal(size=(n, n))
    np.fill_diagonal(gain, 0)
    cut = best_block(gain, Turn(Similarity.identity(), False, gain, gain))
    assert 0 < cut.block.sum() < n
    assert cut.gain == pytest.approx(gain[np.ix_(cut.block, ~cut.block)].sum())
    single = max(gain[k].sum() for k in range(n))
    assert cut.gain >= single - 1e-9
