"""The report of sl-process shows every frame, and needs no network."""

import re
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.evaluation.report.capture_reports import render_processing_report
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.object_only import Preview, make_preview
from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord, ProcessResult
from sl_nerfstudio.processing.scan_poses import PlacedFrame, PlacedGroup
from sl_nerfstudio.review.verdict import Verdict

from .pages import Page, figure_of, unpacked

CONFIG = ProcessConfig(Path("captures & more"), Path("pattern.json"), Path("intrinsics.json"), Path("scan"))
GOOD = {"decode_rate": 0.93, "mask_share": 0.4, "epipolar_px": 0.31, "relative_sigma_rotation_deg": 0.12,
        "relative_sigma_direction_deg": 0.25, "sigma_rotation_deg": 0.04, "cross_share": 0.97, "cross_px_p95": 0.83,
        "cross_px_median": 0.21, "component": 0, "fitness": 0.9, "baseline": 84.5}  # fmt: skip


def _result(frames, **changes):
    edges = (EdgeRecord(("a<b", "c"), 0.5, 0.9, True, False), EdgeRecord(("c", "d"), 0.2, 0.5, False, True))
    values = {"config": CONFIG, "decoder": "network", "units": "mm", "scale_source": "baseline of frame 0",
              "frames": frames, "edges": edges, "remarks": (), "recapture": (), "joint_px": (1.5, 0.4),
              "cross_px": (0.2, 0.8),
              "verdict": Verdict("good", ()), "versions": {"torch": "2"}, **changes}  # fmt: skip
    return ProcessResult(**values)


def test_everything_is_shown_and_escaped():
    lost = FrameRecord("d", False, stage="decoding", reason="d.png: is <black>\n    cause:  dark\n    remedy: light")
    frames = (FrameRecord("a<b", **GOOD), FrameRecord("c", **GOOD), lost)
    image = np.zeros((30, 40), dtype=np.uint8)
    coords = np.full((30, 40, 2), 100, dtype=np.float32)
    previews = [make_preview(image, coords, (800, 800)), Preview(None, None), make_preview(image, None, (800, 800))]
    page = render_processing_report(_result(frames, recapture=("d: capture it again",)), previews)
    assert "a&lt;b" in page and "a<b" not in page and "is &lt;black&gt;" in page
    assert (
        "2 of 3 frames are in the scan; 1 was left out; its lengths are in mm, known from: baseline of frame 0" in page
    )
    assert '<a href="#frame-2">d</a>: capture it again' in page and "no: decoding" in page and "remedy: light" in page
    assert page.count("data:image/webp") == 3
    assert "84.500" in page and "93 %" in page and ">0.31</td>" in page and "1.50 px before and 0.40 px after" in page
    assert 'aria-label="Overlap graph"' in page and "stroke-dasharray" in page
    assert not re.search(r"(src|href)=\"?https?:", page) and "default-src 'none'" in page  # the browser enforces it
    assert 'id="plot"' not in page and 'id="plotly"' not in page  # nothing was placed


@pytest.mark.parametrize("band", ["good", "acceptable", "poor"])
def test_the_verdict_and_its_reasons_come_first(band):
    reasons = () if band == "good" else ("c: contradicts <the others>", "d: undecided")
    frames = tuple(FrameRecord(name, **GOOD, undecided=name == "d") for name in "cd")
    page = render_processing_report(_result(frames, verdict=Verdict(band, reasons)), [Preview(None, None)] * 2)
    assert f'<div class="verdict {band}"><strong>{band.capitalize()}</strong>' in page
    linked = (
        '<li><a href="#frame-0">c</a>: contradicts &lt;the others&gt;</li><li><a href="#frame-1">d</a>: undecided</li>'
    )
    assert (linked in page) == (band != "good")
    assert page.index("<strong>") < page.index('<section id="recapture">')
    assert "<td>undecided</td>" in page and ">0.83</td>" in page and "97 %" in page
    assert "half lie within 0.20 px and 95 % within 0.80 px" in page


def test_a_report_without_any_good_frame_can_be_made():
    frames = (
        FrameRecord("a", False, stage="reading", reason="x"),
        FrameRecord("b", False, stage="decoding", reason="y"),
    )
    page = render_processing_report(
        _result(frames, edges=(), joint_px=None, cross_px=None, scale_source="", units="arbitrary"),
        [Preview(None, None)] * 2,
    )
    assert "0 of 2 frames are in the scan: no scan could be written" in page


def test_previews_are_small_and_show_what_is_missing():
    coords = np.full((400, 600, 2), np.nan, dtype=np.float32)
    coords[:200] = (800, 0)
    preview = make_preview(np.full((400, 600, 3), 2**15, dtype=np.uint16), coords, (800, 800))
    assert preview.image is not None and preview.coords is not None
    assert max(preview.image.shape) == 600 and preview.image.max() == pytest.approx(1)
    assert np.allclose(preview.coords[0, 0], (1, 0.35, 0)) and np.allclose(preview.coords[-1, 0], 0.85)
    large = np.zeros((3000, 4000), np.uint8)
    sides = [max(make_preview(large, None, (8, 8), frames=n).image.shape) for n in (1, 30, 120, 10_000)]
    assert sides[0] == sides[1] and 500 < sides[0] <= 640 and 250 < sides[2] <= 320 and 150 < sides[3] <= 200


CAMERA = Device(w=64, h=48, fl_x=80.0, fl_y=82.0, cx=30.0, cy=25.0)
PROJECTOR = Device(w=60, h=60, fl_x=90.0, fl_y=90.0, cx=30.0, cy=30.0)


def _placed(name, angle, points=5):
    """A camera on a circle of radius 5 about the origin, looking at it; its projector stands 0.5 to the right."""
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[:3, 3] = 5 * T[:3, 2]
    T_projector = T.copy()
    T_projector[:3, 3] += 0.5 * T[:3, 0]
    p = np.random.default_rng(0).normal(size=(points, 3)).astype(np.float32) * 0.3
    return PlacedFrame(name, CAMERA, PROJECTOR, T, T_projector, p, np.zeros((points, 2)))


def _scene_page(**changes):
    """Frames a to e: a, b, c are the scan, b undecided and not connected with c; d and e are a group."""
    names = "abcde"
    frames = tuple(
        FrameRecord(n, n in "abc", **{**GOOD, "component": 0 if n in "abc" else 1}, undecided=n == "b") for n in names
    )
    groups = (
        PlacedGroup(0, (_placed("a", 0.0), _placed("b", 0.5), _placed("c", 1.5))),
        PlacedGroup(1, (_placed("d", 0.0), _placed("e", 0.3))),
        PlacedGroup(-1, (_placed("f", 0.0, points=0),)),
    )
    edges = (EdgeRecord(("a", "b"), 0.5, 0.9, True, False),)
    return _result(
        (*frames, FrameRecord("f", False, stage="registering", reason="r")), edges=edges, placed=groups, **changes
    )


def test_the_view_shows_every_group_with_devices_where_they_are():
    page = render_processing_report(_scene_page(), [Preview(None, None)] * 6)
    figure = figure_of(page)
    menu, _ = figure["layout"]["updatemenus"]
    assert [b["label"] for b in menu["buttons"]] == ["the scan: 3 frames", "group 1: 2 frames", "f by itself"]
    names = [trace["name"] for trace in figure["data"]]
    first = [
        "surface of each frame",
        "cameras",
        "projectors",
        "undecided frames",
        "add a frame here",
        "numbers of frames",
    ]
    assert names[: len(first)] == first
    assert [trace["visible"] for trace in figure["data"]] == [True] * 6 + [False] * (len(names) - 6)
    for k, button in enumerate(menu["buttons"]):  # each shows its own traces alone
        shown = np.array(button["args"][0]["visible"])
        assert shown.sum() == (6, 4, 4)[k] and shown.argmax() == (0, 6, 10)[k]
        assert {"scene.camera", "scene.xaxis", "scene.aspectratio"} <= set(button["args"][1])
    expected = {"cameras": ["a", "c"], "undecided frames": ["b", "b"]}
    for name, wanted in expected.items():
        trace = figure["data"][names.index(name)]
        apex = np.stack([unpacked(trace[axis]) for axis in "xyz"], 1).reshape(len(wanted), -1, 3)[:, 0]
        angle = {"a": 0.0, "b": 0.5, "c": 1.5}
        centre = [5 * np.array([np.sin(angle[n]), 0, np.cos(angle[n])]) for n in wanted]
        if name == "undecided frames":  # its camera, then its projector
            centre[1] = centre[1] + 0.5 * np.array([np.cos(0.5), 0, -np.sin(0.5)])
        np.testing.assert_allclose(apex, centre, atol=1e-5)
    added = figure["data"][names.index("add a frame here")]
    apex = np.array([unpacked(added[axis])[0] for axis in "xyz"])
    points = np.concatenate([g.points for g in _scene_page().placed[0].frames]).astype(float)
    centre = np.median(points, axis=0)
    away = [5 * np.array([np.sin(t), 0, np.cos(t)]) - centre for t in (0.5, 1.5)]
    lengths = [np.linalg.norm(v) for v in away]
    between = away[0] / lengths[0] + away[1] / lengths[1]
    np.testing.assert_allclose(apex - centre, np.mean(lengths) * between / np.linalg.norm(between), atol=1e-4)
    assert added["line"]["dash"] == "dash" and added["text"][0] == "add a frame here, between b and c"


def test_unordered_captures_have_no_neighbours_between_which_to_add():
    config = ProcessConfig(Path("i"), Path("p"), Path("c"), Path("scan"), unordered=True)
    page = render_processing_report(_scene_page(config=config), [Preview(None, None)] * 6)
    assert "add a frame here" not in [trace["name"] for trace in figure_of(page)["data"]]


def test_links_lead_to_frames_and_pictures_can_be_enlarged():
    preview = make_preview(np.zeros((30, 40), np.uint8), np.zeros((30, 40, 2), np.float32), (8, 8))
    lines = ("b, c: add <views>", "between a and b: a frame")
    page = render_processing_report(_scene_page(recapture=lines), [preview] * 6)
    assert '<li><a href="#frame-1">b</a>, <a href="#frame-2">c</a>: add &lt;views&gt;</li>' in page
    assert '<li>between <a href="#frame-0">a</a> and <a href="#frame-1">b</a>: a frame</li>' in page
    parsed = Page(page)
    assert set(parsed.anchors) <= set(parsed.ids) and len(parsed.ids) == len(set(parsed.ids))
    assert page.count('<button type="button" aria-label=') == 12 and 'dialog id="large"' in page
    assert re.search(r'<div class="scroll"><table>\s*<caption>Captures are counted', page)  # never wider than the page
    assert page.count('fill="#f7dc8f"') == 1 and page.count('fill="#f6c7c2"') == 3  # in the overlap graph
    assert page.count('class="frame undecided"') == 1 and page.count('class="frame out"') == 3
