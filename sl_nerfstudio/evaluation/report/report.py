"""The report: one HTML file with which a person can judge a scan, without a network."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.evaluation.evaluate import Evaluation
from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.evaluation.inputs import EvaluationInputs
from sl_nerfstudio.evaluation.judgement import Judgement
from sl_nerfstudio.evaluation.lengths import Length
from sl_nerfstudio.evaluation.pose_errors import PoseErrors, compare_poses
from sl_nerfstudio.evaluation.reference import MeshReference
from sl_nerfstudio.evaluation.report import charts
from sl_nerfstudio.evaluation.report.colour_layers import colour_layers
from sl_nerfstudio.evaluation.report.comparisons import Comparison, compare_frames
from sl_nerfstudio.evaluation.report.pages import page
from sl_nerfstudio.evaluation.report.pictures import ColourScale, camera_views, data_uri, render
from sl_nerfstudio.evaluation.report.plot3d import SceneDevices, compressed_script, mesh_figure
from sl_nerfstudio.evaluation.report.thumbnails import COORDINATE, EPIPOLAR, PATTERN, FrameThumbnails
from sl_nerfstudio.scan import PoseSigma
from sl_nerfstudio.threads import results

_TEMPLATE = "report.html.j2"


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

    @property
    def poses_name(self) -> str:
        """Folder and file of the evaluated poses; "" if they are the scan's own."""
        path = self.inputs.poses_path
        return "" if path is None else f"{path.parent.name}/{path.name}"


@dataclass(frozen=True)
class SurfacePictures:
    """Shaded views of the surface, with error colours where there is a reference."""

    views: list[str]  # data addresses
    figure: str  # Plotly's JSON
    scale: ColourScale | None
    layers: list[str]  # names of what the interactive view can be coloured by
    histogram: str  # SVG, "" without a reference


def render_report(report: ReportInput) -> str:
    """The page as text."""
    evaluation, scan = report.evaluation, report.inputs.scan
    surface, comparisons, script, drawn = _parts(report)
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
        "residual_chart": drawn.residuals,
        "outliers": _outliers(evaluation),
        "changes": drawn.changes,
        "lengths": report.lengths,
        "truth": _truth_rows(evaluation),
        "training": drawn.training,
        "summary": _summary(report),
        "plotly": script,
    }
    return page(_TEMPLATE, values)


def _parts(report: ReportInput) -> tuple[SurfacePictures, list[Comparison], str, "DrawnCharts"]:
    """What takes long, side by side. Matplotlib's settings belong to the process: one task draws with it at a time."""
    surface = IndexedMesh(report.inputs.mesh)
    compare = partial(compare_frames, surface, report.inputs.scan, report.evaluation.agreement, report.inputs.poses)
    tasks: list[Callable[[], Any]] = [
        partial(_surface_pictures, report, surface), partial(_charts, report), compare, compressed_script,
    ]  # fmt: skip
    (pictures, errors), drawn, comparisons, script = results(tasks)
    if errors is not None and pictures.scale is not None:
        title, units = "Signed distance of the surface from the reference", report.evaluation.truth_units
        histogram = charts.histogram(title, units, errors, pictures.scale.lower, pictures.scale.upper)
        pictures = replace(pictures, histogram=histogram)
    return pictures, comparisons, script, drawn


@dataclass(frozen=True)
class DrawnCharts:
    """All charts but the histogram, as SVG."""

    residuals: str
    changes: "PoseChanges | None"
    training: "TrainingSection | None"


def _charts(report: ReportInput) -> DrawnCharts:
    return DrawnCharts(_residual_chart(report.evaluation), _pose_changes(report), _training(report.inputs.training))


def _surface_pictures(report: ReportInput, surface: IndexedMesh) -> tuple[SurfacePictures, Float[ndarray, "n"] | None]:
    """The pictures without the histogram, and the errors that it shows."""
    values, scale = _errors(report, surface, surface.vertices)
    colours = None if values is None or scale is None else scale(values)
    views = camera_views(report.inputs.poses.T_world_camera, surface.centre)
    units = report.evaluation.truth_units
    layers = colour_layers(values, scale, report.inputs.quality, report.evaluation.units, units)
    scan, quality = report.inputs.scan, report.inputs.quality
    devices = SceneDevices([f.name for f in scan.frames], [f.camera for f in scan.frames], scan.projector)
    sigma = None if quality is None else quality.sigma
    figure = mesh_figure(report.inputs.mesh, layers, report.inputs.poses, devices, sigma)
    errors = None if scale is None else _errors(report, surface, surface.sample(50_000, 0)[0])[0]
    drawn = [data_uri(render(surface, v, colours)) for v in views]
    return SurfacePictures(drawn, figure, scale, [layer.name for layer in layers], ""), errors


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


def _residual_chart(evaluation: Evaluation) -> str:
    frames = evaluation.agreement.frames
    return charts.frame_bars(
        "Median residuals by frame",
        "pattern px",
        [
            charts.Bars("coordinates", [f.coordinate_px_median for f in frames]),
            charts.Bars("epipolar", [f.epipolar_px_median for f in frames]),
        ],
        wide=True,
    )


def _outliers(evaluation: Evaluation) -> set[str]:
    """Frames whose coordinate residual is more than twice the scan's."""
    limit = 2 * evaluation.agreement.coordinate_px_median
    return {f.name for f in evaluation.agreement.frames if not f.coordinate_px_median <= limit}


@dataclass(frozen=True)
class PoseChanges:
    """How far the evaluated poses are from the scan's own, and how certain they are."""

    change: PoseErrors
    sigma: list[PoseSigma | None]
    unplaced: list[str]  # frames that do not agree with the others
    charts: list[str]


def _pose_changes(report: ReportInput) -> PoseChanges | None:
    """None where the scan's own poses were evaluated."""
    if not report.poses_name:
        return None
    scan = report.inputs.scan
    change = compare_poses(report.inputs.poses, scan.poses)
    sigma = report.inputs.pose_sigma if any(s is not None for s in report.inputs.pose_sigma) else []
    camera, projector = change.camera, change.projector
    figures = [
        charts.frame_bars(title, unit, [charts.Bars("camera", list(c)), charts.Bars("projector", list(p))])
        for title, unit, c, p in (
            ("Change of position by frame", scan.units, camera.translation, projector.translation),
            ("Change of rotation by frame", "degrees", camera.rotation_deg, projector.rotation_deg),
        )
    ]
    if sigma:
        for title, unit, keys in (
            ("Uncertainty of position (1 sigma) by frame", scan.units, ("camera_translation", "relative_translation")),
            ("Uncertainty of rotation (1 sigma) by frame", "degrees", ("camera_rotation_deg", "relative_rotation_deg")),
        ):
            labels = ("frame in the world", "projector relative to camera")
            series = [
                charts.Bars(label, [getattr(s, key) if s else math.nan for s in sigma])
                for key, label in zip(keys, labels, strict=True)
            ]
            figures.append(charts.frame_bars(title, unit, series))
    return PoseChanges(change, sigma, report.inputs.unplaced, figures)


def _truth_rows(evaluation: Evaluation) -> list[tuple[str, PoseErrors]]:
    rows = [("initial poses", evaluation.initial_pose_errors), ("evaluated poses", evaluation.pose_errors)]
    return [(name, errors) for name, errors in rows if errors is not None]


@dataclass(frozen=True)
class TrainingSection:
    """Curves, settings and versions of the run."""

    curves: list[str]
    settings: list[tuple[str, str]]
    versions: list[tuple[str, str]]


def _training(training: dict[str, Any] | None) -> TrainingSection | None:
    if training is None:
        return None
    curves = {k: v for k, v in _dict(training.get("curves")).items() if isinstance(v, list) and len(v) > 0}
    step = curves.pop("step", [])
    drawn = [
        charts.curve(name, step if len(step) == len(values) else range(len(values)), values)
        for name, values in curves.items()
    ]
    return TrainingSection(drawn, _flat(_dict(training.get("settings"))), _flat(_dict(training.get("versions"))))


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
        ("Distance of the cameras", f"{np.median(distance):.4g} {scan.units} (median)"),
        ("Camera to projector", f"{np.median(baseline):.4g} {scan.units} (median), "
         f"{np.min(baseline):.4g} to {np.max(baseline):.4g}"),
        ("Mesh", f"{len(mesh.faces):,} triangles, {size[0]:.4g} × {size[1]:.4g} × {size[2]:.4g} {scan.units}"),
    ]  # fmt: skip
