"""sl-eval: compare a mesh and its poses with a scan, and with the truth if it is known."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sl_nerfstudio.cli.lengths import print_lengths
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from sl_nerfstudio.evaluation.completeness.next_view import NextView
    from sl_nerfstudio.evaluation.evaluate import Evaluation
    from sl_nerfstudio.evaluation.inputs import EvaluationInputs
    from sl_nerfstudio.evaluation.lengths import PointPair

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
    f_distances: Annotated[tuple[float, ...], tyro.conf.arg(metavar="D [D ...]")] = ()
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


def evaluate_scan(config: EvalConfig) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can correct."""
    _check(config)
    from sl_nerfstudio.files.results import held_results
    from sl_nerfstudio.threads import one_library_thread

    marks = {path: mark for path, mark in ((config.json, _JSON_MARK), (config.report, _REPORT_MARK)) if path}
    with held_results(marks), one_library_thread():
        _evaluate(config)


def _evaluate(config: EvalConfig) -> None:
    from sl_nerfstudio.cli.evaluate_words import print_tables, summary
    from sl_nerfstudio.evaluation.evaluate import evaluate
    from sl_nerfstudio.evaluation.inputs import read_inputs
    from sl_nerfstudio.evaluation.judgement import judge
    from sl_nerfstudio.evaluation.lengths import measure_lengths, typical_sigma
    from sl_nerfstudio.evaluation.report.intrinsics_hint import intrinsics_hint
    from sl_nerfstudio.evaluation.report.thumbnails import ResidualThumbnails
    from sl_nerfstudio.evaluation.result_json import to_json
    from sl_nerfstudio.evaluation.training_steps import trained_steps
    from sl_nerfstudio.files.atomic import write_atomic

    pairs = _pairs(config)
    inputs = read_inputs(config.mesh, config.data, config.poses, config.reference, config.samples, config.seed)
    lengths = measure_lengths(pairs, inputs.mesh, inputs.quality, inputs.scan, inputs.poses, inputs.joint)
    thumbnails = ResidualThumbnails()
    evaluation = evaluate(
        inputs.mesh, inputs.scan, inputs.poses, inputs.reference, inputs.true_poses, config.f_distances,
        config.samples, config.seed, on_frame=thumbnails if config.report else None, sigma=inputs.stated_sigma,
        true_units=inputs.true_units,
    )  # fmt: skip
    hint, steps = intrinsics_hint(inputs.training, inputs.scan), trained_steps(inputs.training)
    capture = _next_capture(evaluation, inputs)
    sigma = typical_sigma(inputs.mesh, inputs.quality, inputs.scan, inputs.poses, inputs.joint)
    judgement = judge(evaluation, hint, steps, capture, inputs.unplaced, sigma, inputs.departed)
    results: dict[Path, str] = {}
    if config.json:
        document = to_json(evaluation, judgement.verdict, capture, lengths)
        results[config.json] = json.dumps(document, indent=2, allow_nan=False) + "\n"
    if config.report:
        from sl_nerfstudio.evaluation.report.report import ReportInput, render_report

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
    from sl_nerfstudio.evaluation.completeness.knowledge import View
    from sl_nerfstudio.evaluation.completeness.next_view import next_view
    from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh

    found = evaluation.completeness
    if found is None:
        return None
    poses = zip(inputs.poses.T_world_camera, inputs.poses.T_world_projector, strict=True)
    frames = [
        View(frame.camera, T_c, inputs.scan.projector, T_p)
        for frame, (T_c, T_p) in zip(inputs.scan.frames, poses, strict=True)
    ]
    return next_view(IndexedMesh(inputs.mesh), found.openings, frames, found.noise_px)


def _pairs(config: EvalConfig) -> "list[PointPair]":
    from sl_nerfstudio.evaluation.lengths import parse_pair, read_pairs

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
    run(lambda: evaluate_scan(tyro.cli(EvalConfig, prog="sl-eval")))


if __name__ == "__main__":
    main()
