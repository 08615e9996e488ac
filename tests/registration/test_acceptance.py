"""Which frames are registered, and the facts about those that are not."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.edge_weights import edge_weights, is_accepted, is_ambiguous, quality
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.result import (
    AmbiguousPose,
    InconsistentPair,
    NoCommonSurface,
    SurfaceDisagrees,
    UncertainRotation,
)
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, AcceptanceSettings, EdgeSettings
from sl_nerfstudio.registration.view_graph import connected_components
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, on_a_ball, part_of

SIZE = 70
RIG = rig_of(18, SIZE)


@pytest.fixture(scope="module")
def clouds():
    """Five frames side by side."""
    return clouds_of(part_of(RIG, [0, 1, 2, 3, 4]), SIZE, noise=0.05)


def match(i: int, j: int, fitness: float = 0.9, overlap: float = 0.5, ratio: float = 0.2) -> PairMatch:
    return PairMatch(i, j, Similarity.identity(), np.eye(7), overlap, fitness, 0.02, ratio, 0.5)


# ------------------------------------------------------------------ frames


def test_frames_of_a_separate_group_name_their_best_partner(clouds):
    """The last two show another object, a ball, and match each other alone."""
    balls = [on_a_ball(c, 0.7, c.name) for c in clouds[3:]]
    found = register([*clouds[:3], *balls])
    assert found.registered.tolist() == [True, True, True, False, False]
    assert set(found.exclusions) == {
        InconsistentPair("frame_00003", "frame_00004"),
        InconsistentPair("frame_00004", "frame_00003"),
    }
    assert np.isnan(found.fitness[3:]).all()
    assert (found.fitness[:3] > 0.9).all()


def test_a_frame_without_surface_shares_none(clouds):
    few = {k: getattr(clouds[2], k)[::50] for k in ("uv_camera", "points", "sigma_noise", "sigma_pose")}
    found = register([*clouds[:2], replace(clouds[2], **few)])
    assert found.exclusions == (NoCommonSurface("frame_00002"),)
    assert found.registered.tolist() == [True, True, False]


def test_a_frame_whose_surface_disagrees_says_how_much_agrees(clouds):
    strict = replace(REGISTRATION_DEFAULTS, acceptance=AcceptanceSettings(least_fitness=1.01))
    found = register(clouds[:3], settings=strict)
    assert not found.registered.any()
    assert [type(e) for e in found.exclusions] == [SurfaceDisagrees] * 3
    assert [e.frame for e in found.exclusions] == ["frame_00000", "frame_00001", "frame_00002"]
    assert all(0.9 < e.fitness <= 1 for e in found.exclusions)
    assert np.isnan(found.T_world_camera).all() and np.isnan(found.baseline).all()


def test_uncertainties_follow_their_limits(clouds):
    ambiguous = replace(REGISTRATION_DEFAULTS, edge=EdgeSettings(ambiguous_ratio=-1.0))
    found = register(clouds[:3], settings=ambiguous)
    assert found.uncertainties == tuple(AmbiguousPose(f"frame_{k:05d}") for k in range(3))
    assert all(edge.undecided for edge in found.edges)
    uncertain = replace(REGISTRATION_DEFAULTS, acceptance=AcceptanceSettings(largest_sigma_rotation_deg=0.0))
    found = register(clouds[:3], settings=uncertain)
    assert [type(u) for u in found.uncertainties] == [UncertainRotation] * 3
    sigma = {u.frame: u.sigma_deg for u in found.uncertainties}
    for name, value in sigma.items():
        assert value == min(e.rotation_sigma_deg for e in found.edges if name in e.frames)
    assert register(clouds[:3]).uncertainties == ()


def test_what_is_being_done_is_reported(clouds):
    stages = []
    register(clouds[:2], progress=stages.append)
    assert stages == ["registering pairs", "closing loops", "closing loops"]


# ------------------------------------------------------------------ pairs


def test_a_pair_needs_overlap_and_fitness():
    assert is_accepted(match(0, 1))
    assert not is_accepted(match(0, 1, fitness=0.59))
    assert not is_accepted(match(0, 1, overlap=0.14))
    assert is_ambiguous(match(0, 1, ratio=0.9)) and not is_ambiguous(match(0, 1, ratio=0.8))


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1))
def test_quality_grows_with_overlap_and_fitness_and_falls_with_ambiguity(overlap, fitness, ratio):
    value = quality(match(0, 1, fitness, overlap, ratio))
    assert 0 <= value <= 1
    assert quality(match(0, 1, min(1.0, fitness + 0.1), overlap, ratio)) >= value
    assert quality(match(0, 1, fitness, min(1.0, overlap + 0.1), ratio)) >= value
    assert quality(match(0, 1, fitness, overlap, 1.0)) <= value


@given(st.lists(st.tuples(st.floats(0.6, 1), st.floats(0, 1)), min_size=1, max_size=12))
def test_weights_prefer_pairs_that_fit_like_the_good_ones(pairs):
    edges = [match(0, 1, fitness=f, ratio=r) for f, r in pairs]
    weight = edge_weights(edges)
    fitness = np.array([f for f, _ in pairs])
    assert ((weight >= 0.02) & (weight <= 1)).all()
    clear = np.array([r <= 0.85 for _, r in pairs])
    good = fitness >= np.quantile(fitness, 0.75)
    np.testing.assert_array_equal(weight[good & clear], 1.0)
    np.testing.assert_array_equal(weight[good & ~clear], 0.5)
    order = np.argsort(fitness[clear])
    assert (np.diff(weight[clear][order]) >= 0).all()


def test_there_are_no_weights_without_pairs():
    assert len(edge_weights([])) == 0


@given(st.integers(1, 12), st.lists(st.tuples(st.integers(0, 11), st.integers(0, 11)), max_size=20))
def test_components_are_those_of_scipy(n, pairs):
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components as reference

    pairs = [(i, j) for i, j in pairs if max(i, j) < n and i != j]
    found = connected_components([match(i, j) for i, j in pairs], n)
    rows, columns = np.array(pairs, dtype=int).reshape(-1, 2).T
    count, label = reference(coo_matrix((np.ones(len(pairs)), (rows, columns)), shape=(n, n)), directed=False)
    assert len(found) == count
    assert sorted(k for component in found for k in component) == list(range(n))
    assert all(len({int(label[k]) for k in component}) == 1 for component in found)
    assert [len(c) for c in found] == sorted((len(c) for c in found), reverse=True)
