"""Missing surface is found where a frame measured it; wrong decodings and rims are not taken for it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.evaluation.agreement import FramePixels, find_holes, frame_pixels
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import read_scan

from .faceted_scan import FacetedScan
from .shapes import blob

MADE = FacetedScan(mesh=blob(24))


@pytest.fixture(scope="module")
def fine_scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return MADE.write(tmp_path_factory.mktemp("holes") / "scan")


def pixels_of(root: Path, mesh: Mesh) -> tuple[FramePixels, float]:
    scan = read_scan(root)
    frame, surface = scan.frames[0], IndexedMesh(mesh)
    pixels = frame_pixels(surface, frame, scan, scan.read_pattern(), frame.T_world_camera, frame.T_world_projector)
    return pixels, surface.diagonal


def without(mesh: Mesh, centre: np.ndarray, radius: float) -> tuple[Mesh, np.ndarray]:
    """The mesh without the triangles around a point, and which ones those were."""
    lost = np.linalg.norm(mesh.vertices[mesh.faces].mean(1) - centre, axis=1) < radius
    return Mesh(mesh.vertices, mesh.faces[~lost]), lost


def test_the_whole_surface_has_no_holes(fine_scan: Path) -> None:
    holes = find_holes(*pixels_of(fine_scan, MADE.truth()))
    assert (holes.missing, holes.largest) == (0.0, 0.0)


@pytest.mark.parametrize("radius", [8.0, 14.0])
def test_a_hole_is_as_large_as_the_pixels_that_saw_what_is_missing(fine_scan: Path, radius: float) -> None:
    """Rays through the hole meet the back of the object: they hit, but not where the frame measured."""
    scan, truth = read_scan(fine_scan), MADE.truth()
    whole, _ = pixels_of(fine_scan, truth)
    towards = scan.frames[0].T_world_camera[:3, 3]
    nearest = truth.vertices[np.argmax(truth.vertices @ towards)]
    mesh, lost = without(truth, nearest, radius)
    hits = IndexedMesh(truth).cast(*rays_of(fine_scan, whole))
    expected = float(lost[hits.face[whole.decoded & whole.hit]].sum() / whole.decoded.sum())
    holes = find_holes(*pixels_of(fine_scan, mesh))
    assert expected > 0.01
    assert holes.missing == pytest.approx(expected, rel=0.1)
    assert 0.6 * expected < holes.largest <= holes.missing


def rays_of(root: Path, pixels: FramePixels) -> tuple[np.ndarray, np.ndarray]:
    """Camera rays by the pinhole's formula."""
    frame = read_scan(root).frames[0]
    c = frame.camera
    x, y = (pixels.column + 0.5 - c.cx) / c.fl_x, -(pixels.row + 0.5 - c.cy) / c.fl_y
    d = np.stack([x, y, -np.ones_like(x)], -1)
    d = d / np.linalg.norm(d, axis=1, keepdims=True) @ frame.T_world_camera[:3, :3].T
    return np.broadcast_to(frame.T_world_camera[:3, 3], d.shape), d


def test_a_patch_that_was_mistaken_for_another_is_no_hole(fine_scan: Path) -> None:
    """Its points lie in the air before the surface, on their epipolar curves, but it has a jump all around it."""
    pixels, size = pixels_of(fine_scan, MADE.truth())
    row, column = int(np.median(pixels.row)), int(np.median(pixels.column))
    patch = (np.abs(pixels.row - row) < 3) & (np.abs(pixels.column - column) < 3)
    wrong = replace(
        pixels,
        coords=np.where(patch[:, None], pixels.coords + 15.0, pixels.coords),
        offset=np.where(patch[:, None], 15.0, pixels.offset),
        behind=np.where(patch, 0.2 * size, pixels.behind),
    )
    assert patch.sum() < 0.03 * pixels.decoded.sum()
    assert find_holes(wrong, size).largest == 0.0
    continuous = replace(wrong, coords=pixels.coords)  # the same without the jump: surface is missing
    assert find_holes(continuous, size).largest == pytest.approx(patch.sum() / pixels.decoded.sum())


def test_narrow_gaps_along_the_rim_and_frames_without_pixels(fine_scan: Path) -> None:
    pixels, size = pixels_of(fine_scan, MADE.truth())
    rim = np.array([c == pixels.column[pixels.row == r].min() for r, c in zip(pixels.row, pixels.column, strict=True)])
    holes = find_holes(replace(pixels, hit=pixels.hit & ~rim), size)
    assert holes.missing > 0.01 and holes.largest == 0.0
    nothing = find_holes(replace(pixels, decoded=np.zeros_like(pixels.decoded)), size)
    assert (nothing.missing, nothing.largest) == (0.0, 0.0)
