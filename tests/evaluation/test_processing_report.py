"""The report of sl-process shows every frame, and needs no network."""

import re
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.evaluation.report.processing_report import render_processing_report
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.preview import Preview, make_preview
from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord, ProcessResult
from sl_nerfstudio.verdict.verdict import Verdict

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
    lost = FrameRecord("d", False, "decoding", "d.png: is <black>\n    cause:  dark\n    remedy: light")
    frames = (FrameRecord("a<b", True, "", "", **GOOD), FrameRecord("c", True, "", "", **GOOD), lost)
    image = np.zeros((30, 40), dtype=np.uint8)
    coords = np.full((30, 40, 2), 100, dtype=np.float32)
    previews = [make_preview(image, coords, (800, 800)), Preview(None, None), make_preview(image, None, (800, 800))]
    page = render_processing_report(_result(frames, recapture=("d: capture it again",)), previews)
    assert "a&lt;b" in page and "a<b" not in page and "is &lt;black&gt;" in page
    assert (
        "2 of 3 frames are in the scan; 1 was left out; its lengths are in mm, known from: baseline of frame 0" in page
    )
    assert "d: capture it again" in page and "no: decoding" in page and "remedy: light" in page
    assert page.count("data:image/webp") == 3
    assert "84.500" in page and "93 %" in page and "0.31 px" in page and "1.50 px before and 0.40 px after" in page
    assert 'aria-label="Overlap graph"' in page and "stroke-dasharray" in page
    assert not re.search(r"(src|href)=\"?https?:", page) and "<script" not in page


@pytest.mark.parametrize("band", ["good", "acceptable", "poor"])
def test_the_verdict_and_its_reasons_come_first(band):
    reasons = () if band == "good" else ("c: contradicts <the others>", "d: undecided")
    frames = tuple(FrameRecord(name, True, "", "", **GOOD, undecided=name == "d") for name in "cd")
    page = render_processing_report(_result(frames, verdict=Verdict(band, reasons)), [Preview(None, None)] * 2)
    assert f'<div class="verdict {band}"><strong>{band.capitalize()}</strong>' in page
    assert ("<li>c: contradicts &lt;the others&gt;</li><li>d: undecided</li>" in page) == (band != "good")
    assert page.index("<strong>") < page.index("What to capture again")
    assert "<td>undecided</td>" in page and "0.83 px" in page and "97 %" in page
    assert "half lie within 0.20 px and 95 % within 0.80 px" in page


def test_a_report_without_any_good_frame_can_be_made():
    frames = (FrameRecord("a", False, "reading", "x"), FrameRecord("b", False, "decoding", "y"))
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
    assert max(preview.image.shape) <= 170 and preview.image.max() == pytest.approx(1)
    assert np.allclose(preview.coords[0, 0], (1, 0.35, 0)) and np.allclose(preview.coords[-1, 0], 0.85)
