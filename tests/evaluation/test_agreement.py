"""Agreement of a mesh with the captures, and holes where a frame measured surface."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.evaluation.agreement import (
    MAX_PIXELS,
    CaptureAgreement,
    FramePixels,
    find_holes,
    frame_pixels,
    look_up,
    most_pixels,
)
from sl_nerfstudio.evaluation.evaluate import evaluate
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import Frame, Scan, read_scan
from sl_nerfstudio.scan.coordinates import CoordinateFiles
from tests.formulas import rays

from .faceted_scan import MADE, TRUTH, FacetedScan
from .shapes import blob, turn

DOE = Device(w=96, h=80, fl_x=210.0, fl_y=205.0, cx=48.0, cy=41.0, model="DOE")


def fit_of(scan: Scan, mesh: Mesh, poses: DevicePoses | None = None) -> CaptureAgreement:
    return evaluate(mesh, scan, poses or scan.poses).agreement


SCANS = {
    "pinhole": MADE,
    "DOE": FacetedScan(projector=DOE),
    "metres": FacetedScan(units="m", scale=0.04, offset=(3.0, -2.0, 1.0)),
    "far from the origin": FacetedScan(offset=(5000.0, 2000.0, -3000.0)),
}


@pytest.mark.parametrize("made", SCANS.values(), ids=SCANS)
def test_truth_explains_a_clean_scan_perfectly(made: FacetedScan, tmp_path: Path) -> None:
    fit = fit_of(read_scan(made.write(tmp_path / "scan")), made.truth())
    assert fit.coordinate_px_median < 1e-3
    assert fit.coordinate_px_p95 < 1e-2
    assert fit.epipolar_px_median < 1e-3
    assert fit.pattern_cosine > 0.9999  # 8 bits
    assert fit.hit_share == 1.0
    assert [frame.name for frame in fit.frames] == ["frame_00000", "frame_00001", "frame_00002"]
    for frame in fit.frames:
        assert frame.lit_share > 0.97 and frame.decoded_share == 1.0


def test_a_known_shift_of_the_decoded_coordinates_is_the_residual(scan: Scan, tmp_path: Path) -> None:
    np.savez(tmp_path / "shifted.npz", coords=scan.frames[0].read_coords() + np.float32([0.3, -0.4]))
    pixels, _ = pixels_of(
        scan, TRUTH, replace(scan.frames[0], coords_files=CoordinateFiles((tmp_path / "shifted.npz",)))
    )
    np.testing.assert_allclose(np.median(pixels.offset, axis=0), [-0.3, 0.4], atol=1e-3)
    assert np.median(pixels.coordinate) == pytest.approx(0.5, abs=1e-3)
    assert np.nanmax(np.abs(pixels.epipolar)) <= 0.5 + 1e-3  # a shift has a part along the curve, too


def test_wrong_relative_pose_shows_in_the_epipolar_residual_whatever_the_mesh(scan: Scan) -> None:
    projectors = scan.poses.T_world_projector.copy()
    projectors[:, :3, :3] = projectors[:, :3, :3] @ turn((1, 0, 0), 1.0)  # 1 degree is 3.2 pattern pixels
    poses = DevicePoses(scan.poses.T_world_camera, projectors)
    small_fit, true_fit = (fit_of(scan, Mesh(TRUTH.vertices * size, TRUTH.faces), poses) for size in (0.8, 1.0))
    assert 1.5 < true_fit.epipolar_px_median < 3.5
    assert small_fit.epipolar_px_median == true_fit.epipolar_px_median
    assert true_fit.pattern_cosine < 0.99


def test_depth_of_a_pixel_and_ray_angle_follow_from_the_set_up(scan: Scan) -> None:
    fit, true = fit_of(scan, TRUTH), MADE.true_poses()
    centres = (T[:, :3, 3] for T in (true.T_world_camera, true.T_world_projector))
    camera, projector = (c / np.linalg.norm(c, axis=1)[:, None] for c in centres)
    radius = 32.0  # the surface is nearer to the devices than the centre they look at
    angle = np.median(np.arccos((camera * projector).sum(1))) * 250 / (250 - radius)
    assert fit.ray_angle_deg == pytest.approx(np.degrees(angle), rel=0.1)
    assert fit.depth_per_px == pytest.approx((240 - radius) / 190 / np.sin(angle), rel=0.15)


def test_look_up_is_bilinear_between_pixel_centres() -> None:
    image = np.array([[0.0, 1.0], [2.0, 4.0]])
    uv = np.array([[0.5, 0.5], [1.5, 0.5], [1.0, 0.5], [1.0, 1.0], [0.0, 0.0], [np.nan, 0.5]])
    np.testing.assert_allclose(look_up(image, uv), [0, 1, 0.5, 1.75, 0, np.nan])


def test_large_and_many_frames_are_thinned_on_a_grid(scan: Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    every, _ = pixels_of(scan, TRUTH)
    few, _ = pixels_of(scan, TRUTH, max_pixels=len(every.row) // 4 + 1)
    assert (every.stride, few.stride) == (1, 2)
    assert len(few.row) == pytest.approx(len(every.row) / 4, rel=0.1)
    assert not (few.row % 2).any() and not (few.column % 2).any()
    assert [most_pixels(frames) for frames in (1, 120, 1000)] == [MAX_PIXELS, MAX_PIXELS, 30_000]
    whole, counts = fit_of(scan, TRUTH), []
    monkeypatch.setattr("sl_nerfstudio.evaluation.agreement._ALL_PIXELS", 1500)
    thin = evaluate(TRUTH, scan, scan.poses, on_frame=lambda *one: counts.append(len(one[2].row))).agreement
    assert len(counts) == 3 and all(200 < count <= 550 for count in counts)
    for a, b in zip(whole.frames, thin.frames, strict=True):
        assert b.pixels == pytest.approx(a.pixels, rel=0.1) and b.hit_share == a.hit_share == 1.0


FINE = FacetedScan(mesh=blob(24))


@pytest.fixture(scope="module")
def fine_scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return read_scan(FINE.write(tmp_path_factory.mktemp("holes") / "scan"))


def pixels_of(
    scan: Scan, mesh: Mesh, frame: Frame | None = None, max_pixels: int = MAX_PIXELS
) -> tuple[FramePixels, float]:
    """Of the first frame, or another one; and the size of the mesh."""
    frame, surface = frame or scan.frames[0], IndexedMesh(mesh)
    T = frame.T_world_camera, frame.T_world_projector
    return frame_pixels(surface, frame, scan, scan.read_pattern(), *T, max_pixels=max_pixels), surface.diagonal


@pytest.mark.parametrize("radius", [0.0, 8.0, 14.0])
def test_a_hole_is_as_large_as_the_pixels_that_saw_what_is_missing(fine_scan: Scan, radius: float) -> None:
    """Rays through the hole meet the back of the object: they hit, but not where the frame measured."""
    truth, frame = FINE.truth(), fine_scan.frames[0]
    whole, _ = pixels_of(fine_scan, truth)
    towards = frame.T_world_camera[:3, 3]
    nearest = truth.vertices[np.argmax(truth.vertices @ towards)]
    lost = np.linalg.norm(truth.vertices[truth.faces].mean(1) - nearest, axis=1) < radius
    eye, d = rays(frame.camera, frame.T_world_camera, np.stack([whole.column, whole.row], 1) + 0.5)
    hits = IndexedMesh(truth).cast(np.broadcast_to(eye, d.shape), d)
    expected = float(lost[hits.face[whole.decoded & whole.hit]].sum() / whole.decoded.sum())
    missing, largest = find_holes(*pixels_of(fine_scan, truth.with_faces(~lost)))
    assert expected >= 0.001 * radius and missing == pytest.approx(expected, rel=0.1)
    assert 0.6 * expected <= largest <= missing


def test_a_patch_that_was_mistaken_for_another_is_no_hole(fine_scan: Scan) -> None:
    """Its points lie in the air before the surface, on their epipolar curves, but it has a jump all around it."""
    pixels, size = pixels_of(fine_scan, FINE.truth())
    row, column = int(np.median(pixels.row)), int(np.median(pixels.column))
    patch = (np.abs(pixels.row - row) < 3) & (np.abs(pixels.column - column) < 3)
    wrong = replace(
        pixels,
        coords=np.where(patch[:, None], pixels.coords + 15.0, pixels.coords),
        offset=np.where(patch[:, None], 15.0, pixels.offset),
        behind=np.where(patch, 0.2 * size, pixels.behind),
    )
    assert patch.sum() < 0.03 * pixels.decoded.sum()
    assert find_holes(wrong, size)[1] == 0.0
    continuous = replace(wrong, coords=pixels.coords)  # the same without the jump: surface is missing
    assert find_holes(continuous, size)[1] == pytest.approx(patch.sum() / pixels.decoded.sum())


def test_narrow_gaps_along_the_rim_and_frames_without_pixels(fine_scan: Scan) -> None:
    pixels, size = pixels_of(fine_scan, FINE.truth())
    rim = np.array([c == pixels.column[pixels.row == r].min() for r, c in zip(pixels.row, pixels.column, strict=True)])
    missing, largest = find_holes(replace(pixels, hit=pixels.hit & ~rim), size)
    assert missing > 0.01 and largest == 0.0
    assert find_holes(replace(pixels, decoded=np.zeros_like(pixels.decoded)), size) == (0.0, 0.0)
