from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sl_nerfstudio.registration.cycle_consistency import cycle_consistency

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.graph_residuals import Pivots
from sl_nerfstudio.registration.pairs.edge_weights import edge_weights
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.pose_graph import optimise_pose_graph


def random_nodes(n: int, rng: np.random.Generator) -> list[Similarity]:
    """Frames around an object four units away from each, with baselines that differ by half."""
    nodes = []
    for _ in range(n):
        R = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        nodes.append(Similarity(float(np.exp(rng.uniform(-0.4, 0.4))), R, 4 * R[:, 2]))
    return nodes


def edge(nodes: list[Similarity], i: int, j: int, noise: float = 0.0, rng=None) -> PairMatch:
    S = nodes[j].inverse() @ nodes[i]
    if noise:
        turn = Rotation.from_rotvec(noise * rng.standard_normal(3)).as_matrix()
        c = np.array([0.0, 0.0, -4 / nodes[j].scale])
        D = Similarity(float(np.exp(noise * rng.standard_normal())), turn, c - turn @ c)
        S = D @ S
    return PairMatch(i, j, S, np.eye(7) / max(noise, 1e-3) ** 2, 0.5, 0.95, 0.02, 0.0, 0.5)


def pivots_of(nodes: list[Similarity]) -> Pivots:
    return Pivots(np.array([[0.0, 0.0, -4 / S.scale] for S in nodes]), np.array([1 / S.scale for S in nodes]))


def ring(n: int) -> list[tuple[int, int]]:
    return [(k, (k + gap) % n) for gap in (1, 2) for k in range(n)]


def largest_error(found, nodes) -> float:
    """Over all frames: rotation (radian) and scale, after the gauge of frame 0 is put back."""
    out = 0.0
    for S, true in zip(found, nodes, strict=True):
        D = (nodes[0] @ S) @ true.inverse()
        out = max(out, Rotation.from_matrix(D.R).magnitude(), abs(np.log(D.scale)), float(np.abs(D.t).max()))
    return out


@settings(max_examples=5)
@given(st.integers(0, 10**6), st.integers(4, 9))
def test_exact_edges_give_the_exact_solution(seed, n):
    nodes = random_nodes(n, np.random.default_rng(seed))
    edges = [edge(nodes, i, j) for i, j in ring(n)]
    solution = optimise_pose_graph(edges, pivots_of(nodes), 0, *2 * [np.ones(len(edges))])
    assert largest_error(solution.S_world_camera, nodes) < 1e-6
    assert solution.consistent.all()


def test_closing_loops_averages_errors():
    """Of a chain alone the last frame carries the errors of all steps; loops spread them over all frames."""
    rng = np.random.default_rng(3)
    nodes = random_nodes(12, rng)
    edges = [edge(nodes, i, j, 0.01, rng) for i, j in ring(12)]
    chain = edges[:11]
    errors = [
        largest_error(optimise_pose_graph(some, pivots_of(nodes), 0, *2 * [np.ones(len(some))]).S_world_camera, nodes)
        for some in (chain, edges)
    ]
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("wrong", [1, 3])
def test_wrong_pairs_are_rejected_and_do_no_harm(wrong):
    rng = np.random.default_rng(wrong)
    nodes = random_nodes(8, rng)
    edges = [edge(nodes, i, j, 0.005, rng) for i, j in ring(8)]
    bad = rng.choice(len(edges), wrong, replace=False)
    for k in bad:
        # each in its own way: wrong ones that agree with each other would look like right ones
        turn = Rotation.from_rotvec(rng.uniform(0.5, 1.5, 3) * rng.choice([-1, 1], 3)).as_matrix()
        edges[k] = replace(
            edges[k], S_target_source=Similarity(1.1, turn, rng.normal(size=3)) @ edges[k].S_target_source
        )
    pivots = pivots_of(nodes)
    weight = np.ones(len(edges))
    cycles = cycle_consistency(edges, pivots, weight)
    good = np.setdiff1d(np.arange(len(edges)), bad)
    assert cycles[bad].max() < cycles[good].max()
    solution = optimise_pose_graph(edges, pivots, 0, cycles, weight)
    assert not solution.consistent[bad].any()
    assert solution.consistent[good].all()
    assert largest_error(solution.S_world_camera, nodes) < 0.05


def test_a_few_good_pairs_outweigh_many_that_agree_with_each_other_and_fit_worse():
    """Frames slide on a smooth surface: five pairs put frame 4 to one wrong place, two to the right one."""
    rng = np.random.default_rng(5)
    nodes = random_nodes(8, rng)
    slid = list(nodes)
    slid[4] = Similarity(1.0, Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix(), np.zeros(3)) @ nodes[4]
    right = [edge(nodes, i, j, 0.005, rng) for i, j in ring(8) if 4 not in (i, j)]
    right += [replace(edge(nodes, i, j, 0.005, rng), fitness=0.99) for i, j in ((3, 4), (4, 5))]
    wrong = [replace(edge(slid, i, j, 0.005, rng), fitness=0.87) for i, j in ((0, 4), (1, 4), (2, 4), (4, 6), (4, 7))]
    edges, pivots = right + wrong, pivots_of(nodes)
    weight = edge_weights(edges)
    solution = optimise_pose_graph(edges, pivots, 0, cycle_consistency(edges, pivots, weight), weight)
    assert largest_error(solution.S_world_camera, nodes) < 0.05
    assert solution.consistent.tolist() == [True] * len(right) + [False] * len(wrong)


def test_frames_without_an_edge_have_no_pose():
    nodes = random_nodes(5, np.random.default_rng(0))
    edges = [edge(nodes, 0, 1), edge(nodes, 1, 2), edge(nodes, 3, 4)]
    solution = optimise_pose_graph(edges, pivots_of(nodes), 0, np.ones(3), np.ones(3))
    assert [S is None for S in solution.S_world_camera] == [False, False, False, True, True]
    assert solution.consistent.tolist() == [True, True, False]


def test_an_edge_can_be_read_both_ways():
    nodes = random_nodes(2, np.random.default_rng(0))
    e = edge(nodes, 0, 1)
    p = np.array([[0.1, 0.2, -3.0]])
    np.testing.assert_allclose(e.between(1, 0).points(e.between(0, 1).points(p)), p)
