"""The object cut out of a mesh: a ball on a table, from noise-free captures."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from sl_nerfstudio.cli.export import ExportConfig, summary
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.finish import MarkedMesh
from sl_nerfstudio.meshing.mesh import Mesh, VertexProperties, VertexQuality
from sl_nerfstudio.object_separation.planes import Plane
from sl_nerfstudio.object_separation.separate import Separation
from sl_nerfstudio.runs.export import (
    Exported,
    ExtractedSurface,
    build_surface,
    cut_object,
    planes_below,
    separate_scan,
    standing,
)
from sl_nerfstudio.runs.export_settings import ExportSettings
from sl_nerfstudio.scan import Scan
from tests.meshing.ray_cast_scan import pairs_around, scan_of
from tests.meshing.solids import mesh_of, plate, together

from .ball_run import BallModel

RADIUS = 25.0


BALL = mesh_of(trimesh.creation.icosphere(4, RADIUS))
MESH = together(BALL, plate(140.0, 4.75, -RADIUS))  # on a table


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Scan:
    return scan_of(MESH, pairs_around(8, 45), tmp_path_factory.mktemp("cut") / "scan")


@pytest.fixture(scope="module")
def found(scan) -> Separation:
    return separate_scan(scan, scan.poses)


def test_the_table_goes_and_the_ball_stays(found):
    cut = cut_object(MESH, found)
    kept = MESH.with_faces(cut.kept)
    np.testing.assert_allclose(np.linalg.norm(kept.vertices, axis=1), RADIUS, rtol=0.03)
    assert len(cut.removed) == 1 and abs(cut.removed[0].plane.normal[2]) > 0.9999
    assert cut.area_before == pytest.approx(MESH.face_areas().sum())
    assert cut.area_before - cut.area_removed == pytest.approx(kept.face_areas().sum())
    seen = BALL.vertices[:, 2] > -0.5 * RADIUS
    assert kept.vertices[:, 2].max() > 0.99 * RADIUS and len(kept.vertices) > 0.95 * seen.sum()


def test_the_planes_below_the_object_are_the_same_in_the_scene(found):
    S = Similarity(0.02, Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix(), np.array([0.1, 0.2, -0.3]))
    ((normal, offset),) = planes_below(found, S)
    one = found.surroundings[0]
    points = np.random.default_rng(0).normal(size=(50, 3)) * 100
    above = S.points(points) @ normal - offset
    np.testing.assert_allclose(above, S.scale * (one.finding.plane.heights(points) - one.tolerance), atol=1e-9)
    assert abs(one.finding.plane.normal[2]) > 0.9999 and 0 < one.tolerance < 2


@pytest.mark.parametrize("align", ["plane", "z-up"])
def test_a_tilted_world_stands_upright(scan, found, monkeypatch, align):
    """The table at z = 0 and the ball above the origin; or only what was up for the cameras."""
    tilt = Similarity(1.0, Rotation.from_rotvec([2.0, -0.5, 0.2]).as_matrix(), np.array([100.0, 20.0, -30.0]))
    plane = found.surroundings[0].finding.plane
    normal = tilt.R @ plane.normal
    moved = SimpleNamespace(plane=Plane(normal, plane.offset + float(normal @ tilt.t)))
    tilted = SimpleNamespace(surroundings=[SimpleNamespace(finding=moved)])
    monkeypatch.setattr("sl_nerfstudio.runs.export.separate_scan", lambda *_: tilted)
    S = standing(align, BALL.mapped(tilt), scan, scan.poses.mapped(tilt)) @ tilt
    np.testing.assert_allclose(S.R[2], [0, 0, 1], atol=1e-2)  # what was up is up again
    if align == "plane":
        np.testing.assert_allclose(S.points(np.zeros(3)), [0, 0, RADIUS], atol=0.1)
    tilted.surroundings.clear()
    if align == "plane":
        with pytest.raises(UserError, match=r"--align plane: no plane was found[\s\S]*remedy: give --align z-up"):
            standing(align, BALL, scan, scan.poses)


class BallOnTable(BallModel):
    """The field of a ball on a table that reaches beyond the scene's box."""

    def sdf(self, p_scene):
        p_world = torch.from_numpy(self.S_scene_world.inverse().points(p_scene.double().numpy()))
        ball = p_world.norm(dim=-1) - RADIUS
        return (torch.minimum(ball, p_world[:, 2] + RADIUS) * self.S_scene_world.scale).float()


def test_a_closed_solid_of_the_object_alone_stands_flat_where_the_table_was(scan, found, monkeypatch):
    monkeypatch.setattr("sl_nerfstudio.runs.export.separate_scan", lambda *_: found)
    model = BallOnTable(scan, S_scene_world=Similarity.scaling(1 / 60))
    surface = build_surface(model, ExportSettings(Path("m.stl"), resolution=64, watertight=True, object_only=True))
    mesh, observed = surface.marked.mesh, ~surface.marked.invented
    assert mesh.is_closed() and surface.cut is not None and len(surface.cut.removed) == 1
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices[observed], axis=1), RADIUS, atol=0.05)
    assert np.abs(mesh.vertices).max() < RADIUS + 0.1
    bottom = mesh.vertices[:, 2].min()
    assert bottom > -RADIUS and (mesh.vertices[:, 2] < bottom + 0.05).sum() > 20  # flat
    open_one = build_surface(model, ExportSettings(Path("m.ply"), resolution=64, object_only=True))
    assert not open_one.marked.mesh.is_closed() and len(open_one.marked.mesh.faces) < len(mesh.faces)


def test_the_summary_says_what_was_removed_and_why(scan, found):
    cut = cut_object(MESH, found)
    marked = MarkedMesh(MESH, np.zeros(len(MESH.vertices), dtype=bool)).with_faces(cut.kept)
    surface = ExtractedSurface(marked, None, None, cut, 0, 1.0)
    nothing = VertexQuality(np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))
    properties = VertexProperties(nothing, marked.invented)
    exported = Exported(marked.mesh, properties, surface, *4 * [None], 0, None, False, 1.0)
    text = " ".join(summary(ExportConfig(Path("c"), Path("mesh.ply"), object_only=True), scan, exported).split())
    assert re.search(r"--object-only removed [\d.e+]+ square mm \(9\d% of the surface\) with 1 planes around", text)
    assert "of the points left out: all cameras are in front of it, nothing is behind it" in text


def test_nothing_left_and_no_coordinates_are_refused(found, tmp_path):
    with pytest.raises(UserError, match=r"leaves nothing of the surface\n.*far from the scan's decoded points"):
        cut_object(Mesh(BALL.vertices + 500.0, BALL.faces), found)
    empty = scan_of(MESH, pairs_around(2, 45), tmp_path, lambda _, coords: np.full_like(coords, np.nan))
    with pytest.raises(UserError, match="no frame has decoded coordinates, so --object-only cannot find the object"):
        separate_scan(empty, empty.poses)
