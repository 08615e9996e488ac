"""The report of `sl-eval`: one HTML file with which a person can judge a scan, without a network."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.calibration.stated import describe_change
from sl_nerfstudio.console import unit_word
from sl_nerfstudio.evaluation.agreement import CaptureAgreement, FrameAgreement, FramePixels, frame_pixels
from sl_nerfstudio.evaluation.evaluate import Evaluation, EvaluationInputs, Length
from sl_nerfstudio.evaluation.judgement import MAIN_FIGURES, Judgement, main_figures
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import MeshReference, compare_poses
from sl_nerfstudio.evaluation.report import charts
from sl_nerfstudio.evaluation.report.capture_reports import captures_of
from sl_nerfstudio.evaluation.report.charts import (
    NO_SURFACE,
    NO_VALUE,
    ColourLayer,
    ColourScale,
    camera_views,
    colour_layers,
    data_uri,
    page,
    pixel_map,
    render,
    residual_colours,
    shrink,
)
from sl_nerfstudio.evaluation.report.view3d import mesh_scene
from sl_nerfstudio.geometry.devices import DeviceChange, IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.parallel import results
from sl_nerfstudio.scan import Frame, Scan

# Small residual maps of every frame, made while the frames are evaluated one by one.

COORDINATE = ColourScale("YlOrRd", 0.0, 2.0)  # pattern pixels
EPIPOLAR = ColourScale("RdBu_r", -1.5, 1.5)
PATTERN = ColourScale("YlOrRd", 0.0, 0.5)  # of full brightness
_THUMBNAIL_SIDE = 150


@dataclass(frozen=True)
class FrameThumbnails:
    """One frame's maps as data addresses."""

    name: str
    figures: FrameAgreement
    coordinate: str
    epipolar: str
    pattern: str


class ResidualThumbnails:
    """Makes the small maps of each frame it gets; meant as the `on_frame` of `evaluate`."""

    def __init__(self) -> None:
        self.frames: list[FrameThumbnails] = []

    def __call__(self, frame: Frame, figures: FrameAgreement, pixels: FramePixels) -> None:
        """Add one frame."""
        missed = ~pixels.hit
        difference = np.abs(pixels.captured - pixels.rendered * brightness_ratio(pixels))
        drawn = (
            residual_colours(pixels.coordinate, COORDINATE, missed & pixels.decoded),
            residual_colours(pixels.epipolar, EPIPOLAR, np.zeros_like(missed)),
            residual_colours(difference, PATTERN, missed),
        )
        maps = (_picture(pixels, rgb, _THUMBNAIL_SIDE, 82) for rgb in drawn)
        self.frames.append(FrameThumbnails(frame.name, figures, *maps))


def brightness_ratio(pixels: FramePixels) -> float:
    """Least-squares factor from the brightness of the rendered to that of the captured pattern."""
    known = pixels.lit & np.isfinite(pixels.rendered)
    a, b = pixels.captured[known], pixels.rendered[known]
    return float(a @ b / (b @ b)) if (b @ b) > 0 else 1.0


def _picture(pixels: FramePixels, rgb: Float[ndarray, "n 3"], side: int, quality: int) -> str:
    return data_uri(shrink(pixel_map(pixels.row, pixels.column, pixels.stride, rgb), side), quality)


# Captured and rendered pattern of a few frames, side by side.

_COMPARISON_SIDE = 420
DIFFERENCE = ColourScale("RdBu_r", -0.6, 0.6)


@dataclass(frozen=True)
class Comparison:
    """One frame's pictures as data addresses, all cropped in the same way."""

    name: str
    why: str  # why this frame is shown
    captured: str
    rendered: str
    difference: str
    cosine: float


def compare_frames(
    surface: IndexedMesh, scan: Scan, agreement: CaptureAgreement, poses: DevicePoses
) -> list[Comparison]:
    """Draw the frames with the best, the median and the worst pattern agreement."""
    cosine = [frame.pattern_cosine for frame in agreement.frames]
    order = sorted((k for k, value in enumerate(cosine) if math.isfinite(value)), key=lambda k: -cosine[k])
    picks: dict[int, str] = {}
    for place, why in ((0, "best agreement"), (len(order) // 2, "median"), (-1, "worst agreement")):
        if order:
            picks.setdefault(order[place], why)
    pattern, shown = scan.read_pattern(), []
    for k, why in picks.items():
        T = poses.T_world_camera[k], poses.T_world_projector[k]
        pixels = frame_pixels(surface, scan.frames[k], scan, pattern, *T)
        rendered = pixels.rendered * brightness_ratio(pixels)
        white = max(float(np.nanpercentile(pixels.captured, 99.5)), 1e-6) if len(pixels.captured) else 1.0
        drawn = (
            _grey(pixels.captured / white, pixels, np.ones_like(pixels.hit)),
            _grey(rendered / white, pixels, pixels.lit),
            residual_colours((pixels.captured - rendered) / white, DIFFERENCE, ~pixels.hit),
        )
        pictures = (_picture(pixels, rgb, _COMPARISON_SIDE, 85) for rgb in drawn)
        shown.append(Comparison(scan.frames[k].name, why, *pictures, cosine=cosine[k]))
    return shown


def _grey(values: Float[ndarray, "n"], pixels: FramePixels, known: ndarray) -> Float[ndarray, "n 3"]:
    rgb = np.repeat(np.clip(np.nan_to_num(values), 0, 1)[:, None], 3, axis=1)
    rgb[~known] = NO_VALUE
    rgb[~known & ~pixels.hit] = NO_SURFACE
    return rgb


# What the report says about the intrinsics of a run, from its training.json.


def intrinsics_hint(training: dict[str, Any] | None, scan: Scan) -> str:
    """Say how the run changed the intrinsics, and which ones would agree better; "" if there is nothing to say."""
    record = (training or {}).get("intrinsics")
    if not isinstance(record, dict):
        return ""
    sentences = []
    change = _change(record["change"])
    if change:
        sentences.append(
            "The intrinsics are not those of the scan folder: focal length of the camera "
            f"{100 * change.camera.focal:+.2f} %, of the projector {100 * change.projector.focal:+.2f} %. The "
            "transforms.json of the refined poses has them"
        )
    found = record["self_calibration"]
    if found is not None and found["contradicts"]:
        cameras = [frame.camera for frame in scan.frames]
        lines = describe_change(_change(found["change"]), _change(found["sigma"]), cameras, scan.projector)
        sentences.append(
            f"The intrinsics contradict the captures (chi square {found['chi_square']:.0f}, by chance 6). "
            f"These changes, together, would agree better: {'; '.join(lines)}. Train with "
            "--pipeline.model.refine-intrinsics True; if that does not help, calibrate again"
        )
    return ". ".join(sentences)


def _change(record: dict[str, dict[str, float]]) -> IntrinsicsChange:
    return IntrinsicsChange(DeviceChange(**record["camera"]), DeviceChange(**record["projector"]))


_TEMPLATE = "report.html.j2"
SECTIONS = {
    "Accuracy": "surface", "Distance from reference": "surface", "Coverage": "surface", "Holes": "surface",
    "Coordinate residual": "residuals", "Epipolar residual": "residuals", "Worst frame": "residuals",
    "Worst frame, 95 %": "residuals", "Agreement in the worst frame": "residuals", "Ray angle": "residuals",
    "Pattern agreement": "pattern", "Training": "training", "Sigma of lengths": "poses",
}  # fmt: skip
"""The section of the page in which a judged figure is shown: it is unfolded if the figure is not good."""


@dataclass(frozen=True)
class ReportInput:
    """What the report is made from."""

    evaluation: Evaluation
    judgement: Judgement
    inputs: EvaluationInputs
    thumbnails: list[FrameThumbnails]
    mesh_name: str
    made_at: datetime = field(default_factory=datetime.now)
    lengths: Sequence[Length] = ()
    layers: Sequence[ColourLayer] = ()  # of the surface, besides those of every report

    @property
    def poses_name(self) -> str:
        """Folder and file of the evaluated poses; "" if they are the scan's own."""
        path = self.inputs.poses_path
        return "" if path is None else f"{path.parent.name}/{path.name}"


def render_report(report: ReportInput) -> str:
    """The page as text."""
    evaluation, scan = report.evaluation, report.inputs.scan
    surface, comparisons, changes = _parts(report)
    frames, limit = evaluation.agreement.frames, 2 * evaluation.agreement.coordinate_px_median
    outliers = {f.name for f in frames if not f.coordinate_px_median <= limit}
    judged, record = report.judgement.figures, report.inputs.record
    not_good = {SECTIONS[figure.name] for figure in judged if figure.band != "good"}
    not_good |= {"residuals"} if outliers else set()
    not_good |= {"poses"} if report.inputs.unplaced else set()
    residuals = {
        "coordinates": [f.coordinate_px_median for f in frames],
        "epipolar": [f.epipolar_px_median for f in frames],
    }
    truth = [("initial poses", evaluation.initial_pose_errors), ("evaluated poses", evaluation.pose_errors)]
    values = {
        "report": report,
        "evaluation": evaluation,
        "scan": scan,
        "agreement": evaluation.agreement,
        "units": evaluation.units,
        "truth_units": evaluation.truth_units,
        "judgement": report.judgement,
        "verdict": report.judgement.verdict,
        "surface": surface,
        "comparisons": comparisons,
        "coordinate_scale": COORDINATE,
        "epipolar_scale": EPIPOLAR,
        "pattern_scale": PATTERN,
        "residual_chart": charts.frame_bars("Median residuals by frame", "pattern px", residuals, wide=True),
        "outliers": outliers,
        "not_good": not_good,
        "figures": _main_figures(report),
        "good": sum(figure.band == "good" for figure in judged),
        "bad_frames": [frame for frame in report.thumbnails if frame.name in outliers],
        "good_frames": [frame for frame in report.thumbnails if frame.name not in outliers],
        "captures": None if record is None else captures_of(record, scan.root / "processing.html"),
        "changes": changes,
        "lengths": report.lengths,
        "truth": [(name, errors) for name, errors in truth if errors is not None],
        "training": _training(report.inputs.training),
        "summary": _summary(report),
    }
    return page(_TEMPLATE, values)


def _main_figures(report: ReportInput) -> list[tuple[str, str, str]]:
    """As the console says them, each under its name."""
    named = zip(MAIN_FIGURES, main_figures(report.evaluation, report.inputs.pose_sigma), strict=True)
    return [(f"{name}: {before}" if before else name, value, after) for name, (before, value, after) in named]


def _parts(report: ReportInput) -> tuple[dict[str, Any], list[Comparison], dict[str, Any] | None]:
    """What takes long, side by side. Matplotlib's settings belong to the process: one task draws with it at a time."""
    surface, inputs = IndexedMesh(report.inputs.mesh), report.inputs
    tasks: list[Callable[[], Any]] = [
        partial(_surface_pictures, report, surface),
        partial(_pose_changes, report),
        partial(compare_frames, surface, inputs.scan, report.evaluation.agreement, inputs.poses),
    ]
    (pictures, errors), changes, comparisons = results(tasks)
    if errors is not None:
        title, scale = "Signed distance of the surface from the reference", pictures["scale"]
        shown = charts.histogram(title, report.evaluation.truth_units, errors, scale.lower, scale.upper)
        pictures["histogram"] = shown
    return pictures, comparisons, changes


def _surface_pictures(report: ReportInput, surface: IndexedMesh) -> tuple[dict[str, Any], Float[ndarray, "n"] | None]:
    """Shaded views of the surface, with error colours where there is a reference, and the errors of its histogram."""
    values, scale = _errors(report, surface, surface.vertices)
    colours = None if values is None or scale is None else scale(values)
    views = camera_views(report.inputs.poses.T_world_camera, surface.centre)
    units = report.evaluation.truth_units
    layers = [*colour_layers(values, scale, report.inputs.quality, report.evaluation.units, units), *report.layers]
    sigma = None if report.inputs.quality is None else report.inputs.quality.sigma
    scan, record = report.inputs.scan, report.inputs.record
    numbers = {frame.name: k for k, frame in enumerate(scan.frames)}
    numbers |= {} if record is None else {frame.name: k for k, frame in enumerate(record.frames)}
    view = mesh_scene(surface, layers, scan, report.inputs.poses, numbers, sigma, report.inputs.colour)
    errors = None if scale is None else _errors(report, surface, surface.sample(50_000, 0)[0])[0]
    drawn, names = [data_uri(render(surface, v, colours)) for v in views], [layer.name for layer in layers]
    return {"views": drawn, "view": view, "scale": scale, "layers": names, "histogram": ""}, errors


def _errors(
    report: ReportInput, surface: IndexedMesh, points: Float[ndarray, "n 3"]
) -> tuple[Float[ndarray, "n"] | None, ColourScale | None]:
    """Signed errors of points of the result after alignment, and their colour scale; None without reference."""
    reference = report.evaluation.reference
    if reference is None:
        return None, None
    score = report.evaluation.surface[report.evaluation.alignment]
    exact = isinstance(reference, MeshReference)
    limit = charts.nice_limit((score.accuracy if exact else score.completeness).p95)
    return reference.surface_errors(surface, score.S_truth_result, points), ColourScale("RdYlBu_r", -limit, limit)


def _pose_changes(report: ReportInput) -> dict[str, Any] | None:
    """How far the evaluated poses are from the scan's own, how certain they are, and frames that have no place.

    None where the scan's own poses were evaluated.
    """
    if not report.poses_name:
        return None
    scan = report.inputs.scan
    change = compare_poses(report.inputs.poses, scan.poses)
    sigma = report.inputs.pose_sigma if any(s is not None for s in report.inputs.pose_sigma) else []
    camera, projector = change.camera, change.projector
    figures = [
        charts.frame_bars(title, unit, {"camera": list(c), "projector": list(p)})
        for title, unit, c, p in (
            ("Change of position by frame", scan.units, camera.translation, projector.translation),
            ("Change of rotation by frame", "degrees", camera.rotation_deg, projector.rotation_deg),
        )
    ]
    if sigma:
        for title, unit, key in (
            ("Uncertainty of position (1 sigma) by frame", scan.units, "translation"),
            ("Uncertainty of rotation (1 sigma) by frame", "degrees", "rotation_deg"),
        ):
            series = {
                label: [getattr(s, f"{what}_{key}") if s else math.nan for s in sigma]
                for what, label in (("camera", "frame in the world"), ("relative", "projector relative to camera"))
            }
            figures.append(charts.frame_bars(title, unit, series))
    return {"change": change, "sigma": sigma, "unplaced": report.inputs.unplaced, "charts": figures}


def _training(training: dict[str, Any] | None) -> dict[str, Any] | None:
    """Curves, settings and versions of the run."""
    if training is None:
        return None
    curves = {k: v for k, v in _dict(training.get("curves")).items() if isinstance(v, list) and len(v) > 0}
    step = curves.pop("step", [])
    drawn = [
        charts.curve(name, step if len(step) == len(values) else range(len(values)), values)
        for name, values in curves.items()
    ]
    return {"curves": drawn} | {key: _flat(_dict(training.get(key))) for key in ("settings", "versions")}


def _dict(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _flat(settings: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested settings as dotted names."""
    rows: list[tuple[str, str]] = []
    for key, value in settings.items():
        name = f"{prefix}{key}"
        rows += _flat(value, f"{name}.") if isinstance(value, dict) and value else [(name, str(value))]
    return rows


def _summary(report: ReportInput) -> list[tuple[str, str]]:
    scan, poses = report.inputs.scan, report.inputs.poses
    frames, baseline = report.evaluation.agreement.frames, poses.baseline
    centre = (report.inputs.mesh.vertices.min(0) + report.inputs.mesh.vertices.max(0)) / 2
    distance = np.linalg.norm(poses.T_world_camera[:, :3, 3] - centre, axis=1)
    mesh = report.inputs.mesh
    size = np.ptp(mesh.vertices, axis=0)
    cameras = sorted({f"{f.camera.w} × {f.camera.h}" for f in scan.frames})
    decoded = np.mean([f.decoded_share for f in frames])
    scale = f"known ({scan.scale.source})" if scan.scale.known else "unknown: all lengths are relative"
    return [
        ("Frames", str(len(scan.frames))),
        ("Image size", ", ".join(cameras) + " pixels"),
        ("Projector", f"{scan.projector.w} × {scan.projector.h} pixels, model {scan.projector.model}"),
        ("Unit", scan.units),
        ("Scale", scale if scan.scale.source or not scan.scale.known else "known"),
        ("Pixels with pattern", f"{sum(f.pixels for f in frames):,}, of which {decoded:.0%} were decoded"),
        ("Distance of the cameras", f"{np.median(distance):.4g} {unit_word(scan.units)} (median)"),
        ("Camera to projector", f"{np.median(baseline):.4g} {unit_word(scan.units)} (median), "
         f"{np.min(baseline):.4g} to {np.max(baseline):.4g}"),
        ("Mesh", f"{len(mesh.faces):,} triangles, {' × '.join(f'{s:.4g}' for s in size)} {unit_word(scan.units)}"),
    ]  # fmt: skip
