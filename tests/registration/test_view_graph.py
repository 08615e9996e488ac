"""Which pairs of frames are compared, which hold, and what rough poses of cameras say."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration import view_graph as module
from sl_nerfstudio.registration.assembly import Assembly
from sl_nerfstudio.registration.blocks import OpenBlock, Settled, Sides
from sl_nerfstudio.registration.evidence import Commonness, Frame
from sl_nerfstudio.registration.pairs import LEAST_ODDS, NEIGHBOURS, PairMatch, Rival
from sl_nerfstudio.registration.pose_graph import Component, Pivots
from sl_nerfstudio.registration.view_graph import (
    MOST_BY_ORDER,
    ViewGraph,
    compared_pairs,
    starting_similarities,
    with_common_centre,
    with_confirmed_tones,
    without_slipping,
)
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of

# Which pairs are compared.


def test_of_a_few_frames_all_pairs_are_compared_and_of_many_those_that_see_nearly_the_same():
    assert compared_pairs(np.random.default_rng(0).random((7, 7)), 6) == list(combinations(range(7), 2))
    assert compared_pairs(np.zeros((1, 1)), 40) == []
    turn = np.radians(np.arange(0, 360, 3.6))
    sight = np.stack([np.cos(turn), np.sin(turn), np.zeros(100)], 1)
    pairs = compared_pairs(-sight @ sight.T, 6)
    assert pairs == sorted({tuple(sorted((k, (k + gap) % 100))) for k in range(100) for gap in (1, 2, 3)})


def test_frames_without_a_pose_come_last():
    rank = np.random.default_rng(1).random((5, 5))
    rank[2] = rank[:, 2] = np.nan
    assert all(2 in pair for pair in set(combinations(range(5), 2)) - set(compared_pairs(rank, 3)))


# Pairs that slip, and pairs that only tones hold: frames of one walk about an axis, `deg` apart.

AXIS = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])  # the motion along which frames slip: about y
CENTRE = np.array([0.1, 0.0, -3.0])
PIVOTS = Pivots(np.tile(CENTRE, (4, 1)), np.ones(4))


def pair(source: int, target: int, deg: float = 20.0, slip: float = 0.0, rivals: tuple[Rival, ...] = ()) -> PairMatch:
    """Two frames."""
    R = Rotation.from_rotvec([0, np.radians(deg), 0]).as_matrix()
    S = Similarity(1.0, R, CENTRE - R @ CENTRE)
    none = Commonness.none(1), Commonness.none(1)
    return PairMatch(source, target, S, 1e4 * np.eye(7), 0.6, 0.98, 100.0, rivals, 0.5, slip, AXIS, none, (1.0, 1.0))


def toned(source: int, target: int, deg: float) -> PairMatch:
    """Two frames that only their tones hold."""
    return replace(pair(source, target, deg), by_shape=pair(source, target, deg + 5, slip=12.0))


def test_pairs_that_slip_count_only_where_nothing_else_holds_a_frame():
    """Bounded slips hold; slips to frames that are not in the component stay."""
    component = dict.fromkeys((0, 1, 2), Similarity.identity())
    firm, bounded, slipping, outside = pair(0, 1), pair(2, 1, slip=8.0), pair(0, 2, slip=12.0), pair(3, 0, slip=12.0)
    assert without_slipping([firm, slipping, bounded, outside], component) == [firm, bounded, outside]
    edges = [pair(0, 1), pair(0, 2, slip=12.0), pair(1, 2, slip=15.0)]
    assert without_slipping(edges, component) == edges
    assert without_slipping([], {0: Similarity.identity()}) == []


@pytest.mark.parametrize("last", [toned(0, 2, 45), toned(2, 0, -45)], ids=["forwards", "backwards"])
def test_three_pairs_that_close_a_cycle_confirm_each_other_and_others_slip(last):
    edges = [toned(0, 1, 20), toned(1, 2, 25), last, toned(0, 3, 60), toned(1, 3, 100)]
    found = with_confirmed_tones(edges, PIVOTS)
    assert found[:3] == edges[:3] and all(e.by_tone for e in found[:3])
    assert [(e.by_tone, e.slip_deg) for e in found[3:]] == [(False, 12.0)] * 2


def test_pairs_that_surfaces_hold_confirm_tones_and_pairs_that_slip_do_not():
    firm, slipping = pair(1, 2, 25), pair(1, 2, 25, slip=12.0)
    for third, confirmed in ((firm, True), (slipping, False)):
        found = with_confirmed_tones([toned(0, 1, 20), third, toned(0, 2, 45)], PIVOTS)
        assert [e.by_tone for e in found] == [confirmed, False, confirmed]
    assert with_confirmed_tones([firm], PIVOTS) == [firm]


# The order of capture, of pairs that are said to be registered.


def graph_of(monkeypatch: pytest.MonkeyPatch, pairs: list[PairMatch], captures: list[int] | None = None) -> ViewGraph:
    """The frames of the ring below with given pairs."""
    said = {(e.source, e.target): e for e in pairs}
    monkeypatch.setattr(module, "register_pair", lambda frames, numbers, *_: said[numbers])
    graph = ViewGraph(SEEN, {}, np.random.default_rng(0), captures)
    graph.try_pairs(list(said), NEIGHBOURS)
    return graph


def walk(turns: list[float]) -> list[PairMatch]:
    """Pairs of successive frames of a walk with these turns, and of those with one frame between."""
    beside = [pair(k, k + 1, turns[k]) for k in range(FRAMES - 1)]
    return beside + [pair(k, k + 2, turns[k] + turns[k + 1]) for k in range(FRAMES - 2)]


def turned(deg: float) -> Similarity:
    return pair(0, 1, deg).S_target_source


def test_the_usual_step_is_that_which_makes_all_pairs_most_likely(monkeypatch):
    """Not the least that each allows, as a tooth of a gear away."""
    pairs = walk([15.0 + k % 3 for k in range(FRAMES)])
    pairs[0] = pair(0, 1, -3.0, rivals=(Rival(turned(16.0), -1.0),))
    graph = graph_of(monkeypatch, pairs)
    assert graph.usual_step(0, 1, turned(40.0)) == 0.0  # not known yet
    graph.learn_step()
    assert graph.step is not None and graph.step.deg == pytest.approx(16, abs=2.5)
    usual = graph.usual_step(0, 1, turned(-16.0))  # pairs say where the earlier camera is on the later one
    assert -0.5 < usual <= 0 and graph.usual_step(1, 0, turned(16.0)) == pytest.approx(usual)
    assert graph.usual_step(0, 1, turned(3.0)) < -LEAST_ODDS  # a tooth away: as small a turn, the other way round
    assert graph.usual_step(0, 2, turned(90.0)) == 0.0  # each step counts once
    assert graph.usual_step(0, 1, turned(170.0)) == -MOST_BY_ORDER  # someone may have walked to the other side


def test_a_capture_that_shows_nothing_is_a_step_all_the_same(monkeypatch):
    """The last frame was taken two steps after the one before."""
    turns = [15.0 + k % 3 for k in range(FRAMES - 1)]
    turns[-1] = 32.0
    for captures, usual_deg in ((None, 16.0), ([*range(FRAMES - 1), FRAMES], 32.0)):
        graph = graph_of(monkeypatch, walk(turns), captures)
        graph.learn_step()
        odds = {deg: graph.usual_step(FRAMES - 2, FRAMES - 1, turned(-deg)) for deg in (0.0, 16.0, 32.0, 48.0)}
        assert max(odds, key=lambda deg: odds[deg]) == usual_deg
    assert graph.step is not None and graph.step.deg == pytest.approx(16, abs=1)


def test_where_surfaces_decide_nothing_small_steps_are_likely(monkeypatch):
    """A nut is as likely turned by another 60 degrees."""
    pairs = [pair(k, k + 1, -42.0, rivals=(Rival(turned(18.0), 0.0),)) for k in range(FRAMES - 1)]
    far = (Rival(turned(-24.0), 0.0), Rival(turned(36.0), 0.0))
    graph = graph_of(monkeypatch, pairs + [pair(k, k + 2, -84.0, rivals=far) for k in range(FRAMES - 2)])
    graph.learn_step()
    assert graph.step is not None and graph.step.deg == pytest.approx(18, abs=2)
    assert graph.usual_step(0, 1, turned(-18.0)) > graph.usual_step(0, 1, turned(42.0)) + LEAST_ODDS


def test_teeth_that_lead_by_what_pixels_share_do_not_hide_the_usual_step(monkeypatch):
    """Of a gear whose teeth are 24 degrees apart: in most pairs another tooth leads by a few nats."""
    pairs: list[PairMatch] = []
    for e in walk([15.0] * FRAMES):
        gap = e.target - e.source
        right, wrong = 15.0 * gap, 15.0 * gap + 24.0 * (-1) ** e.source * (1 + e.source % 2)
        first, second = (right, wrong) if e.source == 0 else (wrong, right)
        pairs.append(pair(e.source, e.target, first, rivals=(Rival(turned(second), -5.0),)))
    graph = graph_of(monkeypatch, pairs)
    graph.learn_step()
    assert graph.step is not None and graph.step.deg == pytest.approx(15, abs=2)


IN_NO_ORDER = {
    "someone walks to and fro": lambda small, wide: walk([15.0 * (-1) ** (k // 3) for k in range(FRAMES)]),
    "no frames between": lambda small, wide: [pair(k, k + 1, 15.0) for k in range(FRAMES - 1)],
    "large turns": lambda small, wide: [pair(k, k + 1, wide[k]) for k in range(FRAMES - 1)],
    # as all pairs of an object allow that looks the same after every 40 degrees
    "turns that do not grow with the gap": lambda small, wide: [
        pair(k, k + gap, small[gap - 1][k]) for gap in (1, 2) for k in range(FRAMES - gap)
    ],
    "most slip": lambda small, wide: [pair(k, k + 1, slip=12.0 * (k > 1)) for k in range(FRAMES - 1)],
}


@pytest.mark.parametrize("case", IN_NO_ORDER)
def test_frames_in_no_order_have_no_usual_step(monkeypatch, case):
    small = np.random.default_rng(1).uniform(-20, 20, (2, FRAMES)).tolist()
    wide = np.random.default_rng(0).uniform(20, 170, FRAMES).tolist()
    graph = graph_of(monkeypatch, IN_NO_ORDER[case](small, wide))
    graph.learn_step()
    assert graph.step is None and graph.usual_step(0, 1, turned(170.0)) == 0.0


# Blocks whose place is not decided.


def test_what_is_taken_apart_is_looked_at_again_inside(monkeypatch):
    """Of six frames two are decided; of the four others, which are open, only three hold together."""
    graph = graph_of(monkeypatch, [pair(k, k + 1) for k in range(FRAMES - 1)])
    reviewed: list[list[int]] = []

    class Review:
        def __init__(self, assembly: Assembly, component: Component) -> None:
            self.nodes = component

        def settled(self) -> Settled:
            reviewed.append(sorted(self.nodes))
            kept = reviewed[-1][: 2 if len(self.nodes) == FRAMES else 3]
            rest = {k: S for k, S in self.nodes.items() if k not in kept}
            open_ = (OpenBlock(rest, 90.0, float(len(rest))),) if rest else ()
            return Settled({k: self.nodes[k] for k in kept}, open_)

        def sides(self) -> Sides:
            return Sides(tuple(self.nodes) if len(self.nodes) < FRAMES else (), (90.0,))

    monkeypatch.setattr(module, "BlockReview", Review)
    monkeypatch.setattr(Assembly, "grow", lambda self: [{k: Similarity.identity() for k in range(FRAMES)}])
    assert [sorted(c) for c in graph.assemble()] == [[2, 3, 4], [0, 1], [5]]
    assert [(sorted(block.nodes), block.log_odds) for block in graph.open] == [([2, 3, 4], 4.0), ([5], 1.0)]
    assert reviewed == [[0, 1, 2, 3, 4, 5], [2, 3, 4, 5]] and graph.sides_of_object() == Sides((2, 3, 4, 5), (90.0,))


# Rough camera poses as a start: baselines, and a common centre.

FRAMES = 6
RIG = rig_of(FRAMES, 60)
POSES = RIG.T_world_camera.numpy()
SEEN = [Frame.of(c) for c in clouds_of(RIG, 60)]
MAPS = [frame.map for frame in SEEN]


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.floats(0.01, 100))
def test_baselines_are_about_right_whatever_the_axes_and_the_unit(seed, unit):
    """Centroids of the visible parts differ, so lengths are only about right."""
    reference = starting_similarities(POSES, MAPS)
    true = RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy()
    np.testing.assert_allclose([S.scale for S in reference.values()], true, rtol=0.25)
    T = POSES.copy()
    T[:, :3, 3] *= unit
    world = np.eye(4)
    world[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    world[:3, 3] = unit * np.random.default_rng(seed).normal(size=3)
    T = world @ T
    found = starting_similarities(T, MAPS)
    assert list(found) == list(range(FRAMES))
    for k, S in found.items():
        np.testing.assert_array_equal(S.R, T[k, :3, :3])
        np.testing.assert_array_equal(S.t, T[k, :3, 3])
        assert S.scale == pytest.approx(unit * reference[k].scale, rel=1e-9)


def test_frames_without_a_pose_have_no_start():
    T = POSES.copy()
    T[2] = np.nan
    T[4, 0, 0] = np.nan
    found = starting_similarities(T, MAPS)
    assert list(found) == list(with_common_centre(found, MAPS)) == [0, 1, 3, 5]
    none = starting_similarities(np.full_like(POSES, np.nan), MAPS)
    assert none == with_common_centre(none, MAPS) == {}


def test_a_camera_that_looks_away_gets_the_distance_of_the_others():
    T = POSES.copy()
    T[1, :3, :3] = T[1, :3, :3] @ np.diag([1.0, -1, -1])  # the object is behind it
    found = starting_similarities(T, MAPS)
    distances = [S.scale * np.linalg.norm(m.centroid) for S, m in zip(found.values(), MAPS, strict=True)]
    assert distances[1] == pytest.approx(np.median(np.delete(distances, 1)), rel=0.2)
    assert min(distances) > 0


@settings(max_examples=20)
@given(st.integers(0, 10**6))
def test_all_frames_look_at_one_centre_and_keep_their_rotations(seed):
    T = POSES.copy()
    turns = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, np.radians(8), (FRAMES, 3))).as_matrix()
    T[:, :3, :3] = T[:, :3, :3] @ turns
    rough = starting_similarities(T, MAPS)
    found = with_common_centre(rough, MAPS)
    before, after = (
        np.array([S.points(m.views[0].centre[None])[0] for S, m in zip(some.values(), MAPS, strict=True)])
        for some in (rough, found)
    )
    np.testing.assert_allclose(after, np.tile(np.median(before, axis=0), (FRAMES, 1)), atol=1e-9)
    for k, S in found.items():
        np.testing.assert_array_equal(S.R, rough[k].R)
        assert S.scale == rough[k].scale
