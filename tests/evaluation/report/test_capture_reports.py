"""The report of sl-process shows every frame, and needs no network."""

import re
import shlex
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.evaluation.report.capture_reports import captures_of, render_processing_report
from sl_nerfstudio.evaluation.report.view3d import placed_surface
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.triangulation import world_pixels
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.object_only import Preview, make_preview
from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord, ProcessRecord, ProcessResult, read_record
from sl_nerfstudio.processing.scan_poses import PlacedFrame, PlacedGroup
from sl_nerfstudio.registration.result import parse_known_length
from sl_nerfstudio.review.verdict import Verdict
from sl_nerfstudio.scan.document import FileError
from sl_nerfstudio.scan.write import encode_json

from .pages import Page, clicked, scene_of, unpacked

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
    said = "2 of 3 frames are in the scan; 1 was left out; its lengths are in mm, known from: baseline of frame 0"
    assert said in page
    assert '<a href="#frame-2">d</a>: capture it again' in page and "no: decoding" in page and "remedy: light" in page
    assert page.count("data:image/webp") == 3
    assert "84.500" in page and "93 %" in page and ">0.31</td>" in page and "1.50 px before and 0.40 px after" in page
    assert 'aria-label="Overlap graph"' in page and "stroke-dasharray" in page
    assert not re.search(r"(src|href)=\"?https?:", page) and "default-src 'none'" in page  # the browser enforces it
    assert 'id="view"' not in page and 'id="scene"' not in page  # nothing was placed
    assert page.index('id="frame-2"') < page.index('<div class="folded">') < page.index('id="frame-0"')  # the lost one


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
    assert page.index('<section class="hero">') < page.index("<strong>") < page.index('<section id="not-good">')
    assert Page(page).unfolded == {"figures": True, "overlaps": False, "frames": False, "settings": False}
    alike = tuple(FrameRecord(name, **GOOD) for name in "cd")
    well = render_processing_report(_result(alike), [Preview(None, None)] * 2)
    assert not any(Page(well).unfolded.values()) and "nothing to capture again" in well
    assert "<td>undecided</td>" in page and ">0.83</td>" in page and "97 %" in page
    assert "half lie within 0.20 px and 95 % within 0.80 px" in page


def test_a_report_without_any_good_frame_can_be_made():
    frames = tuple(FrameRecord(stage, False, stage=stage, reason="x") for stage in ("reading", "decoding"))
    unknown = _result(frames, edges=(), joint_px=None, cross_px=None, scale_source="", units="arbitrary")
    page = render_processing_report(unknown, [Preview(None, None)] * 2)
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
    p = np.random.default_rng(points).normal(size=(points, 3)) * 0.3
    p = (p / np.linalg.norm(p, axis=1, keepdims=True)).astype(np.float32) if points > 100 else p.astype(np.float32)
    return PlacedFrame(name, CAMERA, PROJECTOR, T, T_projector, p, world_pixels(CAMERA, T, p)[0])


def _scene_page(**changes):
    """Frames a to e: a, b, c are the scan, b undecided and not connected with c; d and e are a group."""
    frames = tuple(
        FrameRecord(n, n in "abc", **{**GOOD, "component": 0 if n in "abc" else 1}, undecided=n == "b") for n in "abcde"
    )
    groups = (
        PlacedGroup(0, (_placed("a", 0.0), _placed("b", 0.5), _placed("c", 1.5))),
        PlacedGroup(1, (_placed("d", 0.0), _placed("e", 0.3))),
        PlacedGroup(-1, (_placed("f", 0.0, points=0),)),
    )
    lost, edge = FrameRecord("f", False, stage="registering", reason="r"), EdgeRecord(("a", "b"), 0.5, 0.9, True, False)
    return _result((*frames, lost), edges=(edge,), placed=groups, **changes)


def _apexes(devices, group):
    """The centres of projection of drawn devices: the first point of each pyramid's thirteen lines."""
    return unpacked(devices["lines"], columns=3).reshape(-1, 26, 3)[:, 0] + group["origin"]


def test_the_view_shows_every_group_with_devices_where_they_are():
    scene = scene_of(render_processing_report(_scene_page(), [Preview(None, None)] * 6))
    assert [group["name"] for group in scene["groups"]] == ["the scan: 3 frames", "group 1: 2 frames", "f by itself"]
    first, lone = scene["groups"][0], scene["groups"][2]
    cameras, undecided, projectors, also_undecided, added = first["devices"]
    at = {n: 5 * np.array([np.sin(t), 0, np.cos(t)]) for n, t in (("a", 0.0), ("b", 0.5), ("c", 1.5))}
    np.testing.assert_allclose(_apexes(cameras, first), [at["a"], at["c"]], atol=1e-5)
    np.testing.assert_allclose(_apexes(undecided, first), [at["b"]], atol=1e-5)
    beside = at["b"] + 0.5 * np.array([np.cos(0.5), 0, -np.sin(0.5)])
    np.testing.assert_allclose(_apexes(also_undecided, first), [beside], atol=1e-5)
    assert undecided["rgb"] == also_undecided["rgb"] not in (cameras["rgb"], projectors["rgb"])
    assert [(one["text"], one["title"]) for one in cameras["labels"]] == [
        ("0", "camera of frame 0: a"), ("2", "camera of frame 2: c"),
    ]  # fmt: skip
    np.testing.assert_allclose([one["at"] + np.array(first["origin"]) for one in cameras["labels"]], [at["a"], at["c"]])
    points = np.concatenate([f.points for f in _scene_page().placed[0].frames]).astype(float)
    np.testing.assert_allclose(unpacked(first["points"], columns=3) + first["origin"], points, atol=1e-5)
    centre = np.median(points, axis=0)
    away = [at["b"] - centre, at["c"] - centre]
    lengths = [np.linalg.norm(v) for v in away]
    between = away[0] / lengths[0] + away[1] / lengths[1]
    apex = _apexes(added, first)[0]
    np.testing.assert_allclose(apex - centre, np.mean(lengths) * between / np.linalg.norm(between), atol=1e-4)
    assert added["labels"][0]["title"] == "add a frame here, between b and c"
    assert unpacked(lone["frame"], "<i2").tolist() == [-1]  # nothing of the object: only the devices


def test_unordered_captures_have_no_neighbours_between_which_to_add():
    config = ProcessConfig(Path("i"), Path("p"), Path("c"), Path("scan"), unordered=True)
    scene = scene_of(render_processing_report(_scene_page(config=config), [Preview(None, None)] * 6))
    assert len(scene["groups"][0]["devices"]) == 4


def test_discs_lie_in_the_surface_and_face_the_camera_that_saw_them():
    group = PlacedGroup(0, (_placed("a", 0.0, 900), _placed("b", 0.5, 700)))  # points of a unit sphere
    surface = placed_surface(group, {"a": 0, "b": 4})
    eyes = np.array([frame.T_world_camera[:3, 3] for frame in group.frames])[surface.frame]
    np.testing.assert_allclose(np.abs((surface.normals * surface.points).sum(1)), 1, atol=0.05)
    assert ((eyes - surface.points) * surface.normals).sum(1).min() > 0
    assert 1 < surface.radius / (4 * np.pi / 1600) ** 0.5 < 3  # they cover it, and not much more
    assert set(surface.layers[0].values) == {0.0, 4.0}
    many = PlacedGroup(0, tuple(_placed(str(k), 0.1 * k, 10_000) for k in range(13)))
    assert 40_000 < len(placed_surface(many, {str(k): k for k in range(13)}).points) <= 60_000  # a page stays small


@pytest.mark.parametrize("name", ["b", "it's $5 (new)"])
def test_two_clicks_state_a_known_length_that_sl_process_understands(name):
    """On a sphere before two cameras; `name` is of the second frame, which alone has points on the right."""
    first, second = _placed("a", 0.0, 900), _placed(name, 0.3, 900)
    left, right = first.points[:, 0] < 0, second.points[:, 0] >= 0
    placed = PlacedGroup(0, (
        replace(first, points=first.points[left], uv_camera=first.uv_camera[left]),
        replace(second, points=second.points[right], uv_camera=second.uv_camera[right]),
    ))  # fmt: skip
    frames = (FrameRecord("a", **GOOD), FrameRecord(name, **GOOD))
    page = render_processing_report(_result(frames, edges=(), placed=(placed,)), [Preview(None, None)] * 2)
    assert "Click two points" in clicked(page)["said"] and not clicked(page, (0.27, 0.5))["known"]
    assert clicked(page, (0.02, 0.5))["said"] == clicked(page)["said"]  # beside the object
    found = clicked(page, (0.27, 0.5), (0.73, 0.5))
    assert found["known"] and found["layers"] == ["shaded", "frames"]
    flag, text = shlex.split(found["flag"])
    known = parse_known_length(text)
    assert (flag, known.unit, set(known.frames)) == ("--known-length", "mm", {"a", name})
    assert known.metres == pytest.approx(0.0755)
    ends = []
    for frame, pixel in zip(known.frames, known.pixels, strict=True):
        one = placed.frames[frame == name]
        off = np.abs(one.uv_camera - pixel).max(1)
        near = np.flatnonzero(off < 0.051)  # said to a tenth of a pixel; the same pixel sees the far side, too
        ends.append(one.points[near].astype(float))
    said = float(re.search(r"Distance: ([\d.]+) mm", found["said"])[1])
    lengths = np.linalg.norm(ends[0][:, None] - ends[1], axis=-1)
    assert np.abs(lengths / said - 1).min() < 1e-3


def test_another_report_has_the_captures_that_need_a_look_with_their_pictures(tmp_path):
    lost = FrameRecord("d & <e>", False, stage="decoding", reason="is black\n    cause:  dark\n    remedy: light")
    weak = FrameRecord("c", **{**GOOD, "degeneracies": ("flat",)})
    result = _result((FrameRecord("a<b", **GOOD), weak, lost), recapture=("c: decoded badly", "between a<b and c: add"))
    preview = make_preview(np.zeros((30, 40), np.uint8), None, (8, 8))
    (tmp_path / "processing.json").write_bytes(encode_json(result.document()))
    record = read_record(tmp_path / "processing.json")
    assert record == ProcessRecord(**{one.name: getattr(result, one.name) for one in fields(ProcessRecord)})
    report = tmp_path / "processing.html"
    assert [row.image for row in captures_of(record, report).bad] == ["", ""]
    report.write_text(render_processing_report(result, [preview] * 3))
    found = captures_of(record, report)
    assert [row.record.name for row in found.bad] == ["c", "d & <e>"] and found.good == []
    assert all(row.image.startswith("data:image/webp") for row in found.bad)


@pytest.mark.parametrize("change", [{"frames": 3}, {"overlaps": [{}]}, {"cross_frame_px": [1]}, {"verdict": None}])
def test_a_damaged_record_is_refused(tmp_path, change):
    document = _result((FrameRecord("a", **GOOD),)).document() | change
    if change == {"verdict": None}:
        del document["verdict"]
    (tmp_path / "processing.json").write_bytes(encode_json(document))
    said = r"processing\.json: is not what sl-process writes(.|\n)*run the same sl-process"
    with pytest.raises(FileError, match=said):
        read_record(tmp_path / "processing.json")


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
