"""The report of sl-eval: one file with everything, and its pictures."""

import base64
import io
import re
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from sl_nerfstudio.evaluation import judgement, report
from sl_nerfstudio.evaluation.agreement import CaptureAgreement, FrameAgreement, FramePixels
from sl_nerfstudio.evaluation.evaluate import EvaluationInputs, Length, evaluate
from sl_nerfstudio.evaluation.judgement import judge
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import PointReference, mesh_reference
from sl_nerfstudio.evaluation.report.charts import OrthographicView, draw_overlaps, render
from sl_nerfstudio.evaluation.report.scan_report import (
    SECTIONS,
    ReportInput,
    ResidualThumbnails,
    brightness_ratio,
    compare_frames,
    intrinsics_hint,
    render_report,
)
from sl_nerfstudio.evaluation.report.view3d import decimated
from sl_nerfstudio.geometry.devices import UNCHANGED, DeviceChange, IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.geometry.triangulation import world_pixels
from sl_nerfstudio.meshing.mesh import VertexQuality
from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord, ProcessRecord
from sl_nerfstudio.review.verdict import Verdict
from sl_nerfstudio.scan import PoseSigma, Scan

from ..faceted_scan import MADE, TRUTH
from ..shapes import blob, sphere
from .pages import Page, clicked, scene_of, unpacked

TRAINING = {
    "settings": {"method": "sl-neus", "model": {"refine_poses": "free", "note": "<script>alert(1)</script>"}},
    "versions": {"torch": "2.11"},
    "curves": {"step": [0, 100, 200], "loss": [5.0, 0.5, 0.1], "coordinate_px": [20.0, None, 0.4]},
    "intrinsics": {
        "change": asdict(IntrinsicsChange(DeviceChange(0.01), DeviceChange(-0.005))),
        "self_calibration": {
            "change": asdict(IntrinsicsChange(DeviceChange(0.002), DeviceChange())),
            "sigma": asdict(IntrinsicsChange(DeviceChange(1e-4, 1e-4, 1e-4), DeviceChange(1e-4))),
            "chi_square": 412.3,
            "contradicts": True,
        },
    },
}

RECORD = ProcessRecord(
    decoder="network", units="mm", scale_source="", verdict=Verdict("acceptable", ("1 of 4 frames was left out",)),
    frames=(
        FrameRecord("lost <x>", False, stage="decoding", reason="shows nothing\n    cause:  dark"),
        *(FrameRecord(f"frame_0000{k}", decode_rate=0.9, component=0, cross_px_p95=0.77) for k in range(3)),
    ),
    edges=(EdgeRecord(("frame_00000", "frame_00001"), 0.5, 0.9, True, False),),
    remarks=(), recapture=("lost <x>: capture it again",), joint_px=(1.5, 0.4), cross_px=(0.21, 0.83), versions={},
)  # fmt: skip
"""Of the three frames of the scan, and of one that is not in it."""


def text_of(page: str) -> str:
    return " ".join(" ".join(Page(page).text).split())


def moved_poses() -> DevicePoses:
    """The true poses but for one camera."""
    true = MADE.true_poses()
    true.T_world_camera[1, :3, 3] += 0.5
    return true


@pytest.fixture(scope="module")
def full_report(scan: Scan) -> str:
    """A report with every section filled."""
    true, moved, thumbnails = MADE.true_poses(), moved_poses(), ResidualThumbnails()
    reference = mesh_reference(TRUTH, scan, true, 5000)
    evaluation = evaluate(TRUTH, scan, moved, reference, true, samples=5000, on_frame=thumbnails)
    sigma = PoseSigma(0.11, 0.022, 0.033, 0.044)
    path = Path("refined/transforms.json")
    count = len(TRUTH.vertices)
    views = np.arange(count) % 3  # a third of the vertices is not observed
    stated = np.where(views > 0, 0.05, np.nan)
    quality = VertexQuality(stated, 0.5 * stated, views, 4 * stated, 300 * stated)
    colour = np.arange(3 * count).reshape(count, 3).astype(np.uint8)
    inputs = EvaluationInputs(
        TRUTH, scan, moved, true, reference, path, [sigma, None, sigma], [scan.frames[1].name], TRAINING, quality,
        colour=colour, record=RECORD,
    )  # fmt: skip
    end = (0.0, 0.0, 1.0)
    lengths = [
        Length("width <of> it", end, end, 12.3456, 0.0123, 0.0111, 0.0055, (3, 2)),
        Length("height", end, end, 7.0, None, None, None, (3, 0)),
    ]
    judged, made_at = judge(evaluation, intrinsics_hint(inputs.training, scan)), datetime(2026, 1, 2, 3, 4)
    return render_report(
        ReportInput(evaluation, judged, inputs, thumbnails.frames, "<mesh & co>.ply", made_at, lengths)
    )


def test_report_is_one_accessible_file_that_loads_nothing_from_elsewhere(full_report: str) -> None:
    page = Page(full_report)
    assert page.undescribed == [] and '<html lang="en">' in full_report
    assert len(page.ids) == len(set(page.ids)) and set(page.anchors) <= set(page.ids)
    assert page.loaded and all(address.startswith("data:image/") for address in page.loaded)
    style = "".join(re.findall(r"<style>(.*?)</style>", full_report, flags=re.S))
    assert "@import" not in style and "url(" not in style
    addresses = set(re.findall(r"(?:https?:)?//[a-z0-9-]+(?:\.[a-z0-9-]+)+[^\s\"'<>]*", full_report))
    assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}  # names, not addresses
    assert "default-src 'none'" in full_report  # and the browser enforces it
    assert len(full_report) < 10e6


def test_report_tells_everything(full_report: str) -> None:
    text = text_of(full_report)
    for what in (
        "Scan report: scan", "<mesh & co>.ply", "refined/transforms.json", "2026-01-02 03:04", "What it means",
        "frame_00000", "frame_00002", "best agreement", "worst agreement", "Accuracy, RMS", "F-score", "0.022",
        "model.refine_poses", "free", "<script>alert(1)</script>", "2.11", "loss", "3 frames", "64 × 56 pixels",
        "known (by construction)", "σ frame", "The intrinsics contradict the captures (chi square 412, by chance 6)",
        "Frames that cannot be placed: frame_00001.",
        "width <of> it 12.346 0.0123 0.0111 0.00550 3 and 2", "height 7 unknown unknown unknown 3 and 0",
        "focal length of the camera +1.00 %, of the projector -0.50 %", "camera: focal length +0.20 ± 0.01 %",
        "0: lost <x> left out", "shows nothing cause: dark", "lost <x>: capture it again", "no: decoding",
        "1.50 px before and 0.40 px after", "half lie within 0.21 px and 95 % within 0.83 px",
    ):  # fmt: skip
        assert what in text, what
    assert "<script>alert(1)" not in full_report  # only escaped
    assert full_report.count('class="maps"') == 4  # and of the capture that was left out
    assert full_report.count('<td class="n">0.77</td>') == 3
    assert text.index("0: lost <x>") < text.index("Every judged figure")


def test_the_object_the_verdict_and_three_figures_come_first_and_what_is_good_is_folded(full_report: str) -> None:
    hero = full_report.index('<section class="hero">')
    assert hero < full_report.index('id="view"') < full_report.index("<dl>") < full_report.index('id="not-good"')
    text = text_of(full_report)
    assert text.index("coordinates agree to") < text.index("What is not good") < text.index("Every judged figure")
    judged = re.findall(r'<tr class="(\w+)"><th scope="row">([^<]+)</th>', full_report)
    assert {name for _, name in judged} <= SECTIONS.keys() and "good" in {band for band, _ in judged}
    unfolded = {SECTIONS[name] for band, name in judged if band != "good"} | {"poses"}  # a frame could not be placed
    unfolded |= {"residuals"} if ">outlier<" in full_report else set()
    found = Page(full_report).unfolded
    assert {name for name in {*SECTIONS.values(), "scan"} if found[name]} == unfolded
    assert found["figures"] and not found["overlaps"] and not found["judgement"]  # a capture was left out


def test_every_judged_figure_has_a_section() -> None:
    source = Path(judgement.__file__).read_text()
    names = re.findall(r'(?:judged|WorstFrameFigure)\(\n\s+"([^"]+)"', source) + ["Accuracy", "Distance from reference"]
    assert set(names) | {"Coverage"} == set(SECTIONS)


def test_interactive_surface_is_complete(full_report: str) -> None:
    (surface,), count = scene_of(full_report)["groups"], len(TRUTH.vertices)
    np.testing.assert_allclose(unpacked(surface["points"], columns=3) + surface["origin"], TRUTH.vertices, atol=1e-4)
    np.testing.assert_array_equal(unpacked(surface["faces"], "<u4", 3), TRUTH.faces)
    layers = {layer["name"]: layer for layer in surface["layers"]}
    assert list(layers) == ["error", "uncertainty (1 sigma)", "views", "residual", "ray angle"]
    assert [layer["units"] for layer in layers.values()] == ["mm", "mm", "frames", "px", "degrees"]
    sigma, views = unpacked(layers["uncertainty (1 sigma)"]["values"]), unpacked(layers["views"]["values"])
    assert np.array_equal(views, np.arange(count) % 3)
    assert np.allclose(sigma[views > 0], 0.05) and (sigma[views == 0] > layers["uncertainty (1 sigma)"]["upper"]).all()
    np.testing.assert_allclose(unpacked(surface["sigma"]), np.where(np.arange(count) % 3 > 0, 0.05, np.nan), rtol=1e-6)
    np.testing.assert_array_equal(unpacked(surface["colour"], "u1"), np.arange(3 * count).astype(np.uint8))
    assert clicked(full_report)["layers"] == ["its colours", "shaded", *layers]  # its colours, or else clay, come first
    numbers = [(one["text"], one["title"]) for one in surface["devices"][0]["labels"]]
    assert numbers == [(str(k + 1), f"camera of frame {k + 1}: frame_0000{k}") for k in range(3)]  # among the captures


def test_points_are_where_a_frame_decoded_them(full_report: str, scan: Scan) -> None:
    (surface,), moved = scene_of(full_report)["groups"], moved_poses()
    points = unpacked(surface["points"], columns=3) + surface["origin"]
    frame, uv = unpacked(surface["frame"], "<i2"), unpacked(surface["uv"], columns=2)
    assert surface["names"] == [one.name for one in scan.frames] and (frame >= 0).mean() > 0.3
    for k, one in enumerate(scan.frames):
        seen = frame == k
        pixel, inside = world_pixels(one.camera, moved.T_world_camera[k], points[seen])
        assert inside.all()
        np.testing.assert_allclose(uv[seen], pixel, atol=1e-2)
        column, row = np.floor(pixel).astype(int).T
        assert np.isfinite(one.read_coords()[row, column]).all()


@pytest.mark.parametrize("with_points", [False, True])
def test_report_without_truth_training_or_refinement_says_so(scan: Scan, with_points: bool) -> None:
    thumbnails = ResidualThumbnails()
    points = PointReference(IndexedMesh(TRUTH).sample(5000, 0)[0], "some points") if with_points else None
    evaluation = evaluate(TRUTH, scan, scan.poses, points, samples=5000, on_frame=thumbnails)
    inputs = EvaluationInputs(TRUTH, scan, scan.poses, None, points, None)
    text = text_of(render_report(ReportInput(evaluation, judge(evaluation), inputs, thumbnails.frames, "mesh.ply")))
    assert "The scan's own poses were evaluated" in text
    assert "There is no training.json next to the poses file" in text
    assert with_points or "Accuracy" not in text
    assert ("No truth or reference is known for this scan" in text) == (not with_points)
    assert ("Distance from reference" in text and "some points" in text) == with_points


def test_offsets_from_reference_points_are_smooth_and_signed() -> None:
    truth, result = IndexedMesh(sphere(10.0, 100)), IndexedMesh(sphere(10.25, 100))
    reference = PointReference(truth.sample(3000, 0)[0], "")
    errors = reference.surface_errors(result, Similarity.identity(), result.sample(500, 1)[0])
    np.testing.assert_allclose(errors, 0.25, atol=0.02)


def test_picture_shows_the_near_side_upright_and_in_colour() -> None:
    surface = IndexedMesh(sphere(10.0, 40))
    red_top = np.where(surface.vertices[:, 2:] > 0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    view = OrthographicView(np.array([0.0, -1, 0]), np.array([0.0, 0, 1]))
    picture = render(surface, view, red_top, height=60, width=80)
    assert picture.shape == (60, 80, 3)
    np.testing.assert_array_equal(picture[0, 0], 1.0)  # white outside
    assert picture[15, 40, 0] > 0.3 and picture[15, 40, 2] < 0.05
    assert picture[45, 40, 2] > 0.15 and picture[45, 40, 0] < 0.05
    inside = (picture != 1).any(2)
    assert inside.sum() == pytest.approx(np.pi * (0.47 * 60) ** 2, rel=0.05)


def test_decimation_keeps_the_shape() -> None:
    mesh = blob(120)
    small, nearest = decimated(mesh, 2000)
    assert len(small.faces) <= 2000 and len(nearest) == len(small.vertices)
    assert IndexedMesh(mesh).distance(small.vertices).max() < 0.01
    assert np.linalg.norm(mesh.vertices[nearest] - small.vertices, axis=1).max() < 0.1
    same, index = decimated(blob(8), 2000)
    assert same.faces.shape == blob(8).faces.shape and index[-1] == len(blob(8).vertices) - 1


FRAME = FrameAgreement("f", 1000, 1.0, 1.0, 0.9, 0.35, 1.0, 0.2, 0.95, 0.5, 20.0, 0.99, 0.97, 0.001, 0.0)


def picture(address: str) -> np.ndarray:
    assert address.startswith("data:image/webp;base64,")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB"), dtype=float) / 255


def agreement_of(scan, cosines: list[float]) -> CaptureAgreement:
    frames = tuple(replace(FRAME, name=f.name, pattern_cosine=c) for f, c in zip(scan.frames, cosines, strict=True))
    return CaptureAgreement(0.35, 1.0, 0.2, 0.95, 1.0, 0.5, 20.0, frames)


def test_the_best_the_median_and_the_worst_frame_are_compared(scan: Scan) -> None:
    surface, nan = IndexedMesh(TRUTH), float("nan")
    found = compare_frames(surface, scan, agreement_of(scan, [0.5, 0.9, 0.1]), scan.poses)
    assert [(c.name[-1], c.why, c.cosine) for c in found] == [
        ("1", "best agreement", 0.9), ("0", "median", 0.5), ("2", "worst agreement", 0.1),
    ]  # fmt: skip
    for one in found:
        captured, rendered, difference = (picture(a) for a in (one.captured, one.rendered, one.difference))
        assert captured.shape == rendered.shape == difference.shape
        grey = (np.ptp(captured, axis=2) < 0.05) & (np.ptp(rendered, axis=2) < 0.05)  # blue: no surface
        assert grey.mean() > 0.95 and np.abs(captured - rendered)[grey].mean() < 0.05
        assert np.ptp(difference[grey], axis=-1).mean() < 0.15  # nearly white: no difference
    only = compare_frames(surface, scan, agreement_of(scan, [nan, 0.4, nan]), scan.poses)
    assert [c.name for c in only] == ["frame_00001"]


def test_thumbnails_show_every_frame_in_order(scan: Scan) -> None:
    thumbnails = ResidualThumbnails()
    evaluate(TRUTH, scan, scan.poses, on_frame=thumbnails)
    assert [f.name for f in thumbnails.frames] == [f.name for f in scan.frames]
    for frame in thumbnails.frames:
        assert all(max(picture(a).shape) <= 150 for a in (frame.coordinate, frame.epipolar, frame.pattern))
        assert picture(frame.coordinate).min() > 0.7  # pale yellow and white: no residual


def test_brightness_is_matched_in_least_squares() -> None:
    n, rendered = 50, np.random.default_rng(0).random(50)
    flags, ones, pairs = np.ones(n, dtype=bool), np.ones(n), np.ones((n, 2))
    pixels = FramePixels(
        row=np.arange(n), column=np.arange(n), stride=1, hit=flags, lit=np.arange(n) < 40, decoded=flags, coords=pairs,
        offset=pairs, epipolar=ones, captured=np.where(np.arange(n) < 40, 1.7 * rendered, 9.0), rendered=rendered,
        depth_per_px=ones, ray_angle_deg=ones, behind=ones, noise_px=0.1, footprint_px=1.0,
    )  # fmt: skip
    assert brightness_ratio(pixels) == pytest.approx(1.7)  # unlit pixels do not count
    assert brightness_ratio(replace(pixels, lit=~flags)) == 1.0


def test_the_overlap_graph_is_a_drawing_with_every_frame_and_edge() -> None:
    names = ["a", "b & c", "<d>"]
    edges = [EdgeRecord(("a", "b & c"), 0.5, 0.9, True, False)]
    edges += [EdgeRecord(("a", other), 0.1, 0.2, False, False) for other in ("<d>", "gone")]
    svg = ElementTree.fromstring(draw_overlaps([FrameRecord(name, name != "<d>") for name in names], edges))
    lines, circles = svg.findall("line"), svg.findall("g/circle")
    assert len(lines) == 2 and [title.text for title in svg.findall("g/title")] == names
    assert [line.get("stroke-dasharray") is not None for line in lines] == [True, False]  # rejected ones are below
    assert float(lines[1].get("stroke-width", 0)) > float(lines[0].get("stroke-width", 0))
    assert "overlap 50%, agreement 90%" in (lines[1].findtext("title") or "")
    ends = {(line.get(f"x{k}"), line.get(f"y{k}")) for line in lines for k in (1, 2)}
    assert ends == {(circle.get("cx"), circle.get("cy")) for circle in circles} and len(circles) == 3


BETTER = IntrinsicsChange(DeviceChange(0.02, 0.0, 0.0), DeviceChange(0.0, -0.01, 0.0))
SIGMA = IntrinsicsChange.of([0.002] * 6)


def record(change: IntrinsicsChange, contradicts: bool | None) -> dict[str, Any]:
    found = {"change": asdict(BETTER), "sigma": asdict(SIGMA), "chi_square": 87.4, "contradicts": contradicts}
    return {"intrinsics": {"change": asdict(change), "self_calibration": None if contradicts is None else found}}


@pytest.mark.parametrize("training", [None, {}, record(UNCHANGED, None), record(UNCHANGED, False)])
def test_nothing_is_said_where_nothing_is_known_or_wrong(scan: Scan, training: dict[str, Any] | None) -> None:
    assert intrinsics_hint(training, scan) == ""


def test_a_contradiction_is_given_in_percent_and_pixels(scan: Scan) -> None:
    text = intrinsics_hint(record(UNCHANGED, True), scan)
    assert "chi square 87" in text and "--pipeline.model.refine-intrinsics True" in text
    assert "camera: focal length +2.00 ± 0.20 %, principal point (+0.0 ± 0.3, +0.0 ± 0.3) px" in text  # of f = 150
    assert "projector: focal length +0.00 ± 0.20 %, principal point (-1.9 ± 0.4, +0.0 ± 0.4) px" in text  # of f = 190
    assert "are not those of the scan folder" not in text


TEMPLATES = Path(report.__file__).parent / "templates"


def test_pages_have_one_style_in_which_nothing_is_wider_than_a_narrow_screen() -> None:
    pages = [text for path in TEMPLATES.glob("*.html.j2") if "<body>" in (text := path.read_text())]
    assert len(pages) == 3
    assert all("parts.head(" in text or '{% include "style.css.j2" %}\n</style>' in text for text in pages)
    narrow = (TEMPLATES / "style.css.j2").read_text().partition("@media screen and (max-width: 760px)")[2]
    for rule in ("table { display: block; overflow-x: auto; }", ".frames { grid-template-columns: minmax(0, 1fr); }"):
        assert rule in narrow
