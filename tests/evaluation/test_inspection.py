"""Deviations of a part with a known error: found, in the right place, and called out only where that is certain."""

import numpy as np
import pytest

from sl_nerfstudio.evaluation.inspection import deviation_colours, inspect
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.mesh import Mesh, VertexQuality

from .shapes import ANYWHERE, bracket, scanned

SIGMA, ERROR, RADIUS = 0.02, 0.2, 6.0
PLACE = np.array([40.0, 10.0, 15.0])  # on the upper side of the longer wall


def wrong_bracket(unit: float = 1.0) -> tuple[Mesh, Mesh, Similarity]:
    """The part, a scan of it with a plateau of 0.2 mm on one side, and where it is; a millimetre is `unit`."""
    mesh = scanned(bracket(), edge=1.5, noise=0.0, S=Similarity.identity())
    near = (np.linalg.norm(mesh.vertices - PLACE, axis=1) < RADIUS) & (np.abs(mesh.vertices[:, 1] - 10) < 1e-9)
    off = np.random.default_rng(0).normal(0, SIGMA, len(mesh.vertices))
    off[near] += ERROR
    moved = Mesh(mesh.vertices + off[:, None] * mesh.vertex_normals(), mesh.faces)
    S, scale = ANYWHERE, Similarity.scaling(unit)
    return bracket().mapped(scale), moved.mapped(scale @ S), scale @ S.inverse() @ scale.inverse()


def quality(mesh: Mesh, sigma: float) -> VertexQuality:
    values = np.full(len(mesh.vertices), sigma)
    return VertexQuality(values, values, np.full(len(values), 3), values, values)


@pytest.mark.parametrize("unit", [1.0, 1e-3], ids=["mm", "m"])
def test_a_known_error_is_found_at_its_place_whatever_the_unit(unit: float) -> None:
    part, mesh, S = wrong_bracket(unit)
    found = inspect(mesh, part, S, 0.1 * unit, quality(mesh, SIGMA * unit))
    (patch,) = found.patches
    assert patch.mean / unit == pytest.approx(ERROR, abs=0.02)
    assert np.linalg.norm(np.array(patch.place) / unit - PLACE) < RADIUS + 0.1
    assert patch.area / unit**2 == pytest.approx(np.pi * RADIUS**2, rel=0.15)
    assert found.out is not None and found.within is not None and found.undecided is not None
    assert found.within + found.undecided + found.out == pytest.approx(1) and 0.005 < found.out < 0.02
    assert found.rms / unit == pytest.approx(np.sqrt(SIGMA**2 + 0.012 * ERROR**2), rel=0.2)
    assert ((found.beyond() > 0) == (found.deviation > (0.1 + 2 * SIGMA) * unit)).all()


def test_what_is_smaller_than_two_sigma_is_not_called_out_of_tolerance() -> None:
    part, mesh, S = wrong_bracket()
    unsure = inspect(mesh, part, S, 0.01, quality(mesh, 0.3))
    assert unsure.out == 0 and not unsure.patches and unsure.within == 0 and unsure.undecided == 1
    unknown = inspect(mesh, part, S, 0.01)  # nobody states an uncertainty: values count as they are
    assert unknown.median_sigma is None and unknown.out is not None and unknown.out > 0.5 and unknown.undecided == 0


def test_what_no_frame_confirms_counts_nowhere() -> None:
    part, mesh, S = wrong_bracket()
    stated = quality(mesh, SIGMA)
    stated.sigma[S.points(mesh.vertices)[:, 0] > 30] = np.nan  # half of the longer wall, with the error on it
    found = inspect(mesh, part, S, 0.1, stated)
    assert found.out == 0 and not found.patches and 0.2 < found.unmeasured < 0.5


def test_colours_say_on_which_side() -> None:
    inside, fine, outside = deviation_colours(np.array([-5.0, 0.0, 5.0]), 0.2).astype(int)
    assert inside.argmax() == 2 and fine.argmax() == 1 and outside.argmax() == 0
