"""The reports of `sl-process` and `sl-calibrate`: what happened to every capture, as HTML that needs no network."""

import html
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy import ndarray

from sl_nerfstudio.calibration.board import BoardCalibration
from sl_nerfstudio.calibration.board_adjustment import Corners
from sl_nerfstudio.calibration.board_captures import BoardCaptures, BoardPicture
from sl_nerfstudio.evaluation.report import charts
from sl_nerfstudio.evaluation.report.charts import data_uri, draw_overlaps, page
from sl_nerfstudio.evaluation.report.view3d import placed_scene
from sl_nerfstudio.geometry.devices import PARAMETERS, Device
from sl_nerfstudio.processing.object_only import FrameShares, Preview, object_sentences
from sl_nerfstudio.processing.projector import describe
from sl_nerfstudio.processing.result import (
    FrameRecord,
    ProcessRecord,
    ProcessResult,
    first_line,
    unconnected_neighbours,
)
from sl_nerfstudio.review.verdict import DEVICES, Verdict, shortcomings

# The report of `sl-calibrate`: what was found in every photograph, and how far the result can be trusted.

TITLE = b"<title>Calibration report"
"""Marks an earlier report."""
_THUMBNAIL = 360  # pixels
_ARROW = 0.06  # of the image's width: length of the arrow of the largest usual residual


def render_calibration_report(
    found: BoardCalibration, captures: BoardCaptures, verdict: Verdict, next_pose: str, command: str
) -> str:
    """The page as text. `next_pose` is the sentence on what to add."""
    values = {
        "found": found,
        "verdict": verdict,
        "next_pose": next_pose,
        "command": command,
        "lacking": shortcomings(found),
        "devices": [_device_table(found, k) for k in range(len(found.sigmas))],
        "models": [(DEVICES[one.device], one) for one in found.models],
        "cards": _cards(found, captures.pictures),
        "chart": _chart(found),
    }
    return page("calibration.html.j2", values)


def _device_table(found: BoardCalibration, k: int) -> dict[str, Any]:
    """The numbers of a device, with their standard deviations, and its residuals over the image."""
    device, sigma = found.adjusted.rig.devices[k], found.sigmas[k]
    corners = [view.camera if k == 0 else view.projector for view in found.views]
    return {
        "name": DEVICES[k],
        "device": device,
        "rows": [(key, getattr(device, key), sigma.values[key]) for key in PARAMETERS if sigma.values[key]],
        "model": str(found.free[k]),
        "rms_px": found.rms_px[k],
        "left_out_px": found.left_out.error_px[k],
        "field": _residual_field(device, corners, found.residuals[k]),
    }


def _cards(found: BoardCalibration, pictures: Sequence[BoardPicture]) -> list[dict[str, Any]]:
    """What is shown of each pose of the board; figures: device, RMS, predicted error when left out, corners."""
    number = {view.name: k for k, view in enumerate(found.views)}
    out = []
    for picture in pictures:
        place, figures = number.get(picture.name), []
        if place is not None:
            for k, residuals in enumerate(found.residuals):
                r = residuals[place]
                if len(r):
                    rms = float(np.sqrt((r**2).mean()))
                    figures.append((DEVICES[k], rms, float(found.left_out.by_view_px[k, place]), len(r)))
        shown = {"picture": _thumbnail(picture), "name": picture.name, "problem": picture.problem}
        out.append({**shown, "figures": figures})
    return out


def _chart(found: BoardCalibration) -> str:
    series = {
        DEVICES[k]: [float(np.sqrt((r**2).mean())) if len(r) else np.nan for r in residuals]
        for k, residuals in enumerate(found.residuals)
    }
    return charts.frame_bars("Residual of the corners by pose (RMS)", "px", series, wide=True)


def _thumbnail(picture: BoardPicture) -> str:
    """The photograph with the corners that were found."""
    grey = picture.grey / max(float(np.quantile(picture.grey, 0.99)), 1e-3)
    figure, axes = _figure(_THUMBNAIL, round(grey.shape[0] * (_THUMBNAIL / grey.shape[1])), 0.0)
    axes.imshow(np.clip(grey, 0, 1), cmap="gray", vmin=0, vmax=1, extent=(0, grey.shape[1], grey.shape[0], 0))
    if picture.corners is not None:
        axes.plot(*picture.corners.uv.T, "+", color=charts.ORANGE, markersize=4, markeredgewidth=0.8)
    axes.set_xlim(0, grey.shape[1])
    axes.set_ylim(grey.shape[0], 0)
    axes.axis("off")
    return data_uri(_drawn(figure))


def _residual_field(
    device: Device, corners: Sequence[Corners | None], residuals: Sequence[Float64[ndarray, "_ 2"]]
) -> str:
    """Residuals as arrows over the image, all enlarged alike; a pattern in them shows what the model lacks."""
    uv = np.concatenate([one.uv for one in corners if one is not None and len(one.uv)])
    r = np.concatenate([one for one in residuals if len(one)])
    usual = max(float(np.quantile(np.linalg.norm(r, axis=1), 0.95)), 1e-9)
    scale = _ARROW * device.w / usual
    low, high = np.minimum(uv.min(0), 0), np.maximum(uv.max(0), (device.w, device.h))
    figure, axes = _figure(640, 520, 0.07)
    axes.quiver(*uv.T, *(r * scale).T, angles="xy", scale_units="xy", scale=1, width=0.0018, color=charts.BLUE)
    axes.plot([device.cx], [device.cy], "x", color=charts.ORANGE, markersize=7)
    axes.add_patch(Rectangle((0, 0), device.w, device.h, fill=False, color=charts.MUTED))
    axes.set_aspect("equal")
    axes.set_xlim(min(low[0], device.cx) - 0.02 * device.w, max(high[0], device.cx) + 0.02 * device.w)
    axes.set_ylim(max(high[1], device.cy) + 0.02 * device.h, min(low[1], device.cy) - 0.02 * device.h)
    axes.set_title(f"residuals, enlarged {scale:.0f} times; x: principal point", fontsize=8, color=charts.MUTED)
    axes.tick_params(labelsize=7)
    return data_uri(_drawn(figure), quality=90)


def _figure(w: int, h: int, margin: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(w / 100, h / 100), dpi=100)
    return figure, figure.add_axes((margin, margin, 1 - 1.3 * margin, 1 - 2 * margin))


def _drawn(figure: Figure) -> Float[ndarray, "h w 3"]:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.float64)[..., :3] / 255


# The captures half of a report: of `sl-process` itself, and of a scan that it made.

_TEMPLATE = "processing.html.j2"
_WITHOUT_EFFECT = ("output", "work", "jobs")  # flags on which no result depends
_EMBEDDED = re.compile(r'<img loading="lazy" src="(data:image/webp;base64,[\w+/=]+)" alt="([^"]*)"')


@dataclass(frozen=True)
class FrameRow:
    """A capture with its pictures."""

    number: int
    record: FrameRecord
    image: str  # data addresses; "" where there is no picture
    coords: str
    left_out: str
    shares: FrameShares | None  # of what was left out


@dataclass(frozen=True)
class Captures:
    """What a report shows of the captures: those that need a look on top, all others folded."""

    record: ProcessRecord
    bad: list[FrameRow]
    good: list[FrameRow]
    charts: list[tuple[str, str]]  # caption and drawing
    overlaps: str

    @staticmethod
    def of(record: ProcessRecord, rows: Sequence[FrameRow]) -> "Captures":
        """Left out, undecided, or to be captured again is what needs a look."""
        again = {name for line in record.recapture for name in line.partition(": ")[0].split(", ")}
        bad = [r for r in rows if not r.record.in_scan or r.record.undecided or r.record.name in again]
        overlaps = draw_overlaps(record.frames, record.edges) if record.edges else ""
        return Captures(record, bad, [r for r in rows if r not in bad], _charts(record.frames), overlaps)

    @property
    def shown(self) -> set[int]:
        """Numbers of the captures of which the page has pictures."""
        return {row.number for row in (*self.bad, *self.good)}


def captures_of(record: ProcessRecord, report: Path) -> Captures:
    """The captures half for another report; pictures are taken from the `report` of `sl-process`, if it is there.

    Captures that are in the scan are shown by that other report itself.
    """
    text = report.read_text(encoding="utf-8") if report.is_file() else ""
    pictures = {html.unescape(what): address for address, what in _EMBEDDED.findall(text)}
    rows = [
        FrameRow(k, f, pictures.get(f"Capture {f.name}", ""), pictures.get(f"Coordinates of {f.name}", ""), "", None)
        for k, f in enumerate(record.frames)
    ]
    found = Captures.of(record, rows)
    return replace(found, good=[])


def render_processing_report(result: ProcessResult, previews: Sequence[Preview]) -> str:
    """The page as text."""
    found = result.object_only
    shares = {} if found is None else {share.name: share for share in found.frames}
    rows = []
    for k, (record, preview) in enumerate(zip(result.frames, previews, strict=True)):
        shown = (preview.image, preview.coords, preview.left_out)
        image, coords, left_out = ("" if p is None else data_uri(p) for p in shown)
        rows.append(FrameRow(k, record, image, coords, left_out, shares.get(record.name)))
    # The flags on which the scan depends; with others, and at another time, the report is the same byte for byte.
    flags = {key: value for key, value in vars(result.config).items() if key not in _WITHOUT_EFFECT}
    view = None
    if result.placed:
        undecided = [f.name for f in result.frames if f.undecided]
        missing = [] if result.config.unordered else unconnected_neighbours(result.frames, result.edges)
        numbers = {f.name: k for k, f in enumerate(result.frames)}
        shrink = 1 if result.captured is None else result.captured.shrink
        view = placed_scene(result.placed, result.units, undecided, missing, numbers, shrink)
    values = {
        "captures": Captures.of(result, rows),
        "sentence": _sentence(result),
        "figures": _figures(result),
        "projector": "" if result.projector is None else describe(result.projector),
        "object_only": () if found is None else object_sentences(found),
        "settings": sorted((key, str(value)) for key, value in flags.items() if value is not None),
        "shown": view,
        "groups": len(result.placed),
    }
    return page(_TEMPLATE, values, first_line=first_line, linked=_linker([f.name for f in result.frames]))


def _figures(result: ProcessResult) -> list[tuple[str, str, str]]:
    """Beside the verdict: what comes before a value, the value, and what comes after it."""
    rates = [f.decode_rate for f in result.frames if f.decode_rate is not None]
    lost = len(result.frames) - result.registered
    share = f"{result.registered} of {len(result.frames)}"
    figures = [("captures in the scan", share, f"{lost} left out" if lost else "")]
    if result.cross_px is not None:
        median, most = result.cross_px
        figures.append(("frames agree to", f"{median:.2f} px", f"(median; 95 % of the coordinates to {most:.2f} px)"))
    if rates:
        figures.append(("of the pattern was decoded", f"{100 * float(np.median(rates)):.0f} %", "(median frame)"))
    return figures


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


def _charts(frames: Sequence[FrameRecord]) -> list[tuple[str, str]]:
    """Caption and drawing of every chart over the frames."""

    def values(key: str, factor: float = 1.0) -> list[float]:
        return [math.nan if getattr(f, key) is None else factor * getattr(f, key) for f in frames]

    drawn = [
        ("Decoded: share of the visible pattern, and of the surface that other frames show", "%",
         {"pattern": values("decode_rate", 100.0), "surface": values("shared_decoded", 100.0)}),
        ("Missing: of the surface that other frames show in the sight of both devices, where no pattern was seen", "%",
         {"missing": values("missing_share", 100.0)}),
        ("Epipolar residual: how well coordinates fit the frame's own relative pose", "pattern px",
         {"epipolar": values("epipolar_px")}),
        ("Uncertainty (1 sigma) of the projector's pose relative to the camera", "degrees",
         {"rotation": values("relative_sigma_rotation_deg"),
          "baseline's direction": values("relative_sigma_direction_deg")}),
        ("Agreement with overlapping frames", "% of the points",
         {"surfaces": values("fitness", 100.0), "coordinates": values("cross_share", 100.0)}),
        ("Coordinates of this frame against those of the others", "pattern px",
         {"95 % below": values("cross_px_p95"), "median": values("cross_px_median")}),
    ]  # fmt: skip
    known = [one for one in drawn if not all(map(math.isnan, next(iter(one[2].values()))))]
    return [(title, charts.frame_bars(title, unit, bars)) for title, unit, bars in known]
