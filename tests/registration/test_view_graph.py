"""Which pairs of frames are compared with each other: all of a few frames, some of many."""

from itertools import combinations

import numpy as np

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.pairs import PairMatch
from sl_nerfstudio.registration.view_graph import compared_pairs, without_slipping


def test_of_a_few_frames_all_pairs_are_compared_in_order():
    rank = np.random.default_rng(0).random((7, 7))
    assert compared_pairs(rank, 6) == list(combinations(range(7), 2))
    assert compared_pairs(np.zeros((1, 1)), 40) == []


def test_each_of_many_frames_is_compared_with_those_that_see_nearly_the_same():
    turn = np.radians(np.arange(0, 360, 3.6))
    sight = np.stack([np.cos(turn), np.sin(turn), np.zeros(100)], 1)
    pairs = compared_pairs(-sight @ sight.T, 6)
    assert pairs == sorted({tuple(sorted((k, (k + gap) % 100))) for k in range(100) for gap in (1, 2, 3)})


def test_frames_without_a_pose_come_last():
    rank = np.random.default_rng(1).random((5, 5))
    rank[2] = rank[:, 2] = np.nan
    assert all(2 in pair for pair in set(combinations(range(5), 2)) - set(compared_pairs(rank, 3)))


def pair(source: int, target: int, slip_deg: float = 0.0) -> PairMatch:
    return PairMatch(source, target, Similarity.identity(), np.eye(7), 0.5, 0.9, 0.02, (), 0.5, slip_deg, np.zeros(7))


COMPONENT = dict.fromkeys((0, 1, 2), Similarity.identity())


def test_pairs_that_slip_say_nothing_about_frames_that_others_hold():
    """Bounded slips hold; slips to frames that are not in the component stay."""
    firm, bounded, slipping, outside = pair(0, 1), pair(2, 1, 4.0), pair(0, 2, 12.0), pair(3, 0, 12.0)
    assert without_slipping([firm, slipping, bounded, outside], COMPONENT, 4.0) == [firm, bounded, outside]


def test_pairs_that_slip_stay_where_nothing_else_holds_a_frame():
    edges = [pair(0, 1), pair(0, 2, 12.0), pair(1, 2, 8.0)]
    assert without_slipping(edges, COMPONENT, 4.0) == edges
    assert without_slipping([], {0: Similarity.identity()}, 4.0) == []
