"""All edges of a component together, robustly."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.assembly import optimise_pose_graph
from sl_nerfstudio.registration.pairs import edge_weights
from tests.registration.graph_edges import edge, exp_at, pivots_of


def random_nodes(n: int, rng: np.random.Generator) -> list[Similarity]:
    """Frames around an object four units away from each, with baselines that differ by half."""
    nodes = []
    for _ in range(n):
        R = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        nodes.append(Similarity(float(np.exp(rng.uniform(-0.4, 0.4))), R, 4 * R[:, 2]))
    return nodes


def ring(n: int) -> list[tuple[int, int]]:
    return [(k, (k + gap) % n) for gap in (1, 2) for k in range(n)]


def start_of(nodes: list[Similarity], drift: float = 0.02, seed: int = 0) -> dict[int, Similarity]:
    """An assembled component: every frame off by some `drift` (radian, radii); the first one is exact."""
    rng, pivots = np.random.default_rng(seed), pivots_of(nodes)
    moved = [S @ exp_at(drift * rng.standard_normal(7), pivots.centre[k], pivots.radius[k], 0.5)
             for k, S in enumerate(nodes)]  # fmt: skip
    return dict(enumerate([nodes[0], *moved[1:]]))


def largest_error(found, nodes) -> float:
    """Over all frames: rotation (radian), scale and position, in the world of frame 0."""
    out = 0.0
    for S, true in zip(found, nodes, strict=True):
        D = S @ true.inverse()
        out = max(out, Rotation.from_matrix(D.R).magnitude(), abs(np.log(D.scale)), float(np.abs(D.t).max()))
    return out


@settings(max_examples=5)
@given(st.integers(0, 10**6), st.integers(4, 9))
def test_exact_edges_give_the_exact_solution(seed, n):
    nodes = random_nodes(n, np.random.default_rng(seed))
    edges = [edge(nodes, i, j) for i, j in ring(n)]
    solution = optimise_pose_graph(edges, pivots_of(nodes), start_of(nodes, seed=seed), np.ones(len(edges)))
    assert largest_error(solution.S_world_camera, nodes) < 1e-6
    assert solution.consistent.all()


def test_closing_loops_averages_errors():
    """Of a chain alone the last frame carries the errors of all steps; loops spread them over all frames."""
    rng = np.random.default_rng(3)
    nodes = random_nodes(12, rng)
    edges = [edge(nodes, i, j, 0.01, rng) for i, j in ring(12)]
    errors = [
        largest_error(optimise_pose_graph(some, pivots_of(nodes), start_of(nodes), np.ones(len(some))).S_world_camera,
                      nodes)
        for some in (edges[:11], edges)
    ]  # fmt: skip
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("wrong", [1, 3, 5])
def test_wrong_pairs_are_rejected_and_do_no_harm(wrong):
    rng = np.random.default_rng(wrong)
    nodes = random_nodes(8, rng)
    edges = [edge(nodes, i, j, 0.005, rng) for i, j in ring(8)]
    bad = rng.choice(len(edges), wrong, replace=False)
    for k in bad:
        turn = Rotation.from_rotvec(rng.uniform(0.5, 1.5, 3) * rng.choice([-1, 1], 3)).as_matrix()
        edges[k] = replace(
            edges[k], S_target_source=Similarity(1.1, turn, rng.normal(size=3)) @ edges[k].S_target_source
        )
    solution = optimise_pose_graph(edges, pivots_of(nodes), start_of(nodes), np.ones(len(edges)))
    assert solution.consistent.tolist() == [k not in bad for k in range(len(edges))]
    assert largest_error(solution.S_world_camera, nodes) < 0.05


def test_pairs_that_agree_with_each_other_and_fit_worse_do_not_move_an_assembled_frame():
    """Frames slide on a smooth surface: five pairs put frame 4 to one wrong place, two to the right one."""
    rng = np.random.default_rng(5)
    nodes = random_nodes(8, rng)
    slid = list(nodes)
    slid[4] = Similarity(1.0, Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix(), np.zeros(3)) @ nodes[4]
    right = [edge(nodes, i, j, 0.005, rng) for i, j in ring(8) if 4 not in (i, j)]
    right += [edge(nodes, i, j, 0.005, rng, fitness=0.99) for i, j in ((3, 4), (4, 5))]
    wrong = [edge(slid, i, j, 0.005, rng, fitness=0.87) for i, j in ((0, 4), (1, 4), (2, 4), (4, 6), (4, 7))]
    edges = right + wrong
    solution = optimise_pose_graph(edges, pivots_of(nodes), start_of(nodes), edge_weights(edges))
    assert largest_error(solution.S_world_camera, nodes) < 0.05
    assert solution.consistent.tolist() == [True] * len(right) + [False] * len(wrong)


def test_frames_outside_the_component_have_no_pose_and_their_edges_do_not_count():
    nodes = random_nodes(5, np.random.default_rng(0))
    edges = [edge(nodes, 0, 1), edge(nodes, 1, 2), edge(nodes, 3, 4), edge(nodes, 2, 3)]
    start = {k: S for k, S in start_of(nodes).items() if k < 3}
    solution = optimise_pose_graph(edges, pivots_of(nodes), start, np.ones(4))
    assert [S is None for S in solution.S_world_camera] == [False, False, False, True, True]
    assert solution.consistent.tolist() == [True, True, False, False]
    alone = optimise_pose_graph(edges, pivots_of(nodes), {4: nodes[4]}, np.ones(4))
    assert alone.S_world_camera[4] is nodes[4] and not alone.consistent.any()


@settings(max_examples=5)
@given(st.randoms(use_true_random=False))
def test_the_solution_does_not_depend_on_the_order_of_the_edges(random):
    rng = np.random.default_rng(1)
    nodes = random_nodes(6, rng)
    edges = [edge(nodes, i, j, 0.01, rng) for i, j in ring(6)]
    shuffled = random.sample(edges, len(edges))
    a, b = (optimise_pose_graph(some, pivots_of(nodes), start_of(nodes), np.ones(len(some)))
            for some in (edges, shuffled))  # fmt: skip
    for S, T in zip(a.S_world_camera, b.S_world_camera, strict=True):
        np.testing.assert_allclose(S.matrix(), T.matrix(), atol=1e-7)


def test_an_edge_can_be_read_both_ways():
    nodes = random_nodes(2, np.random.default_rng(0))
    e = edge(nodes, 0, 1)
    p = np.array([[0.1, 0.2, -3.0]])
    np.testing.assert_allclose(e.between(1, 0).points(e.between(0, 1).points(p)), p)


def test_rounding_errors_of_rotations_do_not_grow():
    """Where a hundred components were joined, products with transposes had left rotations 2 % from orthonormal."""
    nodes = random_nodes(8, np.random.default_rng(5))
    edges = [edge(nodes, i, j) for i, j in ring(8)]
    rng = np.random.default_rng(6)
    start = {
        k: Similarity(S.scale, S.R @ (np.eye(3) + 0.01 * rng.standard_normal((3, 3))), S.t) if k else S
        for k, S in start_of(nodes).items()
    }
    solution = optimise_pose_graph(edges, pivots_of(nodes), start, np.ones(len(edges)))
    assert largest_error(solution.S_world_camera, nodes) < 1e-6
    for S in solution.S_world_camera:
        np.testing.assert_allclose(S.R.T @ S.R, np.eye(3), atol=1e-12)
