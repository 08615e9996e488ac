"""Frames put together into components: what is joined, and what stays apart."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.agreement import Side
from sl_nerfstudio.registration.assembly import Assembly, Pivots
from sl_nerfstudio.registration.pairs import PairMatch, Rival
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.surfaces import build_surface_map
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, difference, part_of, similarities_of
from tests.registration.graph_edges import edge, turned

SIZE, FRAMES = 70, 8
RIG = part_of(rig_of(18, SIZE), list(range(FRAMES)))  # 20 degrees from frame to frame
TRUE = similarities_of(RIG.T_world_camera.numpy(), RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy())
FIRST, SECOND = [(0, 1), (1, 2), (2, 3), (0, 2)], [(4, 5), (5, 6), (6, 7), (5, 7)]  # two blocks


@pytest.fixture(scope="module")
def sides():
    maps = [build_surface_map(c) for c in clouds_of(RIG, SIZE, noise=0.1)]
    return [Side.sampled(m, 400, np.random.default_rng(0)) for m in maps]


def assembled(sides, edges):
    pivots = Pivots(np.stack([s.map.centroid for s in sides]), np.array([s.map.radius for s in sides]))
    return Assembly(sides, pivots, edges, REGISTRATION_DEFAULTS).grow()


def right(pairs, **kwargs) -> list[PairMatch]:
    return [edge(TRUE, i, j, **kwargs) for i, j in pairs]


def wrong(sides, i: int, j: int, degrees: float = 40.0, **kwargs) -> PairMatch:
    """A registration that is off by a rotation about the object."""
    true = edge(TRUE, i, j, **kwargs)
    return replace(true, S_target_source=turned(true.S_target_source, degrees, sides[j].map.centroid))


def rival(sides, i: int, j: int, degrees: float, ratio: float) -> Rival:
    return Rival(wrong(sides, i, j, degrees).S_target_source, ratio)


def frames_of(components) -> list[list[int]]:
    return [sorted(c) for c in components]


def assert_right(component) -> None:
    """All frames of a component are where they belong, to the first of them."""
    first = next(iter(component))
    for k, S in component.items():
        expected = component[first] @ TRUE[first].inverse() @ TRUE[k]
        angle, shift, scale = difference(S, expected, np.zeros(3))
        assert angle < 0.5 and shift < 0.05 and scale < 0.01


def test_blocks_with_several_agreeing_pairs_are_joined(sides):
    (whole,) = assembled(sides, right([*FIRST, *SECOND, (3, 4), (2, 4), (3, 5)]))
    assert sorted(whole) == list(range(FRAMES))
    assert_right(whole)


def test_one_pair_that_determines_everything_joins_two_blocks(sides):
    (whole,) = assembled(sides, right([*FIRST, *SECOND, (3, 4)]))
    assert_right(whole)


@pytest.mark.parametrize("degrees", [15, 25, 40, 90, 180])
def test_two_blocks_with_one_wrong_pair_between_them_stay_apart(sides, degrees):
    """The pair is as good as any by its own figures; the frames across contradict it."""
    components = assembled(sides, [*right([*FIRST, *SECOND]), wrong(sides, 3, 4, degrees)])
    assert frames_of(components) == [[0, 1, 2, 3], [4, 5, 6, 7]]
    for component in components:
        assert_right(component)


def test_right_pairs_outvote_a_wrong_one_that_seems_better(sides):
    edges = [*right([*FIRST, *SECOND, (3, 4), (2, 4)], fitness=0.97), wrong(sides, 3, 5, 40, fitness=0.99)]
    (whole,) = assembled(sides, edges)
    assert sorted(whole) == list(range(FRAMES))
    assert_right(whole)


def test_a_pair_with_a_rival_as_good_joins_nothing(sides):
    doubtful = edge(TRUE, 3, 4, rivals=(rival(sides, 3, 4, 30, 0.95),))
    components = assembled(sides, [*right([*FIRST, *SECOND]), doubtful])
    assert frames_of(components) == [[0, 1, 2, 3], [4, 5, 6, 7]]
    clear = edge(TRUE, 3, 4, rivals=(rival(sides, 3, 4, 30, 0.3),))
    assert len(assembled(sides, [*right([*FIRST, *SECOND]), clear])) == 1


def test_pairs_that_are_undecided_alone_decide_together(sides):
    """What one takes for possible, the others do not: only the truth is said by all."""
    edges = right([*FIRST, *SECOND])
    edges += [edge(TRUE, i, j, rivals=(rival(sides, i, j, turn, 0.95),))
              for (i, j), turn in zip([(3, 4), (2, 4), (3, 5)], (30, -35, 60), strict=True)]  # fmt: skip
    (whole,) = assembled(sides, edges)
    assert_right(whole)


def test_a_pair_whose_rotation_is_open_joins_nothing_alone_and_something_together(sides):
    slipping = right([(3, 4)], sigma_deg=8.0)
    assert len(assembled(sides, [*right([*FIRST, *SECOND]), *slipping])) == 2
    assert len(assembled(sides, [*right([*FIRST, *SECOND]), *right([(3, 4), (2, 4), (3, 5)], sigma_deg=8.0)])) == 1


def test_a_pair_that_may_slip_keeps_apart_only_what_would_not_notice_it(sides):
    """The balls on the disk show a turn about the line of sight, whatever one pair says of itself."""
    edges = right([*FIRST, *SECOND, (3, 4), (2, 4)])
    slipping = right([(3, 5)], slip_deg=8.0)
    pivots = Pivots(np.stack([s.map.centroid for s in sides]), np.array([s.map.radius for s in sides]))
    held = Assembly(sides, pivots, edges, REGISTRATION_DEFAULTS, None, slipping).grow()
    assert frames_of(held) == [list(range(FRAMES))]
    blind = replace(REGISTRATION_DEFAULTS, pair=replace(REGISTRATION_DEFAULTS.pair, slip_rise=1.0))
    apart = Assembly(sides, pivots, edges, blind, None, slipping).grow()
    assert frames_of(apart) == [[0, 1, 2, 3], [4, 5, 6, 7]]


def test_without_pairs_every_frame_stands_alone(sides):
    assert frames_of(assembled(sides, [])) == [[k] for k in range(FRAMES)]


@settings(max_examples=2)
@given(st.randoms(use_true_random=False))
def test_the_result_does_not_depend_on_the_order_of_the_edges(sides, random):
    edges = right([*FIRST, *SECOND, (2, 4)])
    edges.append(wrong(sides, 3, 4, 50))
    edges = [replace(e, overlap=0.5 + 0.01 * k) for k, e in enumerate(edges)]
    expected = assembled(sides, edges)
    found = assembled(sides, random.sample(edges, len(edges)))
    assert frames_of(found) == frames_of(expected)
    for a, b in zip(found, expected, strict=True):
        first = min(a)
        for k in a:
            relative = [(c[first].inverse() @ c[k]).matrix() for c in (a, b)]
            np.testing.assert_allclose(relative[0], relative[1], atol=1e-6)


def test_an_edge_may_be_given_in_either_direction(sides):
    def reversed_edge(e: PairMatch) -> PairMatch:
        return replace(e, source=e.target, target=e.source, S_target_source=e.S_target_source.inverse())

    edges = right([*FIRST, *SECOND, (3, 4), (2, 4)])
    (whole,) = assembled(sides, [reversed_edge(e) if k % 2 else e for k, e in enumerate(edges)])
    assert_right(whole)
    assert isinstance(whole[0], Similarity)
