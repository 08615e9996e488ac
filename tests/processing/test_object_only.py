"""--object-only: what is in the scan, in the report, in processing.json, and in words."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.evaluation.report.capture_reports import render_processing_report
from sl_nerfstudio.object_separation.planes import Plane, PlaneFinding
from sl_nerfstudio.object_separation.separate import Part
from sl_nerfstudio.processing.object_only import (
    FrameShares,
    ObjectOnly,
    make_preview,
    object_document,
    object_sentences,
)
from sl_nerfstudio.processing.process import process
from sl_nerfstudio.processing.result import without_empty
from sl_nerfstudio.scan import check_scan, read_scan
from sl_nerfstudio.scan.types import PickedPixel, Scale, ScaleBar
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import make_setup
from tests.processing.conftest import register_ramps
from tests.processing.ramp_scan import NAMES, make_captures


def finding(verdict):
    plane = Plane(np.array([0.0, 0.0, 1.0]), 2.0)
    return PlaneFinding(plane, 0.6, verdict)


@pytest.fixture
def object_only() -> ObjectOnly:
    table, side = finding("leaves the views"), finding("surface behind it")
    first = np.full((4, 6), Part.PLANE, np.uint8)
    first[1:3, 2:5] = Part.OBJECT
    second = np.full((4, 6), Part.BEYOND, np.uint8)
    shares = (FrameShares("a", 0.25, 0.75, 0.0), FrameShares("b", 0.0, 0.0, 1.0))
    return ObjectOnly((table, side), (table,), shares, {"a": first, "b": second})


@pytest.fixture(scope="module")
def on_a_table(tmp_path_factory):
    """Captures of a head on a table, and where each frame shows the head."""
    setup = make_setup(SynthConfig(scene="head", frames=22, resolution=130, seed=3, background="table"))
    rendered = [setup.render(k, 1) for k in range(len(NAMES))]
    captures = make_captures(tmp_path_factory.mktemp("table"), setup, [r.coords for r in rendered])
    return captures, {name: r.object_mask for name, r in zip(NAMES, rendered, strict=True)}


@pytest.fixture(scope="module")
def run(on_a_table, tmp_path_factory):
    captures, truth = on_a_table
    root = tmp_path_factory.mktemp("object_only")
    log = []
    with pytest.MonkeyPatch.context() as patch:
        register_ramps(patch)
        result = process(captures.config(root / "s", object_only=True), render_processing_report, log.append)
    return result, read_scan(root / "s"), truth, "\n".join(log)


@pytest.mark.slow
def test_the_scan_holds_the_object_and_the_report_shows_what_was_left_out(run):
    result, scan, truth, log = run
    assert result.registered == len(NAMES) and check_scan(scan.root) == []
    for frame in scan.frames:
        decoded = np.isfinite(frame.read_coords()).all(-1)
        is_object = truth[frame.name]
        assert (decoded & ~is_object).sum() < 0.01 * decoded.sum()
        assert (frame.read_mask() & is_object).sum() > 0.97 * (decoded | frame.read_mask())[is_object].sum()
        assert not (decoded & ~frame.read_mask()).any()
        assert not frame.read_pattern()[~frame.read_mask()].any()
    document = json.loads((scan.root / "processing.json").read_text())["object_only"]
    assert document["planes"][0]["left_out"] and document["planes_left_out"] > 0.3
    assert [frame["name"] for frame in document["frames"]] == list(NAMES)
    page = (scan.root / "processing.html").read_text()
    assert page.count('alt="What was left out of ') == len(NAMES) and "What was left out around the object" in page
    assert "object only: left out" in log and "plane with" in log


@pytest.mark.slow
def test_a_frame_that_shows_nothing_of_the_object_is_left_out_by_name(run, object_only):
    result = run[0]
    records = tuple(replace(result.frames[0], name=name) for name in "ab")
    found = without_empty(records, object_only)
    assert [frame.in_scan for frame in found] == [True, False]
    assert found[1].stage == "separating" and "shows nothing of the object" in found[1].reason
    assert object_only.empty_frames() == ("b",)


def test_a_known_length_in_what_was_left_out_keeps_only_its_unit(object_only):
    bare = Scale(True, "a ruler")
    for lost in (
        Scale(True, "a ruler", baseline_of="b"),
        Scale(True, "a ruler", bar=ScaleBar((PickedPixel("a", (3.5, 1.5)), PickedPixel("a", (0.5, 0.5))), 5.0)),
    ):
        assert object_only.usable_scale(lost) == bare
    for usable in (
        Scale(True, "a ruler", baseline_of="a"),
        Scale(True, "a ruler", bar=ScaleBar((PickedPixel("a", (3.5, 1.5)), PickedPixel("a", (4.5, 2.5))), 5.0)),
        Scale(False),
    ):
        assert object_only.usable_scale(usable) == usable


def test_what_was_left_out_is_tinted(object_only):
    image = np.full((4, 6), 200, np.uint8)
    shown = make_preview(image, None, (8, 8), object_only.parts["a"]).left_out
    kept = object_only.keeps("a")
    np.testing.assert_allclose(shown[kept], 1)
    assert (shown[~kept][:, 0] > shown[~kept][:, 1] + 0.3).all()
    assert make_preview(image, None, (8, 8)).left_out is None


def test_everything_that_was_left_out_and_kept_is_said(object_only):
    assert object_sentences(object_only) == (
        "left out 38% of the decoded pixels as planes around the object, and 50.0% as not connected to it; 12% show "
        "the object",
        "plane with 60% of the points left out: all cameras are in front of it, nothing is behind it, and it continues "
        "beyond the views",
        "plane with 60% of the points kept: there is surface behind it",
        "frames without any of the object, not in the scan: b",
    )


def test_the_document_has_planes_and_shares(object_only):
    document = json.loads(json.dumps(object_document(object_only)))
    assert [plane["left_out"] for plane in document["planes"]] == [True, False]
    assert document["planes"][0]["normal"] == [0, 0, 1] and document["planes"][0]["offset"] == 2
    assert (document["object"], document["planes_left_out"], document["beyond_left_out"]) == (0.125, 0.375, 0.5)
    assert document["frames"][0] == {"name": "a", "object": 0.25, "plane": 0.75, "beyond": 0.0}


@pytest.mark.slow
def test_without_the_flag_the_table_stays(on_a_table, ramps_registered, tmp_path):
    captures, truth = on_a_table
    result = process(captures.config(tmp_path / "s", no_adjust=True), render_processing_report, lambda _: None)
    assert result.object_only is None
    assert json.loads((tmp_path / "s" / "processing.json").read_text())["object_only"] is None
    frame = read_scan(tmp_path / "s").frames[0]
    assert (frame.read_mask() & ~truth[frame.name]).sum() > 500
    assert "left out around" not in (tmp_path / "s" / "processing.html").read_text()
