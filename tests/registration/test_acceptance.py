"""Which frames are registered, and the facts about those that are not."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.pairs import Rival
from sl_nerfstudio.registration.register import _doubtful, register
from sl_nerfstudio.registration.result import (
    NoCommonSurface,
    PairsContradict,
    SeparateComponent,
    SurfaceDisagrees,
    UncertainRotation,
    UndecidedProjector,
    without_undecided,
)
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, AcceptanceSettings, EdgeSettings
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, part_of
from tests.registration.graph_edges import edge
from tests.registration.shaped_clouds import rendered

SIZE = 70
RIG = rig_of(18, SIZE)


@pytest.fixture(scope="module")
def clouds():
    """Five frames side by side."""
    return clouds_of(part_of(RIG, [0, 1, 2, 3, 4]), SIZE, noise=0.05)


# ------------------------------------------------------------------ frames


def test_frames_of_a_separate_group_name_it_and_where_to_capture(clouds):
    """The last two show another object, a head, and match each other alone."""
    heads = rendered("head", (4, 5)).clouds
    found = register([*clouds[:3], *heads])
    assert found.registered.tolist() == [True, True, True, False, False]
    assert found.component.tolist() == [0, 0, 0, 1, 1]
    group = tuple(c.name for c in heads)
    for why, name in zip(found.exclusions, group, strict=True):
        assert isinstance(why, SeparateComponent)
        assert (why.frame, why.component) == (name, group)
        assert why.partner in (None, *found.names[:3])
    assert np.isnan(found.fitness[3:]).all()
    assert (found.fitness[:3] > 0.9).all()
    (separate,) = found.separate  # in axes of their own
    assert separate.frames == group
    np.testing.assert_allclose(separate.T_world_camera[0], np.eye(4), atol=1e-9)
    true = rendered("head", (4, 5))
    T, baseline = true.T_world_camera, true.baseline
    unit = np.sqrt(baseline.prod())  # the geometric mean of the baselines is one
    relative = np.linalg.inv(T[0]) @ T[1]
    turn = relative[:3, :3].T @ separate.T_world_camera[1, :3, :3]
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 1
    np.testing.assert_allclose(separate.baseline, baseline / unit, rtol=0.02)
    off = np.linalg.norm(separate.T_world_camera[1, :3, 3] - relative[:3, 3] / unit)
    assert off < 0.03 * np.linalg.norm(T[0, :3, 3]) / unit


def test_where_nothing_is_joined_because_everything_slips_every_frame_says_so():
    """Two frames of a vase: to capture more of the same would not help."""
    found = register(rendered("vase", (4, 5)).clouds)
    assert not found.registered.any()
    assert found.exclusions == tuple(SeparateComponent(name, (name,), True, None) for name in found.names)


def test_a_frame_without_surface_shares_none(clouds):
    few = {k: getattr(clouds[2], k)[::50] for k in ("uv_camera", "points", "sigma_noise", "pose_errors")}
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


def test_a_frame_most_of_whose_pairs_say_another_pose_is_left_out():
    """Two of its pairs are used, and two that fit a little better are not."""
    nodes = [Similarity(1.0, T[:3, :3], T[:3, 3]) for T in RIG.T_world_camera[:5].numpy()]
    ring = [edge(nodes, i, j) for i, j in ((0, 1), (1, 2), (0, 2), (0, 4), (1, 4), (2, 4))]
    of_three = [edge(nodes, k, 3, fitness=f) for k, f in ((0, 0.9), (1, 0.9), (2, 0.95), (4, 0.95))]
    names, inside = tuple("abcde"), np.ones(5, dtype=bool)
    used = np.array([True] * 6 + [True, True, False, False])
    assert _doubtful(names, inside, ring + of_three, used, EdgeSettings()) == {3: PairsContradict("d", 4, 2)}
    used[-1] = True  # three of four agree
    assert _doubtful(names, inside, ring + of_three, used, EdgeSettings()) == {}
    used[-1], rival = False, (Rival(nodes[0], 0.95),)
    undecided = [replace(e, rivals=rival) if not u else e for e, u in zip(ring + of_three, used, strict=True)]
    assert _doubtful(names, inside, undecided, used, EdgeSettings()) == {}  # pairs that fit in two ways say nothing
    assert _doubtful(names, inside & (np.arange(5) != 4), ring + of_three, used, EdgeSettings()) == {}


def test_uncertainties_follow_their_limits(clouds):
    ambiguous = replace(REGISTRATION_DEFAULTS, edge=EdgeSettings(ambiguous_ratio=-1.0))
    assert all(edge.undecided for edge in register(clouds[:3], settings=ambiguous).edges)
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
    stages.clear()
    register(clouds[:2], sequence=False, progress=stages.append)
    assert stages == ["registering pairs", "comparing all frames", "closing loops", "closing loops"]


def test_frames_whose_projector_is_undecided_are_left_out(clouds):
    found = register(clouds[:3])
    lost = replace(found, registered=np.array([True, True, False]))
    doubts = tuple(UndecidedProjector(name, 12.0) for name in found.names)
    one = without_undecided(found, doubts[1:2])
    assert one.exclusions == (*found.exclusions, doubts[1]) and one.registered.tolist() == [True, False, True]
    assert one.component.tolist() == [0, -1, 0]
    for values, before in ((one.T_world_camera, found.T_world_camera), (one.baseline, found.baseline)):
        assert np.isnan(values[1]).all()
        np.testing.assert_array_equal(values[[0, 2]], before[[0, 2]])
    assert without_undecided(lost, doubts).exclusions == (*lost.exclusions, *doubts[:2])
    assert not without_undecided(lost, doubts).registered.any()
    same = without_undecided(found, ())
    assert same.exclusions == found.exclusions and same.uncertainties == found.uncertainties
    np.testing.assert_array_equal(same.T_world_camera, found.T_world_camera)
