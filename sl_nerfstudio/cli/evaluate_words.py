"""What sl-eval prints: the verdict, three figures, the reasons and what to do next; tables on request."""

import math
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from sl_nerfstudio.console import figure, paragraph, unit_word
from sl_nerfstudio.evaluation.evaluate import Evaluation
from sl_nerfstudio.evaluation.judgement import ALIGNED, Judgement
from sl_nerfstudio.scan import PoseSigma

_MOST = 4  # reasons, and things to do, that are printed


def summary(
    evaluation: Evaluation, judgement: Judgement, sigma: Sequence[PoseSigma | None], report: Path | None = None
) -> str:
    """The verdict, the three figures that matter, why it is not better, and what to do next.

    `report` is the file with everything else, if one was asked for.
    """
    fit, rest = evaluation.agreement, "in the report: --report FILE.html" if report is None else f"in {report}"
    figures = [
        ("surface", _surface(evaluation, sigma)),
        ("captures", f"coordinates agree to {fit.coordinate_px_median:.2g} px (median), 95 % to "
         f"{fit.coordinate_px_p95:.2g} px; worst frame: {_worst_frame(evaluation)}"),
        ("coverage", _coverage(evaluation)),
    ]  # fmt: skip
    return "\n".join(
        [
            f"verdict: {judgement.verdict.band}",
            *(paragraph(name, text) for name, text in figures),
            *_listed("reasons", judgement.verdict.reasons, rest),
            *_listed("next", judgement.next_steps, rest),
        ]
    )


def _listed(name: str, lines: Sequence[str], rest: str) -> list[str]:
    """The first few, and where the rest is."""
    shown = [paragraph(name if k == 0 else "", line) for k, line in enumerate(lines[:_MOST])]
    more = len(lines) - len(shown)
    return shown + ([paragraph("", f"({more} more {rest})")] if more else [])


def _surface(evaluation: Evaluation, sigma: Sequence[PoseSigma | None]) -> str:
    """Its distance from the truth, or else how well the poses are known."""
    if evaluation.alignment in evaluation.surface:
        score, unit = evaluation.surface[evaluation.alignment], evaluation.truth_units
        return (
            f"{score.accuracy.rmse:.3g} {unit} from the truth (RMS, {ALIGNED[evaluation.alignment]}); the truth is "
            f"{score.completeness.mean:.3g} {unit} from it (mean)"
        )
    known = [s for s in sigma if s is not None]
    if not known:
        return "no truth is known, and the poses do not state their uncertainty"
    lengths, turns = [s.camera_translation for s in known], [s.camera_rotation_deg for s in known]
    return f"no truth is known; cameras to {_rms(lengths):.2g} {evaluation.units}, {_rms(turns):.2g}° (1 sigma)"


def _worst_frame(evaluation: Evaluation) -> str:
    frames = [f for f in evaluation.agreement.frames if math.isfinite(f.coordinate_px_p95)]
    if not frames:
        return "none"
    worst = max(frames, key=lambda f: f.coordinate_px_p95)
    return f"{worst.name}, {worst.coordinate_px_p95:.2g} px, {worst.covered_share:.0%} covered"


def _coverage(evaluation: Evaluation) -> str:
    found = evaluation.completeness
    if found is None:
        return f"{evaluation.agreement.hit_share:.1%} of the pixels with pattern"
    o, unit = found.openings, unit_word(evaluation.units)
    text = f"{found.observed:.1%} of what the frames decoded"
    if not len(o):
        return f"{text}; closed all around"
    inner = f"{len(o) - 1} holes beside it ({figure(o.area[1:].sum())} {unit}²)" if len(o) > 1 else "no holes beside it"
    return f"{text}; rim of the scan {figure(found.rim_area)} {unit}², {figure(o.length[0])} {unit} long; {inner}"


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))


def print_tables(evaluation: Evaluation) -> None:
    """Print distances, pose errors and residuals as tables."""
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
