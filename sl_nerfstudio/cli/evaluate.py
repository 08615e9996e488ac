"""sl-eval: compare a mesh and its poses with a scan, and with the truth if it is known."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sl_nerfstudio.cli.arguments import SCAN, parse
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.console import paragraph, phase, unit_word
from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from numpy import ndarray

    from sl_nerfstudio.evaluation.completeness import NextView
    from sl_nerfstudio.evaluation.evaluate import Evaluation, EvaluationInputs, Length, PointPair
    from sl_nerfstudio.evaluation.inspection import Inspection
    from sl_nerfstudio.evaluation.judgement import Judgement
    from sl_nerfstudio.evaluation.part_alignment import PartAlignment
    from sl_nerfstudio.evaluation.report.charts import ColourLayer
    from sl_nerfstudio.evaluation.shape_fits import FittedShape
    from sl_nerfstudio.meshing.mesh import Mesh
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


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; columns without a name are aligned to the left."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for column in columns:
        table.add_column(column, justify="right" if column.strip() else "left")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def print_tables(evaluation: "Evaluation") -> None:
    """Print distances, pose errors and residuals as tables."""
    units = evaluation.truth_units
    if evaluation.surface:
        rows = []
        for name, score in evaluation.comparable.items():
            a, c = score.accuracy, score.completeness
            chamfer, scale = f"{score.chamfer:.3g}", f"{score.scale:.5f}"
            rows += [
                (name, "accuracy", *(f"{v:.3g}" for v in (a.mean, a.median, a.rmse, a.p95)), chamfer, scale),
                ("", "completeness", *(f"{v:.3g}" for v in (c.mean, c.median, c.rmse, c.p95)), "", ""),
            ]
        columns = ("", " ", "mean", "median", "RMS", "95 %", "Chamfer", "scale")
        print_table(f"Distances in {units}", columns, rows)
    rows, poses = [], {"initial poses": evaluation.initial_pose_errors, "evaluated poses": evaluation.pose_errors}
    for name, errors in poses.items():
        if errors is not None:
            both = (errors.camera, errors.projector)
            values = [v for device in both for v in (device.translation_rmse, device.rotation_rmse_deg)]
            rows.append((name, *(f"{v:.3g}" for v in values), f"{100 * errors.scale_error:+.3f} %"))
    if rows:
        print_table(f"Pose errors, RMS, in {units}", ("", "camera", "deg", "projector", "deg", "scale"), rows)
    agreement = evaluation.agreement
    figures = {
        "coordinates px (median)": f"{agreement.coordinate_px_median:.3f}",
        "95 %": f"{agreement.coordinate_px_p95:.3f}",
        "epipolar px (median)": f"{agreement.epipolar_px_median:.3f}",
        "pattern cosine": f"{agreement.pattern_cosine:.4f}",
        "covered": f"{agreement.hit_share:.1%}",
        "worst hole": f"{max(frame.largest_hole for frame in agreement.frames):.1%}",
    }
    print_table("Agreement with the captures", [*figures], [[*figures.values()]])


# What sl-eval prints of the distances that were asked for.


def print_lengths(lengths: "Sequence[Length]", units: str) -> None:
    """A table, and why a distance has no uncertainty."""
    if not lengths:
        return
    rows = []
    for length in lengths:
        sigmas = (length.sigma, length.sigma_shared, length.sigma_independent)
        rows.append((length.name, f"{length.length:.5g}", *("-" if s is None else f"{s:.2g}" for s in sigmas)))
    columns = ("", "distance", "1 sigma", "from poses", "from noise")
    print_table(f"Distances between points, in {units}", columns, rows)
    for reason in dict.fromkeys(filter(None, map(why_unknown, lengths))):
        print(f"  {reason}")


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


# What sl-eval prints of a part that was inspected: its place, its deviations, and fitted shapes.


def print_inspection(
    found: "Inspection", placed: "PartAlignment | None", name: str, unit: str, factor: float = 1.0
) -> None:
    """Where the surface lies on the part, how far it deviates, and where it is out of tolerance.

    Lengths times `factor` are in `unit`.
    """
    words = [] if placed is None else _place_words(placed, name, unit, factor)
    for line in [*words, *_inspection_notes(found, unit, factor)]:
        print(paragraph("part", line))
    columns = ("mean", "median", "RMS", "1 % below", "1 % above", "1 sigma (median)")
    values = (found.mean, found.median, found.rms, found.lowest, found.highest, found.median_sigma)
    row = ["-" if v is None else f"{factor * v:.3g}" for v in values]
    print_table(f"Deviations from {name} in {unit}; outside is positive", columns, [row])
    if found.within is None or found.tolerance is None or found.out is None or found.undecided is None:
        return
    row = [f"{share:.2%}" for share in (found.within, found.undecided, found.out)]
    title = f"Tolerance ±{factor * found.tolerance:.4g} {unit}, of the measured area"
    print_table(title, ("within", "undecided", "out of tolerance"), [row])
    if not found.patches:
        return
    rows = []
    for patch in found.patches:
        sigma = "-" if patch.sigma is None else f"{factor * patch.sigma:.2g}"
        place = ", ".join(f"{factor * v:.4g}" for v in patch.place)
        heights = (f"{factor * v:+.3g}" for v in (patch.mean, patch.height))
        rows.append((place, *heights, sigma, f"{factor**2 * patch.area:.3g}"))
    print_table(f"Out of tolerance, at x, y, z of {name}", ("x, y, z", "mean", "largest", "1 sigma", "area"), rows)


def _place_words(placed: "PartAlignment", name: str, unit: str, factor: float) -> list[str]:
    """Say how the surface came to its place, and what of the place its shape leaves open."""
    if not placed.fits:
        return [
            f"the surface fits {name} nowhere to 1 % of its size ({factor * placed.rms:.3g} {unit} RMS at the best "
            "place), so it stays in its own axes: what follows compares two different things"
        ]
    where = "lies in its axes" if placed.in_place else f"placed on {name} by its shape"
    rival = "" if placed.next_rms is None else f"; at the next best place {factor * placed.next_rms:.3g} {unit}"
    lines = [f"{where}: {factor * placed.rms:.3g} {unit} RMS of the nearest 80 %{rival}"]
    motions = placed.open_motions
    if len(motions.turns) == 1:
        lines.append(
            f"the turn about its axis {_vector(motions.turns[0])} through {_vector(factor * motions.point)} is open"
        )
    elif len(motions.turns):
        lines.append(f"every turn about {_vector(factor * motions.point)} is open")
    if len(motions.shifts):
        lines.append(f"the shift along {' and '.join(map(_vector, motions.shifts))} is open")
    if placed.equal_turns:
        lines.append(
            f"it fits equally well in {len(placed.equal_turns) + 1} ways"
            f"{', apart from what is open' if motions else ''}; also turned by {_turn_words(placed.equal_turns)}"
        )
    if motions or placed.equal_turns:
        lines.append("deviations of the one part may be shown at another place that looks the same: mark the part")
    return lines


_TURNS_SHOWN = 3


def _turn_words(turns: "Sequence[ndarray]") -> str:
    from scipy.spatial.transform import Rotation

    words = []
    for R in turns[:_TURNS_SHOWN]:
        w = Rotation.from_matrix(R).as_rotvec(degrees=True)
        angle = float((w @ w) ** 0.5)
        words.append(f"{angle:.0f}° about {_vector(w / max(angle, 1e-9))}")
    more = len(turns) - len(words)
    return ", ".join(words) + (f", and {more} more" if more else "")


def _vector(v: "ndarray") -> str:
    return "(" + ", ".join(f"{round(float(x), 2) + 0.0:g}" for x in v) + ")"


def _inspection_notes(found: "Inspection", unit: str, factor: float) -> list[str]:
    notes = []
    if found.median_sigma is None:
        notes.append(
            "the mesh states no uncertainty, so deviations count as they are (mesh.ply of sl-export states it)"
        )
    elif found.unmeasured > 0.001:
        notes.append(f"{found.unmeasured:.1%} of the surface is confirmed by no frame, and counts nowhere below")
    if found.facet_error > 0.1 * (found.tolerance or found.rms):
        notes.append(
            f"the file's facets are {factor * found.facet_error:.2g} {unit} (RMS) from the curved surfaces that they "
            "stand for: export the part with finer facets"
        )
    return notes


def print_fits(fits: "Sequence[FittedShape]", unit: str) -> None:
    """A table of fitted shapes, each value with its 1 sigma."""
    if not fits:
        return
    rows = []
    for fit in fits:
        diameter = "-" if fit.radius is None else f"{2 * fit.radius:.6g} ± {2 * (fit.sigma_radius or 0):.2g}"
        direction = "-" if fit.direction is None else ", ".join(f"{round(x, 4) + 0.0:g}" for x in fit.direction)
        turn = "" if fit.sigma_direction_deg is None else f" ± {fit.sigma_direction_deg:.2g}°"
        centre = f"{', '.join(f'{v:.5g}' for v in fit.point)} ± {fit.sigma_point:.2g}"
        rows.append((fit.region.name, fit.region.kind, diameter, centre, direction + turn, f"{fit.rms:.2g}"))
    columns = ("", "shape", "diameter", "centre", "direction", "form (RMS)")
    print_table(f"Fitted shapes, in {unit} and the mesh's axes (± 1 sigma)", columns, rows)
    if any(fit.radius is not None and not fit.shared for fit in fits):
        said = (
            "diameters: sigma has what the surface shows, not the errors of poses and intrinsics; for those give "
            "mesh.ply of sl-export, and --poses with the folder that the same sl-export wrote"
        )
        print(paragraph("fits", said))


# By which earlier results are known.
_JSON_MARK, _REPORT_MARK, _PLY_MARK = b'"format": 1,\n  "verdict"', b"<title>Scan report: ", b"comment deviations from"


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
    """Compare with this instead of ground_truth/mesh.ply: a mesh (of CAD, in any axes: the surface is placed on it by
    its shape), or points in an .npz file under the key `xyz`."""
    reference_unit: Literal["m", "cm", "mm", "um"] | None = None
    """Unit of the reference mesh; default: mm for .stl, m for .glb, else that of the scan."""
    tolerance: str | None = None
    """Largest deviation from the reference that is allowed on either side, such as "0.1 mm"; says which share of the
    surface is within, and what is out of it by more than 2 sigma."""
    deviations: Path | None = None
    """Where to write the surface in the reference's axes with deviations in colour (.ply)."""
    fit: Annotated[tuple[str, ...], tyro.conf.arg(metavar='"SHAPE P R"')] = ()
    """Shapes to fit to the surface within R of a point P on it: "cylinder 12.5,-3,40 8", also plane and sphere, in the
    unit and axes of the mesh; or "bore: cylinder 12.5,-3,40 8"."""
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
    "what is compared": ("poses", "reference", "reference_unit", "f_distances"),
    "what is measured": ("tolerance", "fit", "distance", "distances"),
    "what is written": ("json", "report", "deviations", "verbose"),
}


def evaluate_scan(config: EvalConfig) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can correct."""
    _check(config)
    from sl_nerfstudio.parallel import one_library_thread
    from sl_nerfstudio.storage import held_results

    outputs = ((config.json, _JSON_MARK), (config.report, _REPORT_MARK), (config.deviations, _PLY_MARK))
    marks = {path: mark for path, mark in outputs if path}
    with held_results(marks), one_library_thread():
        _evaluate(config)


def _evaluate(config: EvalConfig) -> None:
    with phase("read"):
        from sl_nerfstudio.evaluation.evaluate import evaluate, measure_lengths, read_inputs, typical_sigma
        from sl_nerfstudio.evaluation.inspection import inspect
        from sl_nerfstudio.evaluation.judgement import further_commands, judge, to_json, trained_steps
        from sl_nerfstudio.evaluation.reference import MeshReference
        from sl_nerfstudio.evaluation.report.scan_report import ResidualThumbnails, intrinsics_hint
        from sl_nerfstudio.evaluation.shape_fits import fit_shape, parse_region
        from sl_nerfstudio.storage import write_atomic

        pairs = _pairs(config)
        regions = [parse_region(text) for text in config.fit]
        inputs = read_inputs(
            config.mesh, config.data, config.poses, config.reference, config.samples, config.seed,
            config.reference_unit,
        )  # fmt: skip
        tolerance = _tolerance(config, inputs)
    thumbnails = ResidualThumbnails()
    with phase("measure"):
        lengths = measure_lengths(pairs, inputs.mesh, inputs.quality, inputs.scan, inputs.poses, inputs.joint)
        evaluation = evaluate(
            inputs.mesh, inputs.scan, inputs.poses, inputs.reference, inputs.true_poses, config.f_distances,
            config.samples, config.seed, on_frame=thumbnails if config.report else None, sigma=inputs.stated_sigma,
            true_units=inputs.true_units,
        )  # fmt: skip
        inspected = None
        wanted = config.reference is not None or tolerance is not None or config.deviations is not None
        if wanted and isinstance(evaluation.reference, MeshReference):
            S, part = evaluation.surface[evaluation.alignment].S_truth_result, evaluation.reference.surface.mesh
            inspected = inspect(inputs.mesh, part, S, tolerance, inputs.quality)
        fits = [fit_shape(region, inputs.mesh, inputs.scan, inputs.poses, inputs.joint) for region in regions]
        sigma = typical_sigma(inputs.mesh, inputs.quality, inputs.scan, inputs.poses, inputs.joint)
    with phase("advise"):
        capture = _next_capture(evaluation, inputs)
    hint, steps = intrinsics_hint(inputs.training, inputs.scan), trained_steps(inputs.training)
    judgement = judge(
        evaluation, hint, steps, capture, inputs.unplaced, sigma, inputs.departed, further_commands(inputs.training)
    )
    results: dict[Path, bytes] = {}
    if config.json:
        document = to_json(evaluation, judgement.verdict, capture, lengths, inspected, inputs.placed, fits)
        results[config.json] = (json.dumps(document, indent=2, allow_nan=False) + "\n").encode()
    if config.report:
        from sl_nerfstudio.evaluation.report.scan_report import ReportInput, render_report

        layers = [] if inspected is None else _layers(inspected, evaluation.truth_units)
        page = ReportInput(
            evaluation, judgement, inputs, thumbnails.frames, config.mesh.name, lengths=lengths, layers=layers
        )
        results[config.report] = render_report(page).encode()
    name = "the truth" if config.reference is None else config.reference.name
    if config.deviations and inspected is not None:
        results[config.deviations] = _deviations_file(inputs.mesh, inspected, name, evaluation.truth_units)
    for path, content in results.items():
        write_atomic(path, content)
    if config.verbose:
        print_tables(evaluation)
    if inspected is not None:
        unit, factor = _shown_unit(config, evaluation.truth_units)
        print_inspection(inspected, inputs.placed, name, unit, factor)
    print_fits(fits, unit_word(inputs.scan.units))
    print_lengths(lengths, inputs.scan.units)
    print(summary(evaluation, judgement, inputs.pose_sigma, config.report))
    for path in results:
        print(f"written: {path}")


def _tolerance(config: EvalConfig, inputs: "EvaluationInputs") -> float | None:
    """The tolerance in the unit of the truth. Raises UserError if there is nothing to which it could apply."""
    from sl_nerfstudio.evaluation.reference import MeshReference
    from sl_nerfstudio.scan.lengths import parse_length
    from sl_nerfstudio.scan.types import UNITS

    wanted = "--deviations" if config.tolerance is None else "--tolerance"
    if (config.tolerance or config.deviations) and not isinstance(inputs.reference, MeshReference):
        problem = "points have no inside" if inputs.reference is not None else "there is no nominal surface"
        raise UserError(
            f"{wanted}: {problem}, so signed deviations are not known\n"
            f"    cause:  {config.reference or config.data / 'ground_truth'} has no mesh\n"
            "    remedy: give the part's mesh with --reference"
        )
    if config.tolerance is None:
        return None
    length = parse_length(config.tolerance, f"--tolerance {config.tolerance}", 1e-9, 10.0)
    unit = inputs.scan.units if inputs.scan.units != "arbitrary" else inputs.true_units
    metres = UNITS.get(unit or "arbitrary")
    if metres is None:
        raise UserError(
            f"--tolerance {config.tolerance}: the lengths of {config.reference or 'the truth'} have no unit\n"
            "    cause:  neither the scan nor the file states one\n    remedy: add --reference-unit mm"
        )
    return length.metres / metres


def _shown_unit(config: EvalConfig, unit: str) -> tuple[str, float]:
    """The unit in which the tolerance was typed, else that of the truth, and the factor from the latter."""
    from sl_nerfstudio.scan.lengths import METRES, parse_length

    metres = METRES.get(unit)
    if config.tolerance is None or metres is None:
        return unit_word(unit), 1.0
    typed = parse_length(config.tolerance, "--tolerance", 0.0, math.inf).unit
    return typed, metres / METRES[typed]


def _layers(found: "Inspection", unit: str) -> "list[ColourLayer]":
    """What the report shows of a tolerance."""
    import numpy as np

    from sl_nerfstudio.evaluation.report.charts import ColourLayer, ColourScale, nice_limit

    if found.tolerance is None:
        return []
    beyond = found.beyond()
    limit = nice_limit(max(float(np.abs(beyond).max()), found.tolerance / 2))
    return [ColourLayer("out of tolerance", beyond, ColourScale("RdBu_r", -limit, limit), unit)]


def _deviations_file(mesh: "Mesh", found: "Inspection", name: str, unit: str) -> bytes:
    """The surface in the part's axes, in colours that its header explains."""
    import numpy as np

    from sl_nerfstudio.evaluation.inspection import deviation_colours
    from sl_nerfstudio.evaluation.report.charts import nice_limit
    from sl_nerfstudio.meshing.files import DEVIATIONS, encode_deviations

    limit = 2 * found.tolerance if found.tolerance else nice_limit(max(abs(found.lowest), abs(found.highest)))
    notes = [
        f"{DEVIATIONS} {name.encode('ascii', 'replace').decode()}, in its axes; lengths in {unit}",
        f"colours: blue -{limit:g} or less (too little material), green 0, red +{limit:g} or more (too much)",
    ]
    sigma = np.full(len(found.deviation), np.nan) if found.sigma is None else found.sigma
    colours = deviation_colours(found.deviation, limit)
    return encode_deviations(mesh.mapped(found.S_part_mesh), found.deviation, sigma, colours, notes)


def _next_capture(evaluation: "Evaluation", inputs: "EvaluationInputs") -> "NextView | None":
    from sl_nerfstudio.evaluation.completeness import next_view
    from sl_nerfstudio.evaluation.mesh_index import IndexedMesh, capture_views

    found = evaluation.completeness
    if found is None:
        return None
    views = capture_views(inputs.scan, inputs.poses)
    return next_view(IndexedMesh(inputs.mesh), found.openings, views, found.noise_px)


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
    outputs = {"--json": config.json, "--report": config.report, "--deviations": config.deviations}
    given = [(flag, path) for flag, path in outputs.items() if path]
    for (one, path), (other, second) in combinations(given, 2):
        if path.absolute() == second.absolute():
            raise UserError(f"{one} and {other}: both are {path}\n    remedy: give two files")
    if config.deviations and config.deviations.suffix.lower() != ".ply":
        raise UserError(f"--deviations {config.deviations}: is no .ply file\n    remedy: end the name in .ply")
    if config.reference_unit and config.reference is None:
        raise UserError("--reference-unit: there is no --reference\n    remedy: give the part's mesh with --reference")
    if config.reference and config.reference.suffix.lower() == ".npy":
        raise UserError(
            f"--reference: {config.reference} is an .npy file\n    remedy: give an .npz file with the key xyz"
        )


def main() -> None:
    """Entry point of `sl-eval`."""
    run(lambda: evaluate_scan(parse(EvalConfig, "sl-eval", _INPUTS, _GROUPS)))


if __name__ == "__main__":
    main()
