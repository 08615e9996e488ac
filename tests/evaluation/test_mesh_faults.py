"""Meshes of other programs: triangles turned over, other axes, another unit and loose pieces are named."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import evaluate
from sl_nerfstudio.evaluation.judgement import judge
from sl_nerfstudio.evaluation.mesh_faults import find_mesh_faults
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import read_scan
from tests.meshing.solids import together

from .faceted_scan import FacetedScan
from .shapes import blob, sphere


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory):
    """A finely divided shape, and its scan."""
    one = FacetedScan(frames=4, mesh=blob(8))
    return read_scan(one.write(tmp_path_factory.mktemp("faults") / "scan")), one.truth()


def flipped(mesh: Mesh, chosen: np.ndarray) -> Mesh:
    return replace(mesh, faces=np.where(chosen[:, None], mesh.faces[:, ::-1], mesh.faces))


def with_piece(mesh: Mesh, at: tuple[float, float, float], size: float) -> Mesh:
    other = sphere(size / 2, 6)
    return together(mesh, Mesh(other.vertices + np.array(at), other.faces))


def faults(case, mesh: Mesh):
    return find_mesh_faults(IndexedMesh(mesh), case[0], case[0].poses)


def test_a_right_mesh_has_no_faults(case) -> None:
    assert faults(case, case[1]) == ()


def test_triangles_that_are_turned_over_are_named_with_their_share(case) -> None:
    scan, mesh = case
    (whole,) = faults(case, flipped(mesh, np.ones(len(mesh.faces), bool)))
    assert whole.reason.band == "poor" and whole.reason.sentence.startswith("the mesh is inside out: 100%")
    (half,) = faults(case, flipped(mesh, mesh.vertices[mesh.faces].mean(1)[:, 0] > 0))
    assert half.reason.sentence.startswith("the mesh is partly inside out") and "Coherently" in half.advice
    judgement = judge(evaluate(flipped(mesh, np.ones(len(mesh.faces), bool)), scan, scan.poses))
    assert judgement.verdict.band == "poor" and judgement.verdict.reasons[0] == whole.reason.sentence
    assert judgement.next_steps[0] == whole.advice


def test_other_axes_and_another_unit_are_named(case) -> None:
    scan, mesh = case
    x, y, z = mesh.vertices.T
    (fault,) = faults(case, Mesh(np.stack([x, z, -y], 1), mesh.faces))
    assert "x, y, z of the scan are x, -z, y of the mesh (y is up in the mesh)" in fault.reason.sentence
    with pytest.raises(UserError, match=r"its axes fit, and its lengths are 0.001 times the scan's"):
        evaluate(Mesh(mesh.vertices / 1000, mesh.faces), scan, scan.poses)


@pytest.mark.parametrize("at", [(0.0, 0.0, 60.0), (0.0, 0.0, 0.0)])  # in the air, and inside, where no frame sees it
def test_a_loose_piece_is_named_with_its_place(case, at) -> None:
    (fault,) = faults(case, with_piece(case[1], at, 6.0))
    assert fault.reason.band == "acceptable" and "--largest-component" in fault.advice
    assert fault.reason.sentence.startswith("1 loose piece of the mesh that no frame confirms: 1")


def test_pieces_that_hang_on_a_corner_are_pieces_of_their_own() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0], [1, 2, 0], [9, 9, 9.0]])
    mesh = Mesh(vertices, np.array([[0, 1, 2], [1, 3, 2], [3, 4, 5]]))
    assert mesh.component_of_faces().tolist() == [0, 0, 1]
