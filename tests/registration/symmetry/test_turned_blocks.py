"""Blocks of frames on the wrong side of a bar that looks nearly the same after half a turn."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.assembly import PoseGraphSolution, node_at
from sl_nerfstudio.registration.pairs import PairMatch
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.symmetry import TurnedBlock, _best_cut, judged, turned_back, turned_blocks
from sl_nerfstudio.registration.view_graph import ViewGraph
from tests.registration.symmetry.turned_scan import FRAMES, Scan, write_bar

BLOCK = (3, 4, 5)


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """Two bosses, one on each end, of unequal height."""
    path: Path = tmp_path_factory.mktemp("meshes") / "bar.ply"
    write_bar(path)
    return Scan(str(path))


def misplaced(scan: Scan, degrees: float = 180.0) -> tuple[list[PairMatch], PoseGraphSolution]:
    """The frames of the block turned; all pairs hold them there, but one across the two that says the truth."""
    half = scan.nodes[0] @ scan.turned(0, 0, degrees) @ scan.nodes[0].inverse()
    nodes = [half @ S if k in BLOCK else S for k, S in enumerate(scan.nodes)]
    sight = np.array([S.R[:, 2] for S in nodes])
    near = [(i, j) for j in range(FRAMES) for i in range(j) if sight[i] @ sight[j] > 0.5]
    edges = [replace(scan.pair(i, j), S_target_source=nodes[j].inverse() @ nodes[i]) for i, j in near]
    truth = scan.pair(2, 3)
    edges = [e for e in edges if (e.source, e.target) != (2, 3)]
    return [*edges, truth], PoseGraphSolution(list(nodes), np.array([True] * len(edges) + [False]))


def found_in(scan: Scan, edges: list[PairMatch], solution: PoseGraphSolution) -> list[TurnedBlock]:
    settings = REGISTRATION_DEFAULTS
    before = judged(scan.sides, solution.S_world_camera, Similarity.identity(), settings.blocks.neighbours, settings)
    return turned_blocks(scan.sides, edges, solution, before, settings)


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
    solution = PoseGraphSolution(list(bar.nodes), np.array([True] * len(bar.pairs) + [False]))
    assert found_in(bar, edges, solution) == []


def test_of_what_is_the_same_from_both_sides_no_block_is_turned(tmp_path: Path) -> None:
    trimesh.creation.box((90, 40, 24)).export(tmp_path / "box.ply")
    box = Scan(str(tmp_path / "box.ply"))
    assert found_in(box, *misplaced(box)) == []


def test_pairs_across_are_registered_anew_where_the_block_belongs(bar: Scan) -> None:
    edges, solution = misplaced(bar)
    maps = [side.map for side in bar.sides]
    graph = ViewGraph(maps, [None] * FRAMES, np.random.default_rng(0), REGISTRATION_DEFAULTS)
    graph.restore(({(e.source, e.target): e for e in edges}, []))
    component = {k: node_at(solution.S_world_camera, k) for k in range(FRAMES)}
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
    graph = ViewGraph([s.map for s in bar.sides], [None] * FRAMES, np.random.default_rng(0), REGISTRATION_DEFAULTS)
    before = {(e.source, e.target): e for e in edges}
    graph.restore((before, []))
    monkeypatch.setattr(ViewGraph, "try_overlapping", lambda *_: None)
    component = {k: node_at(solution.S_world_camera, k) for k in range(FRAMES)}
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


def test_a_cut_is_found_among_many(seeds: range = range(20)) -> None:
    """Noise beside a block whose pairs with the others weigh more: no cut weighs more than the one that is found."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        block = rng.permutation(np.arange(9) < rng.integers(2, 7))
        relief = rng.normal(0, 0.1, (9, 9)) + np.where(block[:, None] & ~block, 1.0, -0.3)
        np.fill_diagonal(relief, 0)
        every = ((np.arange(1, 2**9 - 1)[:, None] >> np.arange(9)) & 1).astype(bool)
        most = max(relief[np.ix_(one, ~one)].sum() for one in every)
        found = _best_cut(relief, 24)
        assert found is not None
        assert relief[np.ix_(found, ~found)].sum() == pytest.approx(most)
    assert _best_cut(-np.ones((4, 4)), 24) is None
