"""Objects that look the same, or nearly, from several sides: turns, turned blocks of frames, the order of capture."""

from copy import copy
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.agreement import Side
from sl_nerfstudio.registration.assembly import PoseGraphSolution
from sl_nerfstudio.registration.pairs import PairMatch, Rival
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.surfaces import build_surface_map
from sl_nerfstudio.registration.symmetry import (
    BLOCK_NEIGHBOURS,
    TurnedBlock,
    _best_cut,
    _longest_run,
    _motion_in_camera,
    _parts,
    chain_of_small_steps,
    exact_turn,
    judged,
    sides_are_open,
    symmetric_turns_deg,
    turned_back,
    turned_blocks,
    typical_step_deg,
)
from sl_nerfstudio.registration.view_graph import ViewGraph
from tests.registration.graph_edges import edge
from tests.registration.shaped_clouds import RenderedClouds, rendered, write_bar

FRAMES = 8  # all the way around
BLOCK = (3, 4, 5)
STEPS, ALL_AROUND = 8, 30  # steps of 9 to 17 degrees; a nut looks the same after 60


@pytest.fixture(scope="module")
def nut_file(tmp_path_factory: pytest.TempPathFactory) -> str:
    path: Path = tmp_path_factory.mktemp("meshes") / "nut.ply"
    trimesh.creation.cylinder(30, 25, sections=6).export(path)
    return str(path)


class Scan:
    """Frames at their true places, with right pairs of neighbours."""

    def __init__(self, scene: str) -> None:
        made = rendered(scene, tuple(range(FRAMES)), FRAMES, 90)
        rng = np.random.default_rng(0)
        self.nodes = dict(enumerate(made.S_world_camera))
        self.axis = np.zeros(3)
        self.sides = [Side.sampled(build_surface_map(c), 400, rng) for c in made.clouds]
        self.pairs = [self.pair(k, (k + 1) % FRAMES) for k in range(FRAMES)]

    def aside(self, x: float) -> "Scan":
        """The same scan with the world's origin beside the object's axis."""
        other = copy(self)
        shift = Similarity(1.0, np.eye(3), np.array([x, 0.0, 0.0]))
        other.nodes = {k: shift @ S for k, S in self.nodes.items()}
        other.axis = np.array([x, 0.0, 0.0])
        return other

    def turned(self, i: int, j: int, degrees: float, scale: float = 1.0) -> Similarity:
        """What a pair says that takes one side of the object for another: it is turned about the vertical axis."""
        R = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        turn = Similarity(scale, R, self.axis - scale * R @ self.axis)
        return self.nodes[j].inverse() @ turn @ self.nodes[i]

    def pair(self, i: int, j: int, rivals: tuple[Rival, ...] = ()) -> PairMatch:
        return edge(list(self.nodes.values()), i, j, rivals=rivals)

    def turns(self, *others: PairMatch, used: bool = False) -> tuple[float, ...]:
        edges = [*self.pairs, *others]
        consistent = np.array([True] * len(self.pairs) + [used] * len(others))
        return symmetric_turns_deg(self.sides, edges, PoseGraphSolution(self.nodes, consistent))


# Symmetric turns.


def contradicting(scan: Scan, degrees: float, scale: float = 1.0) -> PairMatch:
    right = scan.pair(0, 2)
    return PairMatch(**{**vars(right), "S_target_source": scan.turned(0, 2, degrees, scale)})


@pytest.fixture(scope="module")
def nut(nut_file: str) -> Scan:
    return Scan(nut_file)


def test_a_nut_looks_the_same_after_a_sixth_of_a_turn(nut: Scan) -> None:
    assert nut.turns() == ()  # pairs that agree with each other leave no doubt
    assert nut.turns(contradicting(nut, 60.0), contradicting(nut, 120.0)) == pytest.approx((60.0, 120.0), abs=0.3)


def test_all_frames_together_know_the_turn_better_than_the_pair_that_says_it(nut: Scan) -> None:
    """A turn that is off by some degrees, or has a scale, moves edges of the nut past each other."""
    for degrees, scale in ((57.0, 1.0), (61.0, 1.0), (60.0, 0.96), (62.0, 1.03)):
        assert nut.turns(contradicting(nut, degrees, scale)) == pytest.approx((60.0,), abs=0.3)


def test_a_rival_says_it_as_well(nut: Scan) -> None:
    doubtful = nut.pair(0, 2, (Rival(nut.turned(0, 2, -60.0), 0.9),))
    assert nut.turns(doubtful, used=True) == pytest.approx((60.0,), abs=0.3)


@pytest.mark.parametrize("degrees", [30.0, 45.0, 90.0])
def test_a_pair_that_fits_by_accident_is_no_symmetry(nut: Scan, degrees: float) -> None:
    assert nut.turns(contradicting(nut, degrees)) == ()
    assert nut.turns(contradicting(nut, 60.0, 1.2)) == ()  # nor is one that changes the size


def test_a_frog_has_no_symmetry() -> None:
    frog = Scan("frog")
    assert frog.turns(contradicting(frog, 60.0), contradicting(frog, 180.0)) == ()


def test_half_a_turn_made_twice_is_the_turn_and_three_eighths_made_eight_times_three() -> None:
    rng = np.random.default_rng(1)
    for degrees in (12.0, 90.0, 179.9):
        axis = rng.standard_normal(3)
        R = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
        turn = Similarity(1.03, R, rng.standard_normal(3))
        half, more = _parts(turn)
        np.testing.assert_allclose((half @ half).matrix(), turn.matrix(), atol=1e-12)
        twice = more @ more
        eight = twice @ twice @ twice @ twice
        np.testing.assert_allclose(eight.R, (turn @ turn @ turn).R, atol=1e-12)
        np.testing.assert_allclose(eight.t, (turn @ turn @ turn).t, atol=1e-10)
        for part, share in ((half, 1 / 2), (more, 3 / 8)):
            assert angle_deg(part.R) == pytest.approx(degrees * share)


@pytest.mark.slow
def test_what_is_round_has_no_sides() -> None:
    """A vase contradicts as little after any turn: which of two turns contradicts less is chance, and says nothing."""
    vase = Scan("vase")
    for degrees in (29.0, 60.0):
        assert vase.turns(contradicting(vase, degrees)) == ()
        assert vase.aside(25.0).turns(contradicting(vase.aside(25.0), degrees)) == ()


@pytest.mark.slow
def test_a_medal_that_slides_a_little_is_not_symmetric() -> None:
    medal = Scan("medal")
    for degrees in (10.0, 16.0):
        assert medal.turns(contradicting(medal, degrees)) == ()


def test_motions_of_the_world_are_those_of_points_in_the_camera() -> None:
    """Against points moved in the world, in a camera with a unit of its own."""
    rng = np.random.default_rng(0)
    S = Similarity(1.7, Rotation.random(random_state=3).as_matrix(), rng.standard_normal(3))
    centre, c = rng.standard_normal(3), rng.standard_normal(3)
    p = rng.standard_normal((5, 3))
    M = _motion_in_camera(S, c, centre) / S.scale
    for axis in range(6):
        x = 1e-6 * np.eye(6)[axis]
        world = S.points(p)
        moved = centre + (world - centre) @ Rotation.from_rotvec(x[3:]).as_matrix().T + x[:3]
        v, w, growth = np.split(M @ x, [3, 6])
        assert growth == 0
        expected = c + (p - c) @ Rotation.from_rotvec(w).as_matrix().T + v
        np.testing.assert_allclose(S.inverse().points(moved), expected, atol=1e-11)


@pytest.mark.parametrize("aside", [0.0, 40.0])
def test_the_turn_of_a_nut_is_found_from_five_degrees_off(nut: Scan, aside: float) -> None:
    """Its axis, too, wherever the world's origin is; and a turn has no scale."""
    scan = nut.aside(aside)
    tilt = Rotation.from_euler("xyz", [2.0, -1.5, 57.0], degrees=True).as_matrix()
    start = Similarity(1.04, tilt, scan.axis - 1.04 * tilt @ scan.axis + [1.0, -0.5, 0.8])
    turn = exact_turn(scan.sides, scan.nodes, start)
    assert turn.scale == 1.0
    true = Rotation.from_euler("z", 60.0, degrees=True).as_matrix()
    assert angle_deg(turn.R @ true.T) < 0.3
    assert np.linalg.norm(turn.points(scan.axis[None])[0] - scan.axis) < 0.3  # millimetres of 60


# Turned blocks: frames on the wrong side of a bar that looks nearly the same after half a turn.


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """Two bosses, one on each end, of unequal height."""
    path: Path = tmp_path_factory.mktemp("meshes") / "bar.ply"
    write_bar(path)
    return Scan(str(path))


def misplaced(scan: Scan, degrees: float = 180.0) -> tuple[list[PairMatch], PoseGraphSolution]:
    """The frames of the block turned; all pairs hold them there, but one across the two that says the truth."""
    half = scan.nodes[0] @ scan.turned(0, 0, degrees) @ scan.nodes[0].inverse()
    nodes = {k: half @ S if k in BLOCK else S for k, S in scan.nodes.items()}
    sight = np.array([S.R[:, 2] for S in nodes.values()])
    near = [(i, j) for j in range(FRAMES) for i in range(j) if sight[i] @ sight[j] > 0.5]
    edges = [replace(scan.pair(i, j), S_target_source=nodes[j].inverse() @ nodes[i]) for i, j in near]
    truth = scan.pair(2, 3)
    edges = [e for e in edges if (e.source, e.target) != (2, 3)]
    return [*edges, truth], PoseGraphSolution(nodes, np.array([True] * len(edges) + [False]))


def found_in(scan: Scan, edges: list[PairMatch], solution: PoseGraphSolution) -> list[TurnedBlock]:
    before = judged(scan.sides, solution.S_world_camera, Similarity.identity(), BLOCK_NEIGHBOURS)
    return turned_blocks(scan.sides, edges, solution, before)


def test_the_turned_block_is_found_with_its_turn(bar: Scan) -> None:
    found = found_in(bar, *misplaced(bar))
    assert found
    others = tuple(k for k in range(FRAMES) if k not in BLOCK)
    assert found[0].frames in (BLOCK, others)  # which of the two is turned does not matter
    assert angle_deg(found[0].turn.R) == pytest.approx(180.0, abs=0.1)
    assert found[0].relief > 0.5


def test_where_all_frames_are_right_none_is_turned(bar: Scan) -> None:
    wrong = replace(bar.pair(0, 1), S_target_source=bar.turned(0, 1, 180.0))
    edges = [*bar.pairs, wrong]
    solution = PoseGraphSolution(bar.nodes, np.array([True] * len(bar.pairs) + [False]))
    assert found_in(bar, edges, solution) == []


def test_of_what_is_the_same_from_both_sides_no_block_is_turned(tmp_path: Path) -> None:
    trimesh.creation.box((90, 40, 24)).export(tmp_path / "box.ply")
    box = Scan(str(tmp_path / "box.ply"))
    assert found_in(box, *misplaced(box)) == []


def test_pairs_across_are_registered_anew_where_the_block_belongs(bar: Scan) -> None:
    edges, solution = misplaced(bar)
    maps = [side.map for side in bar.sides]
    graph = ViewGraph(maps, {}, np.random.default_rng(0))
    graph.restore(({(e.source, e.target): e for e in edges}, []))
    component = solution.S_world_camera
    assert max(off_deg(bar, e) for e in graph.matches) == pytest.approx(180, abs=1)
    assert turned_back(graph, component)
    assert max(off_deg(bar, e) for e in graph.matches) < 3
    assert any((e.source in BLOCK) != (e.target in BLOCK) for e in graph.matches)
    aside = graph.put_aside
    assert aside and all(off_deg(bar, e) > 170 for e in aside)
    assert graph.said == [*graph.matches, *aside]


def test_nothing_changes_where_pairs_do_not_confirm_a_turn(bar: Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if nothing could be registered across the two."""
    edges, solution = misplaced(bar)
    graph = ViewGraph([s.map for s in bar.sides], {}, np.random.default_rng(0))
    before = {(e.source, e.target): e for e in edges}
    graph.restore((before, []))
    monkeypatch.setattr(ViewGraph, "try_overlapping", lambda *_: None)
    component = solution.S_world_camera
    graph.set_aside(component, [(2, 3)])  # the pair that says the truth, and would hold the block alone
    truth = graph.put_aside
    assert [(e.source, e.target) for e in truth] == [(2, 3)]
    graph.restore(({**graph.snapshot()[0], (0, 6): replace(bar.pair(0, 6), S_target_source=bar.turned(0, 6, 180))}, []))
    known = graph.snapshot()
    assert not turned_back(graph, component)
    assert graph.snapshot() == known


def off_deg(scan: Scan, e: PairMatch) -> float:
    """How far a pair is turned from the truth."""
    return angle_deg(e.S_target_source.R @ scan.pair(e.source, e.target).S_target_source.R.T)


def test_a_cut_is_found_among_many() -> None:
    """Noise beside a block whose pairs with the others weigh more: no cut weighs more than the one that is found."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        block = rng.permutation(np.arange(9) < rng.integers(2, 7))
        relief = rng.normal(0, 0.1, (9, 9)) + np.where(block[:, None] & ~block, 1.0, -0.3)
        np.fill_diagonal(relief, 0)
        every = ((np.arange(1, 2**9 - 1)[:, None] >> np.arange(9)) & 1).astype(bool)
        most = max(relief[np.ix_(one, ~one)].sum() for one in every)
        found = _best_cut(relief)
        assert found is not None
        assert relief[np.ix_(found, ~found)].sum() == pytest.approx(most)
    assert _best_cut(-np.ones((4, 4))) is None


# The order of capture.


@pytest.fixture(scope="module")
def nut_walk(nut_file: str) -> RenderedClouds:
    return rendered(nut_file, tuple(range(STEPS)), ALL_AROUND, 90)


def turned_from_truth(found: list[Similarity], true: list[Similarity]) -> list[float]:
    """Angles between relative rotations and the true ones, of all frames against the first, in degrees."""
    return [angle_deg(found[0].R.T @ f.R @ (true[0].R.T @ t.R).T) for f, t in zip(found, true, strict=True)]


def steps(deg: float) -> list[Similarity]:
    """Cameras that go around the origin in equal steps."""
    turns = [Rotation.from_euler("y", k * deg, degrees=True).as_matrix() for k in range(6)]
    return [Similarity(1.0, R, R @ np.array([0.0, 0, 4])) for R in turns]


def test_the_chain_of_small_steps_shows_every_side_of_a_nut(nut_walk: RenderedClouds) -> None:
    maps = [build_surface_map(c) for c in nut_walk.clouds]
    chain = chain_of_small_steps(maps, 12.0, np.random.default_rng(0))
    assert list(chain) == list(range(STEPS))
    assert max(turned_from_truth(list(chain.values()), nut_walk.S_world_camera)) < 3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_nut_is_registered_at_the_sides_that_it_shows_or_said_to_be_symmetric(
    nut_walk: RenderedClouds, seed: int
) -> None:
    found = register(nut_walk.clouds, seed=seed)
    inside = np.flatnonzero(found.registered)
    assert len(inside) > STEPS / 2
    poses = [Similarity(1.0, found.T_world_camera[k, :3, :3], found.T_world_camera[k, :3, 3]) for k in inside]
    errors = turned_from_truth(poses, [nut_walk.S_world_camera[k] for k in inside])
    assert max(errors) < 3
    assert any(turn == pytest.approx(60, abs=1) for turn in found.turns_deg) or not found.by_order


def test_a_run_goes_from_frame_to_frame_and_ends_where_a_step_is_unknown() -> None:
    true = steps(15.0)
    exact = [b.inverse() @ a for a, b in pairwise(true)]
    chain = _longest_run(exact)
    for found, wanted in zip(chain.values(), true, strict=True):
        np.testing.assert_allclose(found.matrix(), (true[0].inverse() @ wanted).matrix(), atol=1e-12)
    broken = _longest_run([exact[0], None, *exact[2:]])
    assert list(broken) == [2, 3, 4, 5]
    np.testing.assert_allclose(
        (broken[2].inverse() @ broken[5]).matrix(), (true[2].inverse() @ true[5]).matrix(), atol=1e-12
    )
    assert _longest_run([None, None]) == {}


def test_the_usual_step_is_that_of_pairs_that_hold() -> None:
    true = steps(15.0)
    pairs = [edge(true, k, k + 1) for k in range(5)]
    assert typical_step_deg(pairs) == pytest.approx(15)
    slipping = [replace(e, slip_deg=12.0, shape_slip_deg=12.0) for e in pairs]
    assert typical_step_deg(pairs[:2] + slipping[2:]) is None  # a vase
    assert typical_step_deg([]) is None


@pytest.mark.parametrize(("degrees", "ratio", "open_"), [(60.0, 0.95, True), (60.0, 0.7, False), (10.0, 0.95, False)])
def test_sides_are_open_where_another_one_fits_as_well(degrees: float, ratio: float, open_: bool) -> None:
    true = steps(15.0)
    turn = Similarity(1.0, Rotation.from_euler("y", degrees, degrees=True).as_matrix(), np.zeros(3))
    rival = Rival(true[1].inverse() @ turn @ true[0], ratio)
    assert sides_are_open([edge(true, 0, 1, rivals=(rival,))]) is open_
