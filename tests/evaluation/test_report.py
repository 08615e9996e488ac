import re
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.evaluation.evaluate import EvaluationInputs, Length, evaluate
from sl_nerfstudio.evaluation.judgement import judge
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import PointReference, mesh_reference
from sl_nerfstudio.evaluation.report.charts import (
    ColourScale,
    OrthographicView,
    camera_views,
    nice_limit,
    pixel_map,
    render,
)
from sl_nerfstudio.evaluation.report.scan_report import ReportInput, ResidualThumbnails, intrinsics_hint, render_report
from sl_nerfstudio.evaluation.report.view3d import decimated
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.mesh import VertexQuality
from sl_nerfstudio.scan import PoseSigma, read_scan

from .faceted_scan import CAMERA, FacetedScan
from .report.pages import Page, figure_of, unpacked
from .shapes import blob, sphere

TRAINING = {
    "settings": {"method": "sl-neus", "model": {"refine_poses": "free", "note": "<script>alert(1)</script>"}},
    "versions": {"torch": "2.11"},
    "curves": {"step": [0, 100, 200], "loss": [5.0, 0.5, 0.1], "coordinate_px": [20.0, None, 0.4]},
    "intrinsics": {
        "change": {"camera": {"focal": 0.01, "x": 0.0, "y": 0.0}, "projector": {"focal": -0.005, "x": 0.0, "y": 0.0}},
        "self_calibration": {
            "change": {"camera": {"focal": 0.002, "x": 0.0, "y": 0.0}, "projector": {"focal": 0.0, "x": 0.0, "y": 0.0}},
            "sigma": {
                "camera": {"focal": 1e-4, "x": 1e-4, "y": 1e-4},
                "projector": {"focal": 1e-4, "x": 0.0, "y": 0.0},
            },
            "chi_square": 412.3,
            "contradicts": True,
        },
    },
}


@pytest.fixture(scope="module")
def full_report(clean_scan: Path) -> str:
    """A report with every section filled."""
    scan, made = read_scan(clean_scan), FacetedScan()
    true = made.true_poses()
    moved = DevicePoses(true.T_world_camera.copy(), true.T_world_projector)
    moved.T_world_camera[1, :3, 3] += 0.5
    thumbnails = ResidualThumbnails()
    reference = mesh_reference(made.truth(), scan, true, 5000)
    evaluation = evaluate(made.truth(), scan, moved, reference, true, samples=5000, on_frame=thumbnails)
    sigma = PoseSigma(0.11, 0.022, 0.033, 0.044)
    path = Path("refined/transforms.json")
    truth = made.truth()
    count = len(truth.vertices)
    views = np.arange(count) % 3  # a third of the vertices is not observed
    stated = np.where(views > 0, 0.05, np.nan)
    quality = VertexQuality(stated, 0.5 * stated, views, 4 * stated, 300 * stated)
    inputs = EvaluationInputs(
        truth, scan, moved, true, reference, path, [sigma, None, sigma], [scan.frames[1].name], TRAINING, quality
    )
    end = (0.0, 0.0, 1.0)
    lengths = [
        Length("width <of> it", end, end, 12.3456, 0.0123, 0.0111, 0.0055, (3, 2)),
        Length("height", end, end, 7.0, None, None, None, (3, 0)),
    ]
    made_at = datetime(2026, 1, 2, 3, 4)
    return render_report(
        ReportInput(
            evaluation,
            judge(evaluation, intrinsics_hint(inputs.training, scan)),
            inputs,
            thumbnails.frames,
            "<mesh & co>.ply",
            made_at,
            lengths,
        )
    )


def test_report_is_one_file_that_loads_nothing_from_elsewhere(full_report: str) -> None:
    page = Page(full_report)
    assert page.loaded and all(address.startswith("data:image/") for address in page.loaded)
    style = "".join(re.findall(r"<style>(.*?)</style>", full_report, flags=re.S))
    assert "@import" not in style and "url(" not in style
    addresses = set(re.findall(r"(?:https?:)?//[a-z0-9-]+(?:\.[a-z0-9-]+)+[^\s\"'<>]*", full_report))
    assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}  # names, not addresses
    assert "default-src 'none'" in full_report  # and the browser enforces it
    assert len(full_report) < 10e6


def test_a_frame_that_cannot_be_placed_is_named(full_report: str, clean_scan: Path) -> None:
    assert f"Frames that cannot be placed: {read_scan(clean_scan).frames[1].name}." in full_report


def test_report_is_accessible_and_its_links_lead_somewhere(full_report: str) -> None:
    page = Page(full_report)
    assert page.undescribed == []
    assert len(page.ids) == len(set(page.ids))
    assert set(page.anchors) <= set(page.ids)
    assert '<html lang="en">' in full_report


def test_report_tells_everything(full_report: str) -> None:
    text = " ".join(" ".join(Page(full_report).text).split())
    for what in (
        "Scan report: scan", "<mesh & co>.ply", "refined/transforms.json", "2026-01-02 03:04", "What it means",
        "frame_00000", "frame_00002", "best agreement", "worst agreement", "Accuracy, RMS", "F-score", "0.022",
        "model.refine_poses", "free", "<script>alert(1)</script>", "2.11", "loss", "3 frames", "64 × 56 pixels",
        "known (by construction)", "σ frame", "The intrinsics contradict the captures (chi square 412, by chance 6)",
        "width <of> it 12.346 0.0123 0.0111 0.00550 3 and 2", "height 7 unknown unknown unknown 3 and 0",
        "focal length of the camera +1.00 %, of the projector -0.50 %", "camera: focal length +0.20 ± 0.01 %",
    ):  # fmt: skip
        assert what in text, what
    assert "<script>alert(1)" not in full_report  # only escaped
    assert full_report.count('class="maps"') == 3


def test_interactive_surface_is_complete(full_report: str) -> None:
    figure = figure_of(full_report)
    assert [trace["name"] for trace in figure["data"]] == ["surface", "cameras", "projectors", "measured"]
    menu, views = figure["layout"]["updatemenus"]
    assert [button["label"] for button in views["buttons"]] == ["object", "all devices"]
    names = ["error", "uncertainty (1 sigma)", "views", "residual", "ray angle"]
    assert [button["label"] for button in menu["buttons"]] == names
    changes = [button["args"][0] for button in menu["buttons"]]
    count = len(FacetedScan().truth().vertices)
    assert all(len(change["intensity"][0]) == count and button["args"][1] == [0]
               for change, button in zip(changes, menu["buttons"], strict=True))  # fmt: skip
    assert changes[0]["intensity"][0] == figure["data"][0]["intensity"]
    sigma, views = (np.array(changes[k]["intensity"][0]) for k in (1, 2))
    assert np.array_equal(views, np.arange(count) % 3)
    assert np.allclose(sigma[views > 0], 0.05) and (sigma[views == 0] > changes[1]["cmax"]).all()  # marked
    assert [change["colorbar.title.text"] for change in changes] == ["mm", "mm", "frames", "px", "degrees"]
    stated = unpacked(figure["data"][0]["customdata"])  # of the ends of a measured line
    np.testing.assert_allclose(stated, np.where(np.arange(count) % 3 > 0, 0.05, np.nan), rtol=1e-6)


def test_pyramids_stand_where_the_devices_do_and_open_towards_what_they_see(full_report: str) -> None:
    figure, made = figure_of(full_report), FacetedScan()
    true = made.true_poses()
    true.T_world_camera[1, :3, 3] += 0.5  # as in the report
    for trace, T, device in ((1, true.T_world_camera, CAMERA), (2, true.T_world_projector, made.projector)):
        drawn = np.stack([unpacked(figure["data"][trace][axis]) for axis in "xyz"], 1).reshape(3, -1, 3)
        assert np.isnan(drawn[:, -1]).all()  # the gap to the next one
        np.testing.assert_allclose(drawn[:, 0], T[:, :3, 3], rtol=1e-5)
        ray = np.array([-device.cx / device.fl_x, device.cy / device.fl_y, -1.0])  # of the upper left corner
        side = drawn[:, 1] - drawn[:, 0]
        expected = np.einsum("nij,j->ni", T[:, :3, :3], ray / np.linalg.norm(ray))
        np.testing.assert_allclose(side / np.linalg.norm(side, axis=1, keepdims=True), expected, atol=1e-4)
        assert figure["data"][trace]["text"][0].endswith("of frame 0: frame_00000")


def test_the_view_of_all_devices_shows_all_of_them(full_report: str) -> None:
    """By the way of Plotly: axes onto the aspect ratio, then a pinhole of 45 degrees, looking at the centre."""
    figure = figure_of(full_report)
    scene = figure["layout"]["scene"]
    low, high = (np.array([scene[f"{axis}axis"]["range"][k] for axis in "xyz"]) for k in (0, 1))
    ratio = np.array([scene["aspectratio"][axis] for axis in "xyz"])
    np.testing.assert_allclose(ratio / (high - low), (ratio / (high - low))[0])  # of equal scale
    shown = {}
    for button in figure["layout"]["updatemenus"][1]["buttons"]:
        camera = {k: np.array([v[axis] for axis in "xyz"]) for k, v in button["args"][0]["scene.camera"].items()}
        back = camera["eye"] - camera["center"]
        back /= np.linalg.norm(back)
        right = np.cross(camera["up"], back)
        right /= np.linalg.norm(right)
        for number, trace in enumerate(figure["data"][:3]):
            p = np.stack([unpacked(trace[axis]) for axis in "xyz"], 1)
            p = (p[np.isfinite(p).all(1)] - low) / (high - low) * ratio - ratio / 2 - camera["eye"]
            edge = np.abs(np.stack([p @ right / (1030 / 560), p @ np.cross(back, right)], 1) / -(p @ back)[:, None])
            shown[button["label"], number] = (edge.max() / np.tan(np.pi / 8)) * (1 if (p @ back < 0).all() else np.inf)
    assert shown["object", 0] < 1 and max(shown["all devices", k] for k in range(3)) < 1
    assert max(shown["all devices", k] for k in range(3)) > 0.85 and shown["object", 0] > 0.85  # and not far away


def test_report_without_truth_training_or_refinement_says_so(clean_scan: Path) -> None:
    scan, made = read_scan(clean_scan), FacetedScan()
    poses = scan.poses
    thumbnails = ResidualThumbnails()
    evaluation = evaluate(made.truth(), scan, poses, on_frame=thumbnails)
    inputs = EvaluationInputs(made.truth(), scan, poses, None, evaluation.reference, None)
    page = render_report(
        ReportInput(
            evaluation, judge(evaluation, intrinsics_hint(inputs.training, scan)), inputs, thumbnails.frames, "mesh.ply"
        )
    )
    text = " ".join(" ".join(Page(page).text).split())
    assert "No truth or reference is known for this scan" in text
    assert "The scan's own poses were evaluated" in text
    assert "There is no training.json next to the poses file" in text
    assert "Accuracy" not in text


def test_report_with_reference_points_shows_signed_offsets(clean_scan: Path) -> None:
    scan, made = read_scan(clean_scan), FacetedScan()
    points = IndexedMesh(made.truth()).sample(5000, 0)[0]
    poses = scan.poses
    thumbnails = ResidualThumbnails()
    evaluation = evaluate(
        made.truth(), scan, poses, PointReference(points, "some points"), samples=5000, on_frame=thumbnails
    )
    inputs = EvaluationInputs(made.truth(), scan, poses, None, evaluation.reference, None)
    page = render_report(
        ReportInput(
            evaluation, judge(evaluation, intrinsics_hint(inputs.training, scan)), inputs, thumbnails.frames, "mesh.ply"
        )
    )
    text = " ".join(" ".join(Page(page).text).split())
    assert "Distance from reference" in text and "some points" in text


def test_offsets_from_reference_points_are_smooth_and_signed() -> None:
    truth, result = IndexedMesh(sphere(10.0, 100)), IndexedMesh(sphere(10.25, 100))
    reference = PointReference(truth.sample(3000, 0)[0], "")
    from sl_nerfstudio.geometry.lie import Similarity

    errors = reference.surface_errors(result, Similarity.identity(), result.sample(500, 1)[0])
    np.testing.assert_allclose(errors, 0.25, atol=0.02)


def test_picture_shows_the_near_side_upright_and_in_colour() -> None:
    surface = IndexedMesh(sphere(10.0, 40))
    red_top = np.where(surface.vertices[:, 2:] > 0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    picture = render(
        surface, OrthographicView(np.array([0.0, -1, 0]), np.array([0.0, 0, 1])), red_top, height=60, width=80
    )
    assert picture.shape == (60, 80, 3)
    np.testing.assert_array_equal(picture[0, 0], 1.0)  # white outside
    assert picture[15, 40, 0] > 0.3 and picture[15, 40, 2] < 0.05
    assert picture[45, 40, 2] > 0.15 and picture[45, 40, 0] < 0.05
    inside = (picture != 1).any(2)
    assert inside.sum() == pytest.approx(np.pi * (0.47 * 60) ** 2, rel=0.05)


def test_views_are_the_most_different_cameras() -> None:
    poses = FacetedScan(frames=9).true_poses().T_world_camera
    views = camera_views(poses, np.zeros(3))
    towards = np.array([v.towards_viewer for v in views])
    assert len(views) == 3 and (towards @ towards.T - np.eye(3)).max() < 0.5


def test_maps_are_cropped_to_their_pixels() -> None:
    row, column = np.array([10, 12, 14]), np.array([30, 32, 30])
    picture = pixel_map(row, column, 2, np.zeros((3, 3)))
    assert picture.shape == (3, 2, 3)
    np.testing.assert_array_equal(picture[..., 0], [[0, 1], [1, 0], [0, 1]])


def test_colour_scale_ends_and_css() -> None:
    scale = ColourScale("RdYlBu_r", -1.0, 1.0)
    np.testing.assert_array_equal(scale(np.array([-5.0, 5.0])), scale(np.array([-1.0, 1.0])))
    assert re.fullmatch(r"linear-gradient\(to right(, #[0-9a-f]{6}){9}\)", scale.css_gradient())


def test_decimation_keeps_the_shape() -> None:
    mesh = blob(120)
    small, nearest = decimated(mesh, 2000)
    assert len(small.faces) <= 2000 and len(nearest) == len(small.vertices)
    assert IndexedMesh(mesh).distance(small.vertices).max() < 0.01
    assert np.linalg.norm(mesh.vertices[nearest] - small.vertices, axis=1).max() < 0.1
    same, index = decimated(blob(8), 2000)
    assert same.faces.shape == blob(8).faces.shape and index[-1] == len(blob(8).vertices) - 1


@pytest.mark.parametrize(("value", "limit"), [(0.07, 0.1), (0.1, 0.1), (0.11, 0.2), (3.0, 5.0), (0.0, 1.0)])
def test_limits_are_round(value: float, limit: float) -> None:
    assert nice_limit(value) == pytest.approx(limit)
