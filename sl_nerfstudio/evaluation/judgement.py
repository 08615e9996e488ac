"""How the figures of an evaluation are judged, what that makes of the verdict, and what to do next."""

import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import Any, Literal

from sl_nerfstudio.console import figure, unit_word
from sl_nerfstudio.evaluation.agreement import FrameAgreement
from sl_nerfstudio.evaluation.completeness import Completeness, NextView
from sl_nerfstudio.evaluation.evaluate import Evaluation, Length, SurfaceScore
from sl_nerfstudio.evaluation.inspection import Inspection
from sl_nerfstudio.evaluation.part_alignment import PartAlignment
from sl_nerfstudio.evaluation.reference import MeshReference, PoseErrors
from sl_nerfstudio.evaluation.shape_fits import FittedShape
from sl_nerfstudio.review.verdict import (
    Band,
    DepartedFrame,
    Help,
    Reason,
    Verdict,
    cross_reasons,
    departed_reasons,
    frame_band,
    listed,
    worst,
)
from sl_nerfstudio.scan import PoseSigma

# A figure with its judgement by two limits.


@dataclass(frozen=True)
class JudgedFigure:
    """One figure, with its judgement."""

    name: str
    value: float
    text: str  # the value with its unit
    band: Band | Literal["unknown"]  # unknown: the figure does not exist
    good: str  # the limit of "good", in words
    acceptable: str
    meaning: str
    advice: str  # what to do if it is not good


def judged(
    name: str, value: float, form: str, good: float, acceptable: float, limit: str, meaning: str, advice: str
) -> JudgedFigure:
    """Judge `value`; whether larger is better follows from the order of the limits."""
    sign = 1 if good < acceptable else -1
    band: Band | Literal["unknown"] = "poor"
    if not math.isfinite(value):
        band = "unknown"
    elif sign * value <= sign * good:
        band = "good"
    elif sign * value <= sign * acceptable:
        band = "acceptable"
    text = form.format(value) if math.isfinite(value) else "none"
    worst = limit.format(f"{acceptable:g}") if math.isfinite(acceptable) else "any"
    return JudgedFigure(name, value, text, band, limit.format(f"{good:g}"), worst, meaning, advice)


# The three figures that matter, without a judgement: for the console, and for the top of the report.

MAIN_FIGURES = ("surface", "captures", "coverage")
MainFigure = tuple[str, str, str]
"""What is said before a value, the value with its unit, and what is said after it."""


def main_figures(evaluation: Evaluation, sigma: Sequence[PoseSigma | None]) -> tuple[MainFigure, ...]:
    """Tell how true the surface is, how well it agrees with the captures, and how much of them it covers.

    `sigma` is what the evaluated poses state.
    """
    fit = evaluation.agreement
    captures = (
        "coordinates agree to",
        f"{fit.coordinate_px_median:.2g} px",
        f"(median), 95 % to {fit.coordinate_px_p95:.2g} px; worst frame: {_worst_frame(evaluation)}",
    )
    return _how_true(evaluation, sigma), captures, _how_complete(evaluation)


def _how_true(evaluation: Evaluation, sigma: Sequence[PoseSigma | None]) -> MainFigure:
    """Say how far it is from the truth, or else how well the poses are known."""
    if evaluation.alignment in evaluation.surface:
        score, unit = evaluation.surface[evaluation.alignment], evaluation.truth_units
        return (
            "",
            f"{score.accuracy.rmse:.3g} {unit}",
            f"from the truth (RMS, {ALIGNED[evaluation.alignment]}); the truth is {score.completeness.mean:.3g} {unit} "
            "from it (mean)",
        )
    known = [s for s in sigma if s is not None]
    if not known:
        return "no truth is known, and the poses do not state their uncertainty", "", ""
    length, turn = (
        math.sqrt(sum(v * v for v in values) / len(known))
        for values in ([s.camera_translation for s in known], [s.camera_rotation_deg for s in known])
    )
    value = f"{length:.2g} {unit_word(evaluation.units)}, {turn:.2g}°"
    return "no truth is known; cameras to", value, "(1 sigma)"


def _worst_frame(evaluation: Evaluation) -> str:
    frames = [f for f in evaluation.agreement.frames if math.isfinite(f.coordinate_px_p95)]
    if not frames:
        return "none"
    worst = max(frames, key=lambda f: f.coordinate_px_p95)
    return f"{worst.name}, {worst.coordinate_px_p95:.2g} px, {worst.covered_share:.0%} covered"


def _how_complete(evaluation: Evaluation) -> MainFigure:
    found = evaluation.completeness
    if found is None:
        return "", f"{evaluation.agreement.hit_share:.1%}", "of the pixels with pattern"
    o, unit = found.openings, unit_word(evaluation.units)
    text = "of what the frames decoded"
    if not len(o):
        return "", f"{found.observed:.1%}", f"{text}; closed all around"
    inner = f"{len(o) - 1} holes beside it ({figure(o.area[1:].sum())} {unit}²)" if len(o) > 1 else "no holes beside it"
    rim = f"rim of the scan {figure(found.rim_area)} {unit}², {figure(o.length[0])} {unit} long"
    return "", f"{found.observed:.1%}", f"{text}; {rim}; {inner}"


# How completeness is judged: by shares of what was observed, and of the surface.


def holes_figure(found: Completeness, units: str) -> JudgedFigure:
    """What nobody observed is at most a weakness."""
    o, unit = found.openings, unit_word(units)
    size = f"{len(o)}, {figure(o.area.sum())} {unit}² in all, borders {figure(o.length.sum())} {unit} long"
    return judged(
        "Holes", 100 * found.hole_share, f"{{:.1f}} % of the surface beside the rim (openings: {size})", 5.0,
        float("inf"), "≤ {} %",
        "Area of all places where the mesh ends, except for the largest one, the rim of the scan, as a share of "
        "the surface. Objects are closed: behind each of them is surface that no frame saw.",
        "capture what no frame saw; sl-export --fill-holes MM closes small ones",
    )  # fmt: skip


def coverage_figure(evaluation: Evaluation, commands: "FurtherCommands") -> JudgedFigure:
    """How much of what the frames observed the mesh has: over all, in the frame that lacks most, and in one place."""
    fit, found = evaluation.agreement, evaluation.completeness
    covered = min(fit.frames, key=lambda f: f.covered_share if math.isfinite(f.covered_share) else 1.0)
    hole = max(fit.frames, key=lambda f: f.largest_hole if math.isfinite(f.largest_hole) else 0.0)
    observed, part = math.nan if found is None else found.observed, partial(judged, "", meaning="", advice="")
    parts = [
        part(100 * fit.hit_share, "{:.1f} % of the pixels with pattern", 97.0, 85.0, "≥ {} %"),
        part(100 * observed, "{:.1f} % of what the frames decoded", 99.0, 96.0, "≥ {} %"),
        part(100 * covered.covered_share, f"{{:.0f}} % of what {covered.name} decoded", 90.0, 75.0, "≥ {} %"),
        part(100 * hole.largest_hole, f"largest gap {{:.1f}} % of {hole.name}", 0.5, 2.0, "≤ {} %"),
    ]
    known = [part for part in parts if part.band != "unknown"]
    worst_part = max(known, key=lambda part: _ORDER[part.band], default=parts[0])
    return replace(
        worst_part,
        name="Coverage",
        text=", ".join(part.text for part in known) or "none",
        good=", ".join(part.good for part in known),
        acceptable=", ".join(part.acceptable for part in known),
        meaning="Share of the pixels with pattern at which the mesh has a surface; of the decoded ones, near the "
        "measured point; the same in the frame that lacks most; and the largest connected area without a surface, in "
        "percent of its frame's decoded pixels. Gaps along the rim do not count for the last.",
        advice=f"surface is missing where it was measured: {commands.for_missing_surface}",
    )


# Commands that go on from what was evaluated, as far as they are known.


@dataclass(frozen=True)
class FurtherCommands:
    """Commands for the run that the mesh was exported from; "" where there is nothing to gain or nothing is known."""

    train: str = ""  # up to its last step
    export: str = "sl-export --load-config CONFIG --output MESH --resolution 1024"  # with finer cells

    @property
    def for_missing_surface(self) -> str:
        """What brings back surface that frames observed."""
        return f"train to the end: {self.train}" if self.train else f"export with finer cells: {self.export}"

    @property
    def for_disagreement(self) -> str:
        """What brings surface and captures together."""
        again = "train with --pipeline.model.refine-poses free, or decode again with sl-redecode --load-config CONFIG"
        return f"train to the end: {self.train}" if self.train else again


def further_commands(training: dict[str, Any] | None) -> FurtherCommands:
    """Read the commands that sl-export wrote to training.json; those that are usual where there are none."""
    found, steps = (training or {}).get("commands"), trained_steps(training)
    if not isinstance(found, dict):
        return FurtherCommands()
    train, export = (
        shlex.join(map(str, words)) if isinstance(words := found.get(key), list) else "" for key in ("train", "export")
    )
    complete = steps is not None and steps.done >= steps.wanted
    return FurtherCommands("" if complete else train, export or FurtherCommands.export)


# How long a surface was trained, against what is recommended.


@dataclass(frozen=True)
class TrainedSteps:
    """Steps of a training."""

    done: int
    wanted: int  # recommended for the method, or what the run was started with if that is more

    @property
    def share(self) -> float:
        """Part of the wanted steps that was done."""
        return self.done / self.wanted


def trained_steps(training: dict[str, Any] | None) -> TrainedSteps | None:
    """Read the steps from a training.json; None if it does not say."""
    settings = (training or {}).get("settings")
    if not isinstance(settings, dict):
        return None
    step, numbers = settings.get("step"), (settings.get("recommended_steps"), settings.get("schedule_iterations"))
    known = [n for n in numbers if isinstance(n, int) and n > 0]
    if not isinstance(step, int) or step < 0 or not known:
        return None
    return TrainedSteps(step + 1, max(known))


def training_figure(steps: TrainedSteps, commands: FurtherCommands) -> JudgedFigure:
    """Below a tenth of the steps a surface has not formed; in between it may be good, but the other figures decide."""
    return judged(
        "Training", 100 * steps.share, f"{{:.0f}} % ({steps.done} of {steps.wanted} steps)", 100.0, 10.0, "≥ {} %",
        "Steps of the training, compared with those that are recommended for the method, or with the run's own length.",
        f"train to the end: {commands.train or 'ns-train METHOD --data SCAN --load-dir RUN/nerfstudio_models'}",
    )  # fmt: skip


# What to do next, in words: frames to leave out or to capture again, and the capture that would add most.

_LARGE = {"coordinate_px_median": 2.0, "coordinate_px_p95": 3.0}  # multiples of the median frame's value
_LEAST_AGREEING = 0.85  # share of a frame's decoded pixels that agree with the surface within the noise
_MOST = 0.5  # of the frames: if more disagree, it is not them
_WORTH = 0.02  # of the surface and its openings that a capture must newly show to be proposed
_STEEP_DEG = 60.0  # above or below the horizon


def disagreeing_frames(evaluation: Evaluation) -> tuple[str, ...]:
    """Name all frames that contradict the others or the surface, in one sentence; none with starting poses."""
    if evaluation.starting_poses:
        return ()
    frames = evaluation.agreement.frames
    bad = {f.name for f in frames if _stands_out(f, frames)}
    if evaluation.cross is not None and evaluation.cross.pairs:
        judged = zip(frames, evaluation.cross.frames, strict=True)
        bad |= {f.name for f, one in judged if frame_band(one) != "good"}
    names = [f.name for f in frames if f.name in bad]
    if not names or len(names) > _MOST * len(frames):
        return ()
    several = len(names) > 1
    them = "them" if several else "it"
    return (f"{listed(names)} {'disagree' if several else 'disagrees'}: leave {them} out or capture {them} again",)


def _stands_out(frame: FrameAgreement, frames: tuple[FrameAgreement, ...]) -> bool:
    for key, factor in _LARGE.items():
        known = sorted(v for f in frames if math.isfinite(v := getattr(f, key)))
        if known and getattr(frame, key) > factor * known[len(known) // 2]:
            return True
    return frame.agreeing_share < _LEAST_AGREEING


def capture_next(evaluation: Evaluation, view: NextView | None) -> str:
    """Say where to capture next and what that would show; "" if nothing that no frame has seen would show."""
    found = evaluation.completeness
    if found is None or view is None:
        return ""
    whole = found.surface_area + float(found.openings.area.sum())
    if view.new_area < _WORTH * whole:
        return ""
    unit = unit_word(evaluation.units)
    nearest = evaluation.agreement.frames[view.nearest].name
    side, way = f"the side {view.nearest_deg:.0f}° from {nearest}, the nearest frame", "it"
    if view.elevation_deg < -_STEEP_DEG:
        side, way = "the underside", "it from below, or turn the object over"
    elif view.elevation_deg > _STEEP_DEG:
        side, way = "the top", "it from above"
    return (
        f"No frame sees {side}: capture {way}; this would show {view.new_area / view.unseen_area:.0%} of what no frame "
        f"has seen ({figure(view.new_area)} {unit}²)"
    )


ALIGNED = {"rigid": "rigid alignment", "similarity": "alignment with scale"}
_ORDER: dict[str, int] = {"good": 0, "unknown": 1, "acceptable": 1, "poor": 2}


HELP: dict[Help, str] = {
    "again": "leave it out of transforms.json and train again, or capture it again",
    "between": "capture views in between, and register all with sl-process",
    "poses": "train with --pipeline.model.refine-poses free, and evaluate the refined poses (--poses)",
}
"""What helps against what the frames say of each other, once there is a surface."""


@dataclass(frozen=True)
class Judgement:
    """The verdict, which is the worst judgement, and all judged figures."""

    verdict: Verdict
    sentence: str
    figures: tuple[JudgedFigure, ...]
    hints: tuple[str, ...] = ()  # explanations that come before the advice of the figures
    capture: str = ""  # the capture that would add most, "" if none would

    @property
    def next_steps(self) -> list[str]:
        """What to do besides what each reason says; empty for a good scan that no further capture would complete."""
        return [*self.hints, *filter(None, [self.capture])]


def judge(
    evaluation: Evaluation,
    intrinsics: str = "",
    steps: TrainedSteps | None = None,
    capture: NextView | None = None,
    unplaced: Sequence[str] = (),
    length_sigma: float | None = None,
    departed: Sequence[DepartedFrame] = (),
    commands: FurtherCommands = FurtherCommands(),
) -> Judgement:
    """Judge an evaluation by fixed limits; `intrinsics` is what the training found wrong with them ("": nothing).

    `steps` says how long the surface was trained, None where that is not known, and `capture` what to capture next.
    `unplaced`: frames that the training could not place; a surface that they took part in is poor. `length_sigma`: 1
    sigma of distances across the surface, as a share of them (`lengths.typical_sigma`), None if it is not known.
    `departed`: frames that ended far from their starting poses. `commands`: to go on from here.

    The agreement of the frames with each other is judged as sl-process and sl-check judge it.
    """
    fit = evaluation.agreement
    figures = [
        judged(
            "Coordinate residual", fit.coordinate_px_median, "{:.2f} px", 0.6, 1.5, "≤ {} px",
            "Median distance between where the surface puts a pattern point and where it was decoded.",
            f"the surface does not match the captures: {commands.for_disagreement}",
        ),
        judged(
            "Epipolar residual", fit.epipolar_px_median, "{:.2f} px", 0.5, 1.2, "≤ {} px",
            "Median distance of decoded points from their epipolar curve: it depends on the pose of each projector "
            "relative to its camera, and not on the surface.",
            "train with --pipeline.model.refine-poses free, and calibrate the devices again with sl-calibrate",
        ),
        judged(
            "Pattern agreement", fit.pattern_cosine, "{:.3f}", 0.9, 0.75, "≥ {}",
            "Cosine between captured and rendered pattern over all lit pixels; 1 is identical up to brightness.",
            "look at the pictures of --report FILE.html: blur, ambient light or a wrong pattern file reduce "
            "it; capture in less room light",
        ),
        coverage_figure(evaluation, commands),
        *(judge_worst(figure, evaluation, commands) for figure in WORST_FRAME),
        _geometry(evaluation),
        *([] if evaluation.completeness is None else [holes_figure(evaluation.completeness, evaluation.units)]),
        *([] if steps is None else [training_figure(steps, commands)]),
        *([] if length_sigma is None else [_lengths(length_sigma)]),
    ]  # fmt: skip
    if evaluation.reference is not None and evaluation.alignment in evaluation.surface:
        figures.insert(0, _accuracy(evaluation))
    reasons = [
        Reason(f.band, f"{f.name}: {f.text} (good: {f.good}); {f.advice}") for f in figures if f.band != "unknown"
    ]
    reasons += [Reason("acceptable", f"{f.name}: cannot be judged; {f.advice}") for f in figures if f.band == "unknown"]
    reasons = [*(fault.reason for fault in evaluation.mesh_faults), *reasons]
    names = [frame.name for frame in evaluation.agreement.frames]
    if evaluation.cross is not None:
        reasons += cross_reasons(names, evaluation.cross)
    reasons += [Reason("poor", f"{name}: could not be placed", "again") for name in unplaced]
    reasons += departed_reasons([one for one in departed if one.name not in unplaced])
    verdict = worst(reasons).with_help(HELP)
    sentence, hints = _sentence(verdict.band, evaluation), _hints(evaluation, verdict.band, intrinsics)
    return Judgement(verdict, sentence, tuple(figures), hints, capture_next(evaluation, capture))


def _accuracy(evaluation: Evaluation) -> JudgedFigure:
    reference = evaluation.reference
    score = evaluation.surface[evaluation.alignment]
    exact = isinstance(reference, MeshReference)
    rmse = score.accuracy.rmse if exact else score.completeness.rmse
    percent = 100 * rmse / reference.size if reference is not None else math.nan
    way = "of the surface from the truth" if exact else "of the reference points from the surface"
    return judged(
        "Accuracy" if exact else "Distance from reference", percent,
        f"{{:.2f}} % of the size ({rmse:.3g} {evaluation.truth_units})", 0.25, 1.0,
        "≤ {} %", f"RMS distance {way} after {ALIGNED[evaluation.alignment]}, in percent of the size of the reference.",
        "look for error colours in the report: if everywhere, check the scale (--known-length of sl-process) and "
        "the unit of the reference; if in patches, capture frames there",
    )  # fmt: skip


@dataclass(frozen=True)
class WorstFrameFigure:
    """A figure that is judged in the frame where it is worst."""

    name: str
    key: str  # of FrameAgreement
    relative: bool  # judged as a multiple of the median frame's value
    good: float
    acceptable: float
    meaning: str
    advice: str


WORST_FRAME = (
    WorstFrameFigure(
        "Worst frame", "coordinate_px_median", True, 2.0, 4.0,
        "Median coordinate residual of the worst frame, relative to the median frame: no frame should contradict the "
        "others.",
        "if its pose or decoding is wrong, leave it out of transforms.json and train again",
    ),
    WorstFrameFigure(
        "Worst frame, 95 %", "coordinate_px_p95", True, 3.0, 6.0,
        "95 % of the coordinate residuals of a frame are smaller: its worst value, relative to the median frame.",
        "part of the frame contradicts the surface; if it is its pose, leave it out of transforms.json and train again",
    ),
    WorstFrameFigure(
        "Agreement in the worst frame", "agreeing_share", False, 85.0, 65.0,
        "Share of a frame's decoded pixels whose predicted coordinate lies within 4 sigma of the measured noise of the "
        "decoded one, but not less than a camera pixel.",
        "the surface does not match this frame: {disagrees}",
    ),
)  # fmt: skip


def judge_worst(figure: WorstFrameFigure, evaluation: Evaluation, commands: FurtherCommands) -> JudgedFigure:
    """Judge the frame in which a figure is worst, by name."""
    sign = 1 if figure.good < figure.acceptable else -1
    every = [(getattr(f, figure.key), f.name) for f in evaluation.agreement.frames]
    known = [(value, name) for value, name in every if math.isfinite(value)]
    value, name = max(known, key=lambda one: sign * one[0], default=(math.nan, ""))
    if figure.relative:
        usual = sorted(one for one, _ in known)[len(known) // 2] if known else math.nan
        value, form, limit = value / usual if usual > 0 else math.nan, "{:.1f} times the median", "{} times"
    else:
        value, form, limit = 100 * value, "{:.1f} %", "{} %"
    return judged(
        figure.name, value, f"{form} ({name})", figure.good, figure.acceptable, f"{'≤' if sign > 0 else '≥'} {limit}",
        figure.meaning,
        f"look at {name or 'it'} in the report: {figure.advice.format(disagrees=commands.for_disagreement)}",
    )  # fmt: skip


def _geometry(evaluation: Evaluation) -> JudgedFigure:
    fit = evaluation.agreement
    return judged(
        "Ray angle", fit.ray_angle_deg, "{:.1f}°", 8.0, 4.0, "≥ {}°",
        f"Angle between camera ray and projector ray on the surface (median). Here one pattern pixel corresponds to "
        f"{fit.depth_per_px:.3g} {unit_word(evaluation.units)} of depth; where that is a lot, a low residual proves "
        "little.",
        "hold the projector farther from the camera in the next scan, or keep the calibrated relative pose "
        "(--pipeline.model.refine-poses known-rig)",
    )  # fmt: skip


def _lengths(sigma: float) -> JudgedFigure:
    """Intrinsics that nobody has stated are good to 0.5 %: no scan needs to know its lengths better than those."""
    return judged(
        "Sigma of lengths", 100 * sigma, "{:.2f} %", 0.5, 2.0, "≤ {} %",
        "Stated 1 sigma of distances across the surface, as a share of them (median); from poses, intrinsics, noise.",
        "state how well the intrinsics are known (--pipeline.model.prior.intrinsics), or add frames that overlap "
        "with the others from other directions",
    )  # fmt: skip


def _hints(evaluation: Evaluation, band: Band, intrinsics: str) -> tuple[str, ...]:
    hints = [fault.advice for fault in evaluation.mesh_faults]
    if _ORDER[band] and evaluation.starting_poses:
        hints.append(
            "These figures are for the scan's starting poses: if the surface was trained with refined ones, "
            "add them with --poses"
        )
    if intrinsics:
        hints.append(intrinsics)
    return (*hints, *disagreeing_frames(evaluation))


def _sentence(band: Band, evaluation: Evaluation) -> str:
    evidence = "judged by the reference and by its agreement with the captures"
    if evaluation.reference is None:
        evidence = (
            "judged by its agreement with the captures alone: no truth is known, so errors common to all frames do not "
            "show"
        )
    start = {
        "good": "The surface matches the captures, and nothing is conspicuous",
        "acceptable": "The scan is usable; some figures are weaker than they could be",
        "poor": "At least one figure shows that something is wrong",
    }[band]
    return f"{start} ({evidence})."


# The evaluation as JSON.


def to_json(
    evaluation: Evaluation,
    verdict: Verdict,
    capture: NextView | None = None,
    lengths: Sequence[Length] = (),
    inspection: Inspection | None = None,
    placed: PartAlignment | None = None,
    fits: Sequence[FittedShape] = (),
) -> dict[str, Any]:
    """A plain dict for `json.dump`; figures that do not exist are null, blocks that do not exist are absent.

    `rigid`, `similarity` and `none` hold the distances under each alignment; `camera` and `projector` the
    errors of the evaluated poses and `initial` those of the scan's own, all in `truth_units`. `fit`, the agreement with
    the captures, is always there, and so are `verdict` and `reasons`. `coverage` says what the surface lacks and what
    to capture next; `cross_frame` is the agreement of the frames with each other, `lengths` and `fits` are the
    distances and shapes that were asked for. `inspection` has the deviations from a nominal part, `part` where the
    surface lies on it and what its shape leaves open.
    """
    reference, errors, initial = evaluation.reference, evaluation.pose_errors, evaluation.initial_pose_errors
    found, cross = evaluation.completeness, evaluation.cross
    blocks = {
        "format": 1,
        "verdict": verdict.band,
        "reasons": list(verdict.reasons),
        "units": evaluation.units,
        "truth_units": None if reference is None and errors is None else evaluation.truth_units,
        "reference": None if reference is None else reference.description,
        **{name: _surface(score) for name, score in evaluation.surface.items()},
        **({} if errors is None else _poses(errors)),
        "initial": None if initial is None else _poses(initial),
        "fit": asdict(evaluation.agreement),
        "coverage": None if found is None else _coverage(found) | {"next_capture": _capture(capture)},
        "cross_frame": None if cross is None else {k: v for k, v in asdict(cross).items() if k != "pairs"},
        "lengths": [asdict(length) for length in lengths] or None,
        "inspection": None if inspection is None else _inspection(inspection),
        "part": None if placed is None else _placed(placed),
        "fits": [asdict(fit) for fit in fits] or None,
    }
    return _finite({name: block for name, block in blocks.items() if block is not None})


def _inspection(found: Inspection) -> dict[str, Any]:
    """Everything but the arrays of the vertices."""
    plain = {f.name: getattr(found, f.name) for f in fields(found) if f.name not in ("deviation", "sigma", "patches")}
    plain["S_part_mesh"] = found.S_part_mesh.matrix().tolist()
    return {**plain, "patches": [asdict(patch) for patch in found.patches]}


def _placed(found: PartAlignment) -> dict[str, Any]:
    motions = found.open_motions
    return {
        "fits": found.fits,
        "in_place": found.in_place,
        "rms_of_nearest_80_percent": found.rms,
        "rms_at_next_place": found.next_rms,
        "open_turns": motions.turns.tolist(),
        "open_shifts": motions.shifts.tolist(),
        "open_turns_about": motions.point.tolist() if len(motions.turns) else None,
        "equal_turns": [R.tolist() for R in found.equal_turns],
    }


def _coverage(found: Completeness) -> dict[str, Any]:
    o = found.openings
    openings = {
        "count": len(o),
        "area": float(o.area.sum()),
        "boundary_length": float(o.length.sum()),
        "largest_area": found.rim_area,
        "largest_boundary_length": float(o.length[:1].sum()),
    }
    return {"observed": found.observed, "surface_area": found.surface_area, "openings": openings}


def _capture(view: NextView | None) -> dict[str, Any] | None:
    if view is None:
        return None
    return {
        "transform_matrix": view.T_world_camera.tolist(),
        "projector_transform_matrix": view.T_world_projector.tolist(),
        "new_area": view.new_area,
        "unseen_area": view.unseen_area,
        "removed_share": view.removed,
        "degrees_from_nearest_frame": view.nearest_deg,
        "elevation_deg": view.elevation_deg,
    }


def _surface(score: SurfaceScore) -> dict[str, Any]:
    return {
        "accuracy": asdict(score.accuracy),
        "completeness": asdict(score.completeness),
        "chamfer": score.chamfer,
        "f_score": {f"{distance:g}": value for distance, value in score.f_score.items()},
        "scale": score.scale,
        "matrix": score.S_truth_result.matrix().tolist(),
    }


def _poses(errors: PoseErrors) -> dict[str, Any]:
    devices = {"camera": errors.camera, "projector": errors.projector, "relative": errors.relative}
    blocks: dict[str, Any] = {
        name: {
            "translation_rmse": one.translation_rmse,
            "rotation_rmse_deg": one.rotation_rmse_deg,
            "translation": one.translation.tolist(),
            "rotation_deg": one.rotation_deg.tolist(),
        }
        for name, one in devices.items()
    }
    return {**blocks, "scale_error": errors.scale_error}


def _finite(value: Any) -> Any:
    """JSON knows neither NaN nor infinity."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
