"""The pose graph of one component, and increments of similarities."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarities, Similarity, exps_at, logs_at
from sl_nerfstudio.registration.pairs import Rival, edge_weights
from sl_nerfstudio.registration.pose_graph import at_places, optimise_pose_graph
from tests.registration.graph_edges import edge, exp_at, pivots_of, turned


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
    for S, true in zip(found.values(), nodes, strict=True):
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


def test_pairs_that_agree_with_each_other_but_have_rivals_do_not_move_an_assembled_frame():
    """Five pairs put frame 4 to one wrong place, and say that others are as likely; two put it to the right one."""
    rng = np.random.default_rng(5)
    nodes = random_nodes(8, rng)
    slid = list(nodes)
    slid[4] = Similarity(1.0, Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix(), np.zeros(3)) @ nodes[4]
    others = tuple(Rival(Similarity.identity(), 0.0) for _ in range(4))
    right = [edge(nodes, i, j, 0.005, rng) for i, j in ring(8) if 4 not in (i, j)]
    right += [edge(nodes, i, j, 0.005, rng) for i, j in ((3, 4), (4, 5))]
    wrong = [edge(slid, i, j, 0.005, rng, rivals=others) for i, j in ((0, 4), (1, 4), (2, 4), (4, 6), (4, 7))]
    edges = right + wrong
    solution = optimise_pose_graph(edges, pivots_of(nodes), start_of(nodes), edge_weights(edges))
    assert largest_error(solution.S_world_camera, nodes) < 0.05
    assert solution.consistent.tolist() == [True] * len(right) + [False] * len(wrong)


def test_a_pair_holds_its_frames_where_they_were_put_even_if_it_says_another_place_first():
    nodes = random_nodes(4, np.random.default_rng(2))
    true = [edge(nodes, i, j) for i, j in ((0, 1), (1, 2), (2, 3))]
    said = [
        replace(e, S_target_source=turned(e.S_target_source, 30, np.zeros(3)), rivals=(Rival(e.S_target_source, -5.0),))
        for e in true
    ]
    found = optimise_pose_graph(at_places(said, dict(enumerate(nodes))), pivots_of(nodes), start_of(nodes), np.ones(3))
    assert largest_error(found.S_world_camera, nodes) < 1e-6
    assert at_places(said, {0: nodes[0]}) == said


def test_frames_outside_the_component_have_no_pose_and_their_edges_do_not_count():
    nodes = random_nodes(5, np.random.default_rng(0))
    edges = [edge(nodes, 0, 1), edge(nodes, 1, 2), edge(nodes, 3, 4), edge(nodes, 2, 3)]
    start = {k: S for k, S in start_of(nodes).items() if k < 3}
    solution = optimise_pose_graph(edges, pivots_of(nodes), start, np.ones(4))
    assert list(solution.S_world_camera) == [0, 1, 2]
    assert solution.consistent.tolist() == [True, True, False, False]
    alone = optimise_pose_graph(edges, pivots_of(nodes), {4: nodes[4]}, np.ones(4))
    assert alone.S_world_camera[4] is nodes[4] and not alone.consistent.any()


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
    for S in solution.S_world_camera.values():
        np.testing.assert_allclose(S.R.T @ S.R, np.eye(3), atol=1e-12)


# Increments of similarities about a pivot.

increments = arrays(np.float64, 7, elements=st.floats(-1, 1))
centres = arrays(np.float64, 3, elements=st.floats(-5, 5))


@settings(max_examples=25)
@given(increments, centres, st.floats(0.1, 10))
def test_points_move_as_the_formula_says_and_the_logarithm_undoes_it(x, centre, radius):
    S = exp_at(x, centre, radius, 2.0)
    p = np.random.default_rng(0).normal(size=(4, 3))
    turned = (p - centre) @ Rotation.from_rotvec(x[3:6]).as_matrix().T
    np.testing.assert_allclose(S.points(p), centre + np.exp(x[6]) * turned + radius * x[:3], atol=1e-9)
    one = Similarities.of([S])
    np.testing.assert_allclose(logs_at(one, centre[None], np.array([radius]))[0], x, atol=1e-9)
    grown = exp_at(np.array([0.0] * 6 + [3.0]), centre, radius, 0.5)
    assert grown.scale == np.exp(0.5)  # the scale of a step is bounded


def test_many_similarities_do_what_each_of_them_does():
    rng = np.random.default_rng(1)
    x, centre, radius = rng.normal(size=(2, 5, 7)), rng.normal(size=(5, 3)), rng.uniform(0.5, 2, 5)
    a, b = (exps_at(part, centre, radius, 2.0) for part in x)
    ones = list(zip(a.each(), b.each(), strict=True))
    wanted = {"product": (a @ b, [p @ q for p, q in ones]), "inverse": (a.inverse(), [p.inverse() for p, _ in ones])}
    for many, each in wanted.values():
        np.testing.assert_allclose([S.matrix() for S in many.each()], [S.matrix() for S in each], atol=1e-12)
    points = [p.points(c[None])[0] for (p, _), c in zip(ones, centre, strict=True)]
    np.testing.assert_allclose(a.points(centre), points, atol=1e-12)
    some = np.array([3, 0])
    again = Similarities.of([a.each()[k] for k in some])
    assert np.array_equal(again.R, a.chosen(some).R) and np.array_equal(again.t, a.chosen(some).t)
