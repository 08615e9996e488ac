"""Comparisons, thumbnails, the overlap graph and the templates of the reports, one by one."""

import base64
import io
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import jinja2
import numpy as np
import pytest
from PIL import Image

from sl_nerfstudio.evaluation.agreement import CaptureAgreement, FrameAgreement, FramePixels
from sl_nerfstudio.evaluation.evaluate import evaluate
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.report.charts import draw_overlaps, page
from sl_nerfstudio.evaluation.report.scan_report import ResidualThumbnails, brightness_ratio, compare_frames
from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord
from sl_nerfstudio.scan import read_scan

from .faceted_scan import FacetedScan

FRAME = FrameAgreement("f", 1000, 1.0, 1.0, 0.9, 0.35, 1.0, 0.2, 0.95, 0.5, 20.0, 0.99, 0.97, 0.001, 0.0)


def picture(address: str) -> np.ndarray:
    assert address.startswith("data:image/webp;base64,")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB"), dtype=float) / 255


def agreement_of(scan, cosines: list[float]) -> CaptureAgreement:
    frames = tuple(replace(FRAME, name=f.name, pattern_cosine=c) for f, c in zip(scan.frames, cosines, strict=True))
    return CaptureAgreement(0.35, 1.0, 0.2, 0.95, 1.0, 0.5, 20.0, frames)


def test_the_best_the_median_and_the_worst_frame_are_compared(clean_scan: Path) -> None:
    scan, made = read_scan(clean_scan), FacetedScan()
    found = compare_frames(IndexedMesh(made.truth()), scan, agreement_of(scan, [0.5, 0.9, 0.1]), scan.poses)
    assert [(c.name, c.why, c.cosine) for c in found] == [
        ("frame_00001", "best agreement", 0.9),
        ("frame_00000", "median", 0.5),
        ("frame_00002", "worst agreement", 0.1),
    ]
    for one in found:
        captured, rendered, difference = (picture(a) for a in (one.captured, one.rendered, one.difference))
        assert captured.shape == rendered.shape == difference.shape
        grey = (np.ptp(captured, axis=2) < 0.05) & (np.ptp(rendered, axis=2) < 0.05)  # blue: no surface
        assert grey.mean() > 0.95 and np.abs(captured - rendered)[grey].mean() < 0.05
        assert np.ptp(difference[grey], axis=-1).mean() < 0.15  # nearly white: no difference


def test_frames_without_agreement_are_not_compared(clean_scan: Path) -> None:
    scan = read_scan(clean_scan)
    surface, nan = IndexedMesh(FacetedScan().truth()), float("nan")
    assert compare_frames(surface, scan, agreement_of(scan, [nan] * 3), scan.poses) == []
    only = compare_frames(surface, scan, agreement_of(scan, [nan, 0.4, nan]), scan.poses)
    assert [c.name for c in only] == ["frame_00001"]


def test_thumbnails_show_every_frame_in_order_and_colour_a_shift(clean_scan: Path) -> None:
    scan, made = read_scan(clean_scan), FacetedScan()
    thumbnails = ResidualThumbnails()
    evaluate(made.truth(), scan, scan.poses, on_frame=thumbnails)
    assert [f.name for f in thumbnails.frames] == [f.name for f in scan.frames]
    for frame in thumbnails.frames:
        assert all(max(picture(a).shape) <= 150 for a in (frame.coordinate, frame.epipolar, frame.pattern))
        assert picture(frame.coordinate).min() > 0.7  # pale yellow and white: no residual


def test_brightness_is_matched_in_least_squares() -> None:
    n = 50
    rendered = np.random.default_rng(0).random(n)
    flags = np.ones(n, dtype=bool)
    pixels = FramePixels(
        row=np.arange(n), column=np.arange(n), stride=1, hit=flags, lit=np.arange(n) < 40, decoded=flags,
        coords=np.zeros((n, 2)), offset=np.zeros((n, 2)), epipolar=np.zeros(n),
        captured=np.where(np.arange(n) < 40, 1.7 * rendered, 9.0),
        rendered=rendered, depth_per_px=np.ones(n), ray_angle_deg=np.ones(n), behind=np.zeros(n),
        noise_px=0.1, footprint_px=1.0,
    )  # fmt: skip
    assert brightness_ratio(pixels) == pytest.approx(1.7)  # unlit pixels do not count
    assert brightness_ratio(replace(pixels, lit=~flags)) == 1.0


def test_the_overlap_graph_is_a_drawing_with_every_frame_and_edge() -> None:
    names = ["a", "b & c", "<d>"]
    frames = [FrameRecord(name, name != "<d>") for name in names]
    edges = [
        EdgeRecord(("a", "b & c"), overlap=0.5, fitness=0.9, used=True, undecided=False),
        EdgeRecord(("a", "<d>"), overlap=0.1, fitness=0.2, used=False, undecided=False),
        EdgeRecord(("a", "gone"), overlap=0.1, fitness=0.2, used=False, undecided=False),
    ]
    svg = ElementTree.fromstring(draw_overlaps(frames, edges))
    assert svg.get("aria-label") == "Overlap graph"
    lines, circles = svg.findall("line"), svg.findall("g/circle")
    assert len(lines) == 2 and [title.text for title in svg.findall("g/title")] == names
    assert [line.get("stroke-dasharray") is not None for line in lines] == [True, False]  # rejected ones are below
    assert float(lines[1].get("stroke-width", 0)) > float(lines[0].get("stroke-width", 0))
    assert "overlap 50%, agreement 90%" in (lines[1].findtext("title") or "")
    assert circles[0].get("fill") == circles[1].get("fill") != circles[2].get("fill")
    places = {(circle.get("cx"), circle.get("cy")) for circle in circles}
    ends = {(line.get(f"x{k}"), line.get(f"y{k}")) for line in lines for k in (1, 2)}
    assert len(places) == 3 and ends == places


def test_a_template_with_an_unknown_value_raises() -> None:
    with pytest.raises(jinja2.UndefinedError):
        page("report.html.j2", {})


def test_both_templates_are_whole_pages() -> None:
    folder = Path(jinja2.PackageLoader("sl_nerfstudio.evaluation.report")._template_root)
    for name in ("report.html.j2", "processing.html.j2"):
        text = (folder / name).read_text(encoding="utf-8")
        assert text.startswith("<!DOCTYPE html>") and re.search(r"</body>\s*</html>\s*$", text)
