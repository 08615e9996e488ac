"""How the figures of an evaluation are judged, what that makes of the verdict, and what to do next."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sl_nerfstudio.evaluation.advice import capture_next, disagreeing_frames
from sl_nerfstudio.evaluation.capture_agreement import FrameAgreement
from sl_nerfstudio.evaluation.completeness.figures import completeness_figures
from sl_nerfstudio.evaluation.completeness.next_view import NextView
from sl_nerfstudio.evaluation.evaluate import Evaluation
from sl_nerfstudio.evaluation.figures import JudgedFigure, judged
from sl_nerfstudio.evaluation.reference import MeshReference
from sl_nerfstudio.evaluation.training_steps import TrainedSteps, training_figure
from sl_nerfstudio.verdict.departed_frames import DepartedFrame, departed_reasons
from sl_nerfstudio.verdict.judge import cross_reasons
from sl_nerfstudio.verdict.settings import VerdictSettings
from sl_nerfstudio.verdict.verdict import Band, Reason, Verdict, worst

ALIGNED = {"rigid": "rigid alignment", "similarity": "alignment with scale"}
_ORDER: dict[str, int] = {"good": 0, "unknown": 1, "acceptable": 1, "poor": 2}


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
        """What to do, most urgent first; empty for a good scan that no further capture would complete."""
        bad = sorted((c for c in self.figures if _ORDER[c.band]), key=lambda c: -_ORDER[c.band])
        return [*self.hints, *(f"{c.name}: {c.advice}" for c in bad), *filter(None, [self.capture])]


def judge(
    evaluation: Evaluation,
    intrinsics: str = "",
    steps: TrainedSteps | None = None,
    capture: NextView | None = None,
    unplaced: Sequence[str] = (),
    length_sigma: float | None = None,
    departed: Sequence[DepartedFrame] = (),
) -> Judgement:
    """Judge an evaluation by fixed limits; `intrinsics` is what the training found wrong with them ("": nothing).

    `steps` says how long the surface was trained, None where that is not known, and `capture` what to capture next.
    `unplaced`: frames that the training could not place; a surface that they took part in is poor. `length_sigma`: 1
    sigma of distances across the surface, as a share of them (`lengths.typical_sigma`), None if it is not known.
    `departed`: frames that ended far from their starting poses.

    The agreement of the frames with each other is judged as sl-process and sl-check judge it.
    """
    fit = evaluation.agreement
    figures = [
        judged(
            "Coordinate residual", fit.coordinate_px_median, "{:.2f} px", 0.6, 1.5, "≤ {} px",
            "Median distance between where the surface puts a pattern point and where it was decoded.",
            "the surface does not match the captures: train longer, check the poses and the lens data, or decode "
            "again",
        ),
        judged(
            "Epipolar residual", fit.epipolar_px_median, "{:.2f} px", 0.5, 1.2, "≤ {} px",
            "Median distance of decoded points from their epipolar curve: it depends on the pose of each projector "
            "relative to its camera, and not on the surface.",
            "refine the poses (refine-poses free), and check the intrinsics of camera and projector",
        ),
        judged(
            "Pattern agreement", fit.pattern_cosine, "{:.3f}", 0.9, 0.75, "≥ {}",
            "Cosine between captured and rendered pattern over all lit pixels; 1 is identical up to brightness.",
            "look at the pictures below: blur, ambient light or a wrong pattern file reduce it",
        ),
        judged(
            "Coverage", 100 * fit.hit_share, "{:.1f} %", 97.0, 85.0, "≥ {} %",
            "Share of the pixels with pattern on the object at which the mesh has a surface.",
            "export with --keep-unobserved to see whether too much of the surface was removed; otherwise add frames "
            "that see the missing parts",
        ),
        *(judge_worst(figure, evaluation) for figure in WORST_FRAME),
        _geometry(evaluation),
        *([] if evaluation.completeness is None else completeness_figures(evaluation.completeness, evaluation.units)),
        *([] if steps is None else [training_figure(steps)]),
        *([] if length_sigma is None else [_lengths(length_sigma)]),
    ]  # fmt: skip
    if evaluation.reference is not None and evaluation.alignment in evaluation.surface:
        figures.insert(0, _accuracy(evaluation))
    reasons = [Reason(f.band, f"{f.name}: {f.text} (good: {f.good})") for f in figures if f.band != "unknown"]
    reasons += [Reason("acceptable", f"{f.name}: cannot be judged") for f in figures if f.band == "unknown"]
    names = [frame.name for frame in evaluation.agreement.frames]
    if evaluation.cross is not None:
        reasons += cross_reasons(names, evaluation.cross, VerdictSettings())
    reasons += [
        Reason("poor", f"{name}: could not be placed; leave it out or register it again, and train again")
        for name in unplaced
    ]
    reasons += departed_reasons([one for one in departed if one.name not in unplaced])
    verdict = worst(reasons)
    return Judgement(
        verdict, _sentence(verdict.band, evaluation), tuple(figures), _hints(evaluation, verdict.band, intrinsics),
        capture_next(evaluation, capture),
    )  # fmt: skip


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
        "look for strong error colours: if everywhere, check poses and scale; if in patches, add frames there",
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
        "if its pose or decoding is wrong, leave the frame out and train again",
    ),
    WorstFrameFigure(
        "Worst frame, 95 %", "coordinate_px_p95", True, 3.0, 6.0,
        "95 % of the coordinate residuals of a frame are smaller: its worst value, relative to the median frame.",
        "part of the frame contradicts the surface: look at its residual map",
    ),
    WorstFrameFigure(
        "Agreement in the worst frame", "agreeing_share", False, 85.0, 65.0,
        "Share of a frame's decoded pixels whose predicted coordinate lies within 4 sigma of the measured noise of the "
        "decoded one, but not less than a camera pixel.",
        "the surface does not match this frame: train longer, or check its pose",
    ),
    WorstFrameFigure(
        "Coverage of the worst frame", "covered_share", False, 90.0, 75.0,
        "Share of a frame's decoded pixels at which the mesh has a surface.",
        "export with --keep-unobserved to see what was removed; otherwise look for holes in the view of this frame",
    ),
    WorstFrameFigure(
        "Largest hole", "largest_hole", False, 0.5, 2.0,
        "Largest connected area of decoded pixels whose rays meet no surface near the measured point, in percent of "
        "the frame's decoded pixels; gaps along the rim do not count.",
        "the surface is missing where it was measured: train longer, or export with a finer resolution",
    ),
)  # fmt: skip


def judge_worst(figure: WorstFrameFigure, evaluation: Evaluation) -> JudgedFigure:
    """Judge the frame in which a figure is worst, by name."""
    sign = 1 if figure.good < figure.acceptable else -1
    frames = [f for f in evaluation.agreement.frames if math.isfinite(getattr(f, figure.key))]
    worst_frame: FrameAgreement | None = max(frames, key=lambda f: sign * getattr(f, figure.key), default=None)
    if worst_frame is None:
        value, name = math.nan, ""
    else:
        value, name = getattr(worst_frame, figure.key), worst_frame.name
    if figure.relative:
        usual = sorted(getattr(f, figure.key) for f in frames)[len(frames) // 2] if frames else math.nan
        value, form, limit = value / usual if usual > 0 else math.nan, "{:.1f} times the median", "{} times"
    else:
        value, form, limit = 100 * value, "{:.1f} %", "{} %"
    return judged(
        figure.name, value, f"{form} ({name})", figure.good, figure.acceptable, f"{'≤' if sign > 0 else '≥'} {limit}",
        figure.meaning, f"look at {name or 'it'} in the report: {figure.advice}",
    )  # fmt: skip


def _geometry(evaluation: Evaluation) -> JudgedFigure:
    fit = evaluation.agreement
    return judged(
        "Ray angle", fit.ray_angle_deg, "{:.1f}°", 8.0, 4.0, "≥ {}°",
        f"Angle between camera ray and projector ray on the surface (median). Here one pattern pixel corresponds to "
        f"{fit.depth_per_px:.3g} {evaluation.units} of depth; where that is a lot, a low residual proves little.",
        "hold the projector farther from the camera in the next scan, or keep the calibrated relative pose "
        "(refine-poses known-rig)",
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
    hints = []
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
