"""Planes, cylinders and spheres on regions of a surface: exact, robust, and with the uncertainty that they state."""

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.shape_fits import FittedShape, fit_shape, parse_region
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.uncertainty import smoothing
from tests.meshing.solids import mesh_of

from .shapes import scanned

HERE = Similarity.identity()
CYLINDER = scanned(mesh_of(trimesh.creation.cylinder(15, 50, sections=200)), edge=1.5, noise=0.0, S=HERE)
SPHERE = mesh_of(trimesh.creation.icosphere(5, 20))
PLANE = scanned(mesh_of(trimesh.creation.box((60, 40, 25))), edge=1.5, noise=0.0, S=HERE)
CASES = {"cylinder 15,0,0 12": (CYLINDER, 15), "sphere 20,0,0 12": (SPHERE, 20), "plane 0,0,12.5 12": (PLANE, None)}


def fitted(text: str, mesh: Mesh) -> FittedShape:
    return fit_shape(parse_region(text), mesh)


@pytest.mark.parametrize("text", CASES)
def test_exact_surfaces_give_exact_shapes_and_stray_pieces_do_not_count(text: str) -> None:
    mesh, radius = CASES[text]
    wild = np.random.default_rng(0).random(len(mesh.vertices)) < 0.1
    mesh = Mesh(mesh.vertices + 3.0 * wild[:, None] * mesh.vertex_normals(), mesh.faces)
    found = fitted(text, mesh)
    if radius is None:
        np.testing.assert_allclose(found.direction, [0, 0, 1], atol=1e-3)
        assert found.point[2] == pytest.approx(12.5, abs=1e-3) and found.radius is None
    else:
        assert found.radius == pytest.approx(radius, abs=0.01)
        np.testing.assert_allclose(found.point[:2], 0, atol=0.02)
    if found.region.kind == "cylinder":
        assert abs(found.direction[2]) == pytest.approx(1, abs=1e-5) and found.point[2] == pytest.approx(0, abs=0.05)
    assert 0.05 < found.rejected < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("text", CASES)
def test_errors_that_neighbours_share_are_as_large_as_their_sigma_says(text: str) -> None:
    mesh, radius = CASES[text]
    normals, smooth = mesh.vertex_normals(), smoothing(mesh, 10.0)
    scores = []
    for seed in range(30):
        off = smooth(np.random.default_rng(seed).normal(size=len(normals)))
        found = fitted(text, Mesh(mesh.vertices + 0.02 * off[:, None] / off.std() * normals, mesh.faces))
        if radius is None:
            scores.append((found.point[2] - 12.5) / found.sigma_point)
        else:
            scores.append((found.radius - radius) / found.sigma_radius)
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.6


@pytest.mark.parametrize("text", ["cone 1,2,3 4", "plane 1,2 3", "plane 1,2,3 -4", ": plane 1,2,3 4", "plane"])
def test_a_region_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(UserError, match=r"--fit: .* is no region[\s\S]*give a shape \(plane, cylinder, sphere\)"):
        parse_region(text)


def test_what_cannot_be_fitted_is_refused_by_name() -> None:
    with pytest.raises(UserError, match=r"--fit far: 0 vertices lie within 5[\s\S]*reaches from [\s\S]*remedy: pick"):
        fitted("far: plane 500,0,0 5", PLANE)
    with pytest.raises(UserError, match=r"--fit side: the surface there is no sphere[\s\S]*remedy: fit a plane"):
        fitted("side: sphere 0,0,12.5 10", PLANE)
