"""A surface placed on its part without a start, and what of the place is left open."""

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.part_alignment import facet_sag, place_on_part
from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from tests.meshing.solids import mesh_of

from .shapes import ANYWHERE, blob, bracket, facing, scanned


@pytest.mark.slow
@pytest.mark.parametrize("with_scale", [False, True])
def test_half_of_a_part_without_symmetry_has_one_place(with_scale: bool) -> None:
    S = Similarity(25.4 if with_scale else 1.0, ANYWHERE.R, ANYWHERE.t)
    seen = scanned(bracket(), S=S) if with_scale else facing(scanned(bracket()), ANYWHERE.R @ [0.3, 0.8, 0.5])
    found = place_on_part(seen, bracket(), with_scale)
    error = found.S_part_result @ S
    assert angle_deg(error.R) < 0.05 and np.abs(error.t).max() < 0.05 and abs(error.scale - 1) < 1e-3
    assert found.fits and not found.in_place and not found.open_motions and not found.equal_turns
    assert found.next_rms is None or found.next_rms > 10 * found.rms


@pytest.mark.slow
def test_a_box_fits_in_four_ways_a_cube_in_24_and_a_box_in_its_own_axes_stays_there() -> None:
    box = mesh_of(trimesh.creation.box((60, 40, 25)))
    cube = mesh_of(trimesh.creation.box((40, 40, 40)))
    found = place_on_part(scanned(box), box)
    assert not found.open_motions
    half_turns = sorted(np.abs(np.diag(R)).round(6).tolist() + np.diag(R).round(2).tolist() for R in found.equal_turns)
    assert half_turns == [[1, 1, 1, -1, -1, 1], [1, 1, 1, -1, 1, -1], [1, 1, 1, 1, -1, -1]]
    assert len(place_on_part(scanned(cube), cube).equal_turns) == 23
    near = Similarity(1.0, np.eye(3), np.array([0.4, -0.2, 0.1]))
    there = place_on_part(scanned(box, S=near), box)
    assert there.in_place
    np.testing.assert_allclose(there.S_part_result.matrix(), near.inverse().matrix(), atol=0.01)


@pytest.mark.slow
def test_round_parts_leave_turns_open_and_a_flat_patch_shifts_too() -> None:
    cylinder = mesh_of(trimesh.creation.cylinder(15, 50, sections=64))
    found = place_on_part(scanned(cylinder), cylinder)
    np.testing.assert_allclose(np.abs(found.open_motions.turns), [[0, 0, 1]], atol=1e-3)
    assert np.abs(found.open_motions.point[:2]).max() < 0.05 and not len(found.open_motions.shifts)
    (end_for_end,) = found.equal_turns
    assert end_for_end[2, 2] == pytest.approx(-1, abs=1e-4)
    sphere = mesh_of(trimesh.creation.icosphere(3, 20))
    ball = place_on_part(scanned(sphere, edge=10.0), sphere).open_motions
    assert len(ball.turns) == 3 and not len(ball.shifts) and np.abs(ball.point).max() < 0.05
    plate = mesh_of(trimesh.creation.box((300, 300, 5)))
    middle = scanned(mesh_of(trimesh.creation.box((60, 60, 5))), edge=5.0)
    patch = place_on_part(facing(middle, ANYWHERE.R @ [0, 0, 1.0]), plate).open_motions
    np.testing.assert_allclose(np.abs(patch.turns), [[0, 0, 1]], atol=1e-3)
    assert np.linalg.matrix_rank(patch.shifts, 0.1) == 2 and np.abs(patch.shifts[:, 2]).max() < 1e-3


@pytest.mark.slow
def test_what_is_not_the_part_does_not_fit() -> None:
    other = blob(20)
    assert not place_on_part(mesh_of(trimesh.creation.box((60, 40, 25))), other.mapped(Similarity.scaling(30.0))).fits


def test_facets_of_a_cylinder_depart_by_what_their_number_says() -> None:
    radius, sections = 15.0, 48
    side = trimesh.creation.cylinder(radius, 1000, sections=sections)
    height = radius * (1 - np.cos(np.pi / sections))
    assert facet_sag(IndexedMesh(mesh_of(side))) == pytest.approx(height * np.sqrt(8 / 15), rel=0.02)
    assert facet_sag(IndexedMesh(bracket())) == 0
