"""sl-eval: compare a mesh and its poses with a scan, and with the truth if it is known."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sl_nerfstudio.cli.arguments import SCAN, parse
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.console import paragraph, phase
from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from sl_nerfstudio.evaluation.completeness import NextView
    from sl_nerfstudio.evaluation.evaluate import Evaluation, EvaluationInputs, Length, PointPair
    from sl_nerfstudio.evaluation.judgement import Judgement
    from sl_nerfstudio.scan import PoseSigma

# What sl-eval prints: the verdict, three figures, the reasons and what to do next; tables on request.

_MOST = 4  # reasons, and things to do, that are printed


def summary(
    evaluation: "Evaluation", judgement: "Judgement", sigma: "Sequence[PoseSigma | None]", report: Path | None = None
) -> str:
    """The verdict, the three figures that matter, why it is not better, and what to do next.

    `report` is the file with everything else, if one was asked for.
    """
    from sl_nerfstudio.evaluation.judgement import MAIN_FIGURES, main_figures

    rest = "in the report: --report FILE.html" if report is None else f"in {report}"
    said = (" ".join(filter(None, parts)) for parts in main_figures(evaluation, sigma))
    return "\n".join(
        [
            f"verdict: {judgement.verdict.band}",
            *(paragraph(*both) for both in zip(MAIN_FIGURES, said, strict=True)),
            *_listed("reasons", judgement.verdict.reasons, rest),
            *_listed("next", judgement.next_steps, rest),
        ]
    )


def _listed(name: str, lines: Sequence[str], rest: str) -> list[str]:
    """The first few, and where the rest is."""
    shown = [paragraph(name if k == 0 else "", line) for k, line in enumerate(lines[:_MOST])]
    more = len(lines) - len(shown)
    return shown + ([paragraph("", f"({more} more {rest})")] if more else [])


def print_tables(evaluation: "Evaluation") -> None:
    """Print distances, pose errors and residuals as tables."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    units = evaluation.truth_units
    if evaluation.surface:
        table = Table(title=f"Distances in {units}", title_justify="left")
        for column in ("", " ", "mean", "median", "RMS", "95 %", "Chamfer", "scale"):
            table.add_column(column, justify="right" if column.strip() else "left")
        for name, score in evaluation.comparable.items():
            a, c = score.accuracy, score.completeness
            chamfer, scale = f"{score.chamfer:.3g}", f"{score.scale:.5f}"
            table.add_row(name, "accuracy", *(f"{v:.3g}" for v in (a.mean, a.median, a.rmse, a.p95)), chamfer, scale)
            table.add_row("", "completeness", *(f"{v:.3g}" for v in (c.mean, c.median, c.rmse, c.p95)), "", "")
        console.print(table)
    rows = [("initial poses", evaluation.initial_pose_errors), ("evaluated poses", evaluation.pose_errors)]
    if any(errors for _, errors in rows):
        table = Table(title=f"Pose errors, RMS, in {units}", title_justify="left")
        for column in ("", "camera", "deg", "projector", "deg", "scale"):
            table.add_column(column, justify="right" if column else "left")
        for name, errors in rows:
            if errors is not None:
                values = [
                    v for d in (errors.camera, errors.projector) for v in (d.translation_rmse, d.rotation_rmse_deg)
                ]
                table.add_row(name, *(f"{v:.3g}" for v in values), f"{100 * errors.scale_error:+.3f} %")
        console.print(table)
    agreement = evaluation.agreement
    table = Table(title="Agreement with the captures", title_justify="left")
    for column in (
        "coordinates px (median)",
        "95 %",
        "epipolar px (median)",
        "pattern cosine",
        "covered",
        "worst hole",
    ):
        table.add_column(column, justify="right")
    table.add_row(
        f"{agreement.coordinate_px_median:.3f}",
        f"{agreement.coordinate_px_p95:.3f}",
        f"{agreement.epipolar_px_median:.3f}",
        f"{agreement.pattern_cosine:.4f}",
        f"{agreement.hit_share:.1%}",
        f"{max(frame.largest_hole for frame in agreement.frames):.1%}",
    )
    console.print(table)


# What sl-eval prints of the distances that were asked for.


def print_lengths(lengths: "Sequence[Length]", units: str) -> None:
    """A table, and why a distance has no uncertainty."""
    from rich.console import Console
    from rich.table import Table

    if not lengths:
        return

    console = Console()
    table = Table(title=f"Distances between points, in {units}", title_justify="left")
    for column in ("", "distance", "1 sigma", "from poses", "from noise"):
        table.add_column(column, justify="right" if column else "left")
    for length in lengths:
        sigmas = (length.sigma, length.sigma_shared, length.sigma_independent)
        table.add_row(length.name, f"{length.length:.5g}", *("-" if s is None else f"{s:.2g}" for s in sigmas))
    console.print(table)
    reasons = dict.fromkeys(filter(None, (why_unknown(length) for length in lengths)))
    for reason in reasons:
        console.print(f"  {reason}", highlight=False, soft_wrap=True, markup=False)


def why_unknown(length: "Length") -> str:
    """Why a distance has no uncertainty; "" if it has one."""
    if length.sigma is not None:
        return ""
    if length.views is not None and 0 in length.views:
        return f"{length.name}: no frame confirms the surface at one of its ends, so the distance is not measured"
    return (
        "no uncertainty: it needs mesh.ply of sl-export, and --poses with the folder that the same sl-export wrote "
        "(pose_covariance.npz, of a run that adjusted the poses)"
    )


_JSON_MARK, _REPORT_MARK = b'"format": 1,\n  "verdict"', b"<title>Scan report: "  # by which earlier results are known


@dataclass(frozen=True)
class EvalConfig:
    """Evaluate a mesh and its poses with a scan, and with the truth if it is known."""

    mesh: Path
    """The surface, in the scan's unit and world axes: .ply, .obj, .stl or .glb."""
    data: Path
    """The scan folder. Its ground_truth/ is used if it is there."""
    poses: Path | None = None
    """transforms.json with the poses (and the intrinsics, if it has any) to evaluate, such as refined/transforms.json;
    default: the scan's own. A training.json in the same folder goes into the report."""
    json: Path | None = None
    """Where to write all figures."""
    report: Path | None = None
    """Where to write the report, one HTML file that needs no network."""
    reference: Path | None = None
    """Compare with this instead of ground_truth/mesh.ply: a mesh, or points in an .npz file under the key `xyz`."""
    f_distances: Annotated[tuple[float, ...], tyro.conf.arg(metavar="D ..")] = ()
    """Distances for the F-score, in the scan's unit; default: four round ones from 0.1 % to 1 % of the truth's size."""
    distance: Annotated[tuple[str, ...], tyro.conf.arg(metavar='"P Q"')] = ()
    """Distances to measure, each between two points of the surface: "12.5,-3,40 10,2,38" (x,y,z in the unit and axes of
    the mesh), or "handle: 12.5,-3,40 10,2,38". With a mesh.ply of sl-export and --poses, each has its uncertainty."""
    distances: Path | None = None
    """A text file with such distances, one a line."""
    samples: int = 100_000
    """Number of points spread over each surface to measure distances."""
    seed: int = 0
    """Random seed of these points; the same seed gives the same figures."""
    verbose: bool = False
    """Also print tables of all distances, pose errors and residuals."""


_INPUTS = {
    "mesh": "give the mesh that sl-export wrote",
    "data": SCAN,
    "poses": "give the transforms.json that sl-export --poses wrote",
    "reference": "give a mesh, or an .npz file of points",
    "distances": "give a text file with distances, one a line",
}
_GROUPS = {
    "what is compared": ("poses", "reference", "distance", "distances", "f_distances"),
    "what is written": ("json", "report", "verbose"),
}


def evaluate_scan(config: EvalConfig) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can correct."""
    _check(config)
    from sl_nerfstudio.parallel import one_library_thread
    from sl_nerfstudio.storage import held_results

    marks = {path: mark for path, mark in ((config.json, _JSON_MARK), (config.report, _REPORT_MARK)) if path}
    with held_results(marks), one_library_thread():
        _evaluate(config)


def _evaluate(config: EvalConfig) -> None:
    with phase("read"):
        from sl_nerfstudio.evaluation.evaluate import evaluate, measure_lengths, read_inputs, typical_sigma
        from sl_nerfstudio.evaluation.judgement import further_commands, judge, to_json, trained_steps
        from sl_nerfstudio.evaluation.report.scan_report import ResidualThumbnails, intrinsics_hint
        from sl_nerfstudio.storage import write_atomic

        pairs = _pairs(config)
        inputs = read_inputs(config.mesh, config.data, config.poses, config.reference, config.samples, config.seed)
    thumbnails = ResidualThumbnails()
    with phase("measure"):
        lengths = measure_lengths(pairs, inputs.mesh, inputs.quality, inputs.scan, inputs.poses, inputs.joint)
        evaluation = evaluate(
            inputs.mesh, inputs.scan, inputs.poses, inputs.reference, inputs.true_poses, config.f_distances,
            config.samples, config.seed, on_frame=thumbnails if config.report else None, sigma=inputs.stated_sigma,
            true_units=inputs.true_units,
        )  # fmt: skip
        sigma = typical_sigma(inputs.mesh, inputs.quality, inputs.scan, inputs.poses, inputs.joint)
    with phase("advise"):
        capture = _next_capture(evaluation, inputs)
    hint, steps = intrinsics_hint(inputs.training, inputs.scan), trained_steps(inputs.training)
    judgement = judge(
        evaluation, hint, steps, capture, inputs.unplaced, sigma, inputs.departed, further_commands(inputs.training)
    )
    results: dict[Path, str] = {}
    if config.json:
        document = to_json(evaluation, judgement.verdict, capture, lengths)
        results[config.json] = json.dumps(document, indent=2, allow_nan=False) + "\n"
    if config.report:
        from sl_nerfstudio.evaluation.report.scan_report import ReportInput, render_report

        results[config.report] = render_report(
            ReportInput(evaluation, judgement, inputs, thumbnails.frames, config.mesh.name, lengths=lengths)
        )
    for path, text in results.items():
        write_atomic(path, text.encode())
    if config.verbose:
        print_tables(evaluation)
    print_lengths(lengths, inputs.scan.units)
    print(summary(evaluation, judgement, inputs.pose_sigma, config.report))
    for path in results:
        print(f"written: {path}")


def _next_capture(evaluation: "Evaluation", inputs: "EvaluationInputs") -> "NextView | None":
    from sl_nerfstudio.evaluation.completeness import CaptureView, next_view
    from sl_nerfstudio.evaluation.mesh_index import IndexedMesh

    found = evaluation.completeness
    if found is None:
        return None
    poses = zip(inputs.poses.T_world_camera, inputs.poses.T_world_projector, strict=True)
    frames = [
        CaptureView(frame.camera, T_c, inputs.scan.projector, T_p)
        for frame, (T_c, T_p) in zip(inputs.scan.frames, poses, strict=True)
    ]
    return next_view(IndexedMesh(inputs.mesh), found.openings, frames, found.noise_px)


def _pairs(config: EvalConfig) -> "list[PointPair]":
    from sl_nerfstudio.evaluation.evaluate import parse_pair, read_pairs

    given = [parse_pair(text, "--distance") for text in config.distance]
    return given + ([] if config.distances is None else read_pairs(config.distances))


def _check(config: EvalConfig) -> None:
    """Check what the flags alone can show."""
    for distance in config.f_distances:
        if not 0 < distance < float("inf"):
            raise UserError(
                f"--f-distances: {distance:g} is not a distance\n"
                "    remedy: give numbers greater than 0, in the scan's unit"
            )
    if config.samples < 1000:
        raise UserError(
            f"--samples: {config.samples} points are too few for stable figures\n    remedy: give at least 1000"
        )
    if config.seed < 0:
        raise UserError(f"--seed: {config.seed} is negative\n    remedy: give a whole number of at least 0")
    if config.json and config.report and config.json.absolute() == config.report.absolute():
        raise UserError(f"--json and --report: both are {config.json}\n    remedy: give two files")
    if config.reference and config.reference.suffix.lower() == ".npy":
        raise UserError(
            f"--reference: {config.reference} is an .npy file\n    remedy: give an .npz file with the key xyz"
        )


def main() -> None:
    """Entry point of `sl-eval`."""
    run(lambda: evaluate_scan(parse(EvalConfig, "sl-eval", _INPUTS, _GROUPS)))


if __name__ == "__main__":
    main()
