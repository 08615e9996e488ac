"""Slipping along a surface: motions, the least known rotation, and how far nothing tells."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from sl_nerfstudio.registration.pairs import (
    CostOfPoints,
    MotionCost,
    register_pair,
    screw_motion,
    weakest_rotation,
)
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.surfaces import build_surface_map
from tests.registration.analytic_clouds import difference
from tests.registration.graph_edges import exp_at
from tests.registration.shaped_clouds import cloud_of_depth, rendered

PAIR = REGISTRATION_DEFAULTS.pair
SURFACE = build_surface_map(cloud_of_depth(lambda x, y: 3 + 0.2 * np.sin(9 * x) * np.cos(8 * y), 40))
increments = arrays(np.float64, 7, elements=st.floats(-0.6, 0.6))


@settings(max_examples=20)
@given(increments)
def test_a_motion_is_the_integral_of_its_velocity(x):
    """p(1) = c + e^l R(w) (p - c) + radius * integral of e^(l s) R(s w) v ds, by quadrature."""
    found = screw_motion(x, SURFACE)
    v, w, growth = SURFACE.radius * x[:3], x[3:6], x[6]
    s, weight = np.polynomial.legendre.leggauss(12)
    s, weight = (s + 1) / 2, weight / 2
    shift = np.einsum("k,kij,j->i", weight * np.exp(growth * s), Rotation.from_rotvec(s[:, None] * w).as_matrix(), v)
    p = np.random.default_rng(0).normal(size=(5, 3))
    turned = np.exp(growth) * (p - SURFACE.centroid) @ Rotation.from_rotvec(w).as_matrix().T
    np.testing.assert_allclose(found.points(p), SURFACE.centroid + turned + shift, atol=1e-9)


@settings(max_examples=20)
@given(increments)
def test_a_motion_is_its_increment_to_first_order(x):
    errors = []
    for h in (1e-2, 1e-3):
        a, b = screw_motion(h * x, SURFACE), exp_at(h * x, SURFACE.centroid, SURFACE.radius, 1.0)
        errors.append(np.abs(a.matrix() - b.matrix()).max())
    assert errors[1] <= errors[0] / 80 + 1e-12  # of second order: a hundredth


@settings(max_examples=20)
@given(st.floats(0.1, 2.0), st.integers(0, 10**6))
def test_a_turn_about_an_axis_elsewhere_keeps_points_at_their_distance_from_it(angle, seed):
    """Increments would leave a surface of revolution after a few degrees; a motion stays on it however far it goes."""
    rng = np.random.default_rng(seed)
    axis, foot = rng.normal(size=3), SURFACE.centroid + rng.normal(size=3)
    w = angle * axis / np.linalg.norm(axis)
    found = screw_motion(np.concatenate([np.cross(w, SURFACE.centroid - foot) / SURFACE.radius, w, [0.0]]), SURFACE)
    p = rng.normal(size=(20, 3))
    expected = foot + (p - foot) @ Rotation.from_rotvec(w).as_matrix().T
    np.testing.assert_allclose(found.points(p), expected, atol=1e-9)


@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_the_least_known_rotation_is_the_one_that_nothing_tells_of(seed):
    rng = np.random.default_rng(seed)
    free = rng.normal(size=7)
    free /= np.linalg.norm(free[3:6])
    others = np.linalg.svd(free[None])[2][1:]
    information = others.T @ np.diag(rng.uniform(1, 10, 6)) @ others + 1e-9 * np.eye(7)
    found = weakest_rotation(information)
    np.testing.assert_allclose(found * np.sign(found @ free), free, atol=1e-5)
    assert np.linalg.norm(found[3:6]) == pytest.approx(1)


def matched(scene: str, i: int, j: int):
    """Two frames of a rendered scene, registered, with the truth."""
    some = rendered(scene, (i, j))
    maps = tuple(build_surface_map(c) for c in some.clouds)
    S = some.S_world_camera
    found = register_pair((maps[0], maps[1]), (0, 1), PAIR.neighbours, np.random.default_rng(0))
    return found, S[1].inverse() @ S[0], maps[1], some


def test_slipping_about_the_axis_of_a_vase_is_found_and_its_size_is_stated():
    found, true, target, some = matched("vase", 4, 5)
    assert found.slip_deg >= PAIR.slip_angles_deg[0]
    assert found.rotation_sigma_deg >= found.slip_deg
    # The least known rotation is that about the vase's axis, in the target's camera axes.
    w, vectors = np.linalg.eigh(np.linalg.inv(found.information)[3:6, 3:6])
    axis = some.T_world_camera[1][:3, :3].T @ [0, 0, 1]
    assert abs(vectors[:, -1] @ axis) > np.cos(np.radians(10))
    assert w[-2] < w[-1] / 4  # the other rotations are known
    # Whatever it slipped by is covered, and nothing but a slip about the axis is wrong.
    D = Rotation.from_matrix((found.S_target_source @ true.inverse()).R).as_rotvec()
    assert np.degrees(np.linalg.norm(D)) < 2.5 * found.rotation_sigma_deg
    assert np.degrees(np.linalg.norm(D - axis * (axis @ D))) < 1.5
    assert target.valid.any()


@pytest.mark.parametrize("scene", ["head", "frog"])
def test_objects_with_a_relief_do_not_slip(scene):
    found, true, target, _ = matched(scene, 4, 5)
    angle, shift, _ = difference(found.S_target_source, true, target.centroid)
    assert angle < 1.5 and shift < 0.03 * target.radius
    assert found.slip_deg == 0
    assert found.rotation_sigma_deg < PAIR.slip_angles_deg[0] / 2


def test_a_ball_slips():
    ball = build_surface_map(cloud_of_depth(lambda x, y: 4 * (1 - np.sqrt(1 - 0.9 * (x**2 + y**2)) * 0.3), 60))
    found = register_pair((ball, ball), (0, 1), PAIR.nearby, np.random.default_rng(0))
    assert found.rotation_sigma_deg > found.slip_deg > 0


def depth_of_table(ridge: bool):
    """A table, with a ridge of 3 % of its area far from the middle, or without."""

    def depth(x, y):
        height = 0.12 * np.clip(1 - np.abs(x - 0.3) / 0.06, 0, None) * (np.abs(y - 0.1) < 0.15)
        return 3 - (height if ridge else 0 * x)

    return build_surface_map(cloud_of_depth(depth, 120))


def test_a_few_points_that_a_motion_moves_hold_a_table_in_place():
    """All points but those of the ridge stay on the table's plane, whatever the motion; their number says nothing."""
    bare, held = (
        register_pair((one, one), (0, 1), PAIR.nearby, np.random.default_rng(0))
        for one in (depth_of_table(False), depth_of_table(True))
    )
    assert bare is not None and held is not None
    assert bare.slip_deg == pytest.approx(PAIR.slip_angles_deg[-1])
    assert held.slip_deg <= PAIR.bounded_slip_deg


def test_fewer_points_must_notice_a_motion_all_the_more():
    """The rise of a mean in its standard errors, which go with the root of the number of points."""
    every = CostOfPoints(0.18, 0.24, 0.9, 0.9)
    few = MotionCost(every, CostOfPoints(0.02, 0.08, 0.1, 0.1))
    assert few.rise == pytest.approx(0.6 / 3)
    assert MotionCost(every, every).rise == pytest.approx(0.06 / 0.9)
    assert (few + few).rise == pytest.approx(few.rise)
    assert MotionCost(every, CostOfPoints(0.0, 0.0, 0.0, 0.0)).rise == pytest.approx(0.06 / 0.9)
