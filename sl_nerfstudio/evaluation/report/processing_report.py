"""The report of `sl-process`: what happened to every capture, as one HTML file that needs no network."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from sl_nerfstudio.evaluation.report import charts
from sl_nerfstudio.evaluation.report.overlap_graph import draw_overlaps
from sl_nerfstudio.evaluation.report.pages import page
from sl_nerfstudio.evaluation.report.pictures import data_uri
from sl_nerfstudio.evaluation.report.placed_figure import placed_figure
from sl_nerfstudio.evaluation.report.plot3d import compressed_script
from sl_nerfstudio.processing.advice import first_line, unconnected_neighbours
from sl_nerfstudio.processing.preview import Preview
from sl_nerfstudio.processing.projector.found import describe
from sl_nerfstudio.processing.result import FrameRecord, ProcessResult
from sl_nerfstudio.processing.selection.object_only import FrameShares
from sl_nerfstudio.processing.selection.object_words import object_sentences

_TEMPLATE = "processing.html.j2"
_WITHOUT_EFFECT = ("output", "work", "jobs")  # flags on which no result depends


@dataclass(frozen=True)
class FrameRow:
    """A frame with its pictures."""

    record: FrameRecord
    image: str  # data addresses; "" where there is no picture
    coords: str
    left_out: str
    shares: FrameShares | None  # of what was left out


def render_processing_report(result: ProcessResult, previews: Sequence[Preview]) -> str:
    """The page as text."""
    found = result.object_only
    shares = {} if found is None else {share.name: share for share in found.frames}
    rows = [
        FrameRow(record, *_pictures(preview), shares.get(record.name))
        for record, preview in zip(result.frames, previews, strict=True)
    ]
    values = {
        "result": result,
        "rows": rows,
        "verdict": result.verdict,
        "sentence": _sentence(result),
        "projector": "" if result.projector is None else describe(result.projector),
        "object_only": () if found is None else object_sentences(found),
        "charts": _charts(result),
        "overlaps": draw_overlaps(result.frames, result.edges) if result.edges else "",
        "settings": _settings(result),
        "figure": _figure(result),
        "groups": [len(group.frames) for group in result.placed],
        "plotly": compressed_script() if result.placed else "",
    }
    return page(_TEMPLATE, values, first_line=first_line, linked=_linker([f.name for f in result.frames]))


def _figure(result: ProcessResult) -> str:
    """The 3D view; "" if no frame was calibrated."""
    if not result.placed:
        return ""
    undecided = [f.name for f in result.frames if f.undecided]
    missing = [] if result.config.unordered else unconnected_neighbours(result.frames, result.edges)
    return placed_figure(result.placed, undecided, missing, {f.name: k for k, f in enumerate(result.frames)})


def _linker(names: Sequence[str]) -> Callable[[str], Markup]:
    """Makes links of the frame names before the first colon of a text: what it is about."""
    number = {name: k for k, name in enumerate(names)}
    among = "|".join(re.escape(name) for name in sorted(names, key=len, reverse=True))
    pattern = re.compile(rf"(?<![\w-])(?:{among})(?![\w-])") if names else re.compile(r"(?!)")

    def linked(text: str) -> Markup:
        parts, end = [], 0
        for found in pattern.finditer(text, 0, max(text.find(": "), 0)):
            link = Markup('<a href="#frame-{}">{}</a>').format(number[found[0]], found[0])
            parts += [escape(text[end : found.start()]), link]
            end = found.end()
        return Markup("").join([*parts, escape(text[end:])])

    return linked


def _settings(result: ProcessResult) -> list[tuple[str, str]]:
    """The flags on which the scan depends; with others, and at another time, the report is the same byte for byte."""
    flags = {key: value for key, value in vars(result.config).items() if key not in _WITHOUT_EFFECT}
    return sorted((key, str(value)) for key, value in flags.items() if value is not None)


def _sentence(result: ProcessResult) -> str:
    lost = len(result.frames) - result.registered
    begin = f"{result.registered} of {len(result.frames)} frames are in the scan"
    if result.registered < 2:
        return f"{begin}: no scan could be written."
    left_out = "" if not lost else "; 1 was left out" if lost == 1 else f"; {lost} were left out"
    length = "no length is known, so its unit is arbitrary"
    if result.scale_source:
        length = f"its lengths are in {result.units}, known from: {result.scale_source}"
    return f"{begin}{left_out}; {length}."


def _charts(result: ProcessResult) -> list[tuple[str, str]]:
    """Caption and drawing of every chart over the frames."""
    frames = result.frames

    def values(key: str, factor: float = 1.0) -> list[float]:
        return [math.nan if getattr(f, key) is None else factor * getattr(f, key) for f in frames]

    drawn = [
        ("Decoded: share of the visible pattern, and of the surface that other frames show", "%",
         [charts.Bars("pattern", values("decode_rate", 100.0)),
          charts.Bars("surface", values("shared_decoded", 100.0))]),
        ("Missing: of the surface that other frames show in the sight of both devices, where no pattern was seen", "%",
         [charts.Bars("missing", values("missing_share", 100.0))]),
        ("Epipolar residual: how well coordinates fit the frame's own relative pose", "pattern px",
         [charts.Bars("epipolar", values("epipolar_px"))]),
        ("Uncertainty (1 sigma) of the projector's pose relative to the camera", "degrees",
         [charts.Bars("rotation", values("relative_sigma_rotation_deg")),
          charts.Bars("baseline's direction", values("relative_sigma_direction_deg"))]),
        ("Agreement with overlapping frames", "% of the points",
         [charts.Bars("surfaces", values("fitness", 100.0)), charts.Bars("coordinates", values("cross_share", 100.0))]),
        ("Coordinates of this frame against those of the others", "pattern px",
         [charts.Bars("95 % below", values("cross_px_p95")), charts.Bars("median", values("cross_px_median"))]),
    ]  # fmt: skip
    known = [(title, unit, bars) for title, unit, bars in drawn if any(not math.isnan(v) for v in bars[0].values)]
    return [(title, charts.frame_bars(title, unit, bars)) for title, unit, bars in known]


def _pictures(preview: Preview) -> tuple[str, str, str]:
    shown = (preview.image, preview.coords, preview.left_out)
    image, coords, left_out = (("" if p is None else data_uri(p)) for p in shown)
    return image, coords, left_out
