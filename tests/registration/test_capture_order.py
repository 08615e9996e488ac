"""The sides of a symmetric object: told by the order of capture, and never taken for certain."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.pairs import Rival
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.surfaces import build_surface_map
from sl_nerfstudio.registration.symmetry import (
    _longest_run,
    chain_of_small_steps,
    sides_are_open,
    typical_step_deg,
)
from tests.registration.graph_edges import edge
from tests.registration.shaped_clouds import RenderedClouds, rendered

FRAMES, ALL_AROUND = 8, 30  # steps of 9 to 17 degrees; a nut looks the same after 60


@pytest.fixture(scope="module")
def nut(tmp_path_factory: pytest.TempPathFactory) -> RenderedClouds:
    path: Path = tmp_path_factory.mktemp("meshes") / "nut.ply"
    trimesh.creation.cylinder(30, 25, sections=6).export(path)
    return rendered(str(path), tuple(range(FRAMES)), ALL_AROUND, 90)


def turned_from_truth(found: list[Similarity], true: list[Similarity]) -> list[float]:
    """Angles between relative rotations and the true ones, of all frames against the first, in degrees."""
    return [angle_deg(found[0].R.T @ f.R @ (true[0].R.T @ t.R).T) for f, t in zip(found, true, strict=True)]


def steps(deg: float) -> list[Similarity]:
    """Cameras that go around the origin in equal steps."""
    turns = [Rotation.from_euler("y", k * deg, degrees=True).as_matrix() for k in range(6)]
    return [Similarity(1.0, R, R @ np.array([0.0, 0, 4])) for R in turns]


def test_the_chain_of_small_steps_shows_every_side_of_a_nut(nut: RenderedClouds) -> None:
    maps = [build_surface_map(c) for c in nut.clouds]
    chain = chain_of_small_steps(maps, 12.0, np.random.default_rng(0), REGISTRATION_DEFAULTS)
    known = [S for S in chain if S is not None]
    assert len(known) == FRAMES
    assert max(turned_from_truth(known, nut.S_world_camera)) < 3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_nut_is_registered_at_the_sides_that_it_shows_or_said_to_be_symmetric(nut: RenderedClouds, seed: int) -> None:
    found = register(nut.clouds, seed=seed)
    inside = np.flatnonzero(found.registered)
    assert len(inside) > FRAMES / 2
    poses = [Similarity(1.0, found.T_world_camera[k, :3, :3], found.T_world_camera[k, :3, 3]) for k in inside]
    errors = turned_from_truth(poses, [nut.S_world_camera[k] for k in inside])
    assert max(errors) < 3
    assert any(turn == pytest.approx(60, abs=1) for turn in found.turns_deg) or not found.by_order


def test_a_run_goes_from_frame_to_frame_and_ends_where_a_step_is_unknown() -> None:
    true = steps(15.0)
    exact = [b.inverse() @ a for a, b in pairwise(true)]
    chain = _longest_run(exact)
    for found, wanted in zip(chain, true, strict=True):
        assert found is not None
        np.testing.assert_allclose(found.matrix(), (true[0].inverse() @ wanted).matrix(), atol=1e-12)
    broken = _longest_run([exact[0], None, *exact[2:]])
    assert [S is None for S in broken] == [True, True, False, False, False, False]
    assert broken[2] is not None and broken[5] is not None
    np.testing.assert_allclose(
        (broken[2].inverse() @ broken[5]).matrix(), (true[2].inverse() @ true[5]).matrix(), atol=1e-12
    )
    assert _longest_run([None, None]) == [None, None, None]


def test_the_usual_step_is_that_of_pairs_that_hold() -> None:
    true = steps(15.0)
    pairs = [edge(true, k, k + 1) for k in range(5)]
    assert typical_step_deg(pairs, REGISTRATION_DEFAULTS) == pytest.approx(15)
    slipping = [replace(e, slip_deg=12.0, shape_slip_deg=12.0) for e in pairs]
    assert typical_step_deg(pairs[:2] + slipping[2:], REGISTRATION_DEFAULTS) is None  # a vase
    assert typical_step_deg([], REGISTRATION_DEFAULTS) is None


@pytest.mark.parametrize(("degrees", "ratio", "open_"), [(60.0, 0.95, True), (60.0, 0.7, False), (10.0, 0.95, False)])
def test_sides_are_open_where_another_one_fits_as_well(degrees: float, ratio: float, open_: bool) -> None:
    true = steps(15.0)
    turn = Similarity(1.0, Rotation.from_euler("y", degrees, degrees=True).as_matrix(), np.zeros(3))
    rival = Rival(true[1].inverse() @ turn @ true[0], ratio)
    assert sides_are_open([edge(true, 0, 1, rivals=(rival,))], REGISTRATION_DEFAULTS) is open_
