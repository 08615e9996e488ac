"""Good, acceptable or poor: how the figures of a scan are judged, and what to do next."""

import math
from dataclasses import dataclass
from typing import Literal

from sl_nerfstudio.evaluation.evaluate import Evaluation
from sl_nerfstudio.evaluation.reference import MeshReference

Band = Literal["good", "acceptable", "poor", "unknown"]
ALIGNED = {"rigid": "rigid alignment", "similarity": "alignment with scale"}
_ORDER: dict[str, int] = {"good": 0, "unknown": 0, "acceptable": 1, "poor": 2}


@dataclass(frozen=True)
class JudgedFigure:
    """One figure, with its judgement."""

    name: str
    value: float
    text: str  # the value with its unit
    band: Band
    good: str  # the limit of "good", in words
    acceptable: str
    meaning: str
    advice: str  # what to do if it is not good


@dataclass(frozen=True)
class Verdict:
    """The worst judgement, and all judged figures."""

    band: Band
    sentence: str
    figures: tuple[JudgedFigure, ...]
    hints: tuple[str, ...] = ()  # explanations that come before the advice of the figures

    @property
    def next_steps(self) -> list[str]:
        """What to do, most urgent first; empty for a good scan."""
        bad = sorted((c for c in self.figures if _ORDER[c.band]), key=lambda c: -_ORDER[c.band])
        return [*self.hints, *(f"{c.name}: {c.advice}" for c in bad)]


def judge(evaluation: Evaluation, intrinsics: str = "") -> Verdict:
    """Judge an evaluation by fixed bands; `intrinsics` is what the training found wrong with them ("": nothing)."""
    fit = evaluation.agreement
    figures = [
        _judged(
            "Coordinate residual", fit.coordinate_px_median, "{:.2f} px", 0.6, 1.5, "≤ {} px",
            "Median distance between where the surface puts a pattern point and where it was decoded.",
            "the surface does not match the captures: train longer, check the poses and the lens data, or decode "
            "again",
        ),
        _judged(
            "Epipolar residual", fit.epipolar_px_median, "{:.2f} px", 0.5, 1.2, "≤ {} px",
            "Median distance of decoded points from their epipolar curve: it depends on the pose of each projector "
            "relative to its camera, and not on the surface.",
            "refine the poses (refine-poses free), and check the intrinsics of camera and projector",
        ),
        _judged(
            "Pattern agreement", fit.pattern_cosine, "{:.3f}", 0.9, 0.75, "≥ {}",
            "Cosine between captured and rendered pattern over all lit pixels; 1 is identical up to brightness.",
            "look at the pictures below: blur, ambient light or a wrong pattern file reduce it",
        ),
        _judged(
            "Coverage", 100 * fit.hit_share, "{:.1f} %", 97.0, 85.0, "≥ {} %",
            "Share of the pixels with pattern on the object at which the mesh has a surface.",
            "export with --keep-unobserved to see whether too much of the surface was removed; otherwise add frames "
            "that see the missing parts",
        ),
        _worst_frame(evaluation),
        _geometry(evaluation),
    ]  # fmt: skip
    if evaluation.reference is not None and evaluation.alignment in evaluation.surface:
        figures.insert(0, _accuracy(evaluation))
    band: Band = max((c.band for c in figures), key=lambda b: _ORDER[b])
    return Verdict(band, _sentence(band, evaluation), tuple(figures), _hints(evaluation, band, intrinsics))


def _judged(
    name: str, value: float, form: str, good: float, acceptable: float, limit: str, meaning: str, advice: str
) -> JudgedFigure:
    """Judge `value`; whether larger is better follows from the order of the limits."""
    sign = 1 if good < acceptable else -1
    band: Band = "poor"
    if not math.isfinite(value):
        band = "unknown"
    elif sign * value <= sign * good:
        band = "good"
    elif sign * value <= sign * acceptable:
        band = "acceptable"
    text = form.format(value) if math.isfinite(value) else "none"
    return JudgedFigure(
        name, value, text, band, limit.format(f"{good:g}"), limit.format(f"{acceptable:g}"), meaning, advice
    )


def _accuracy(evaluation: Evaluation) -> JudgedFigure:
    reference = evaluation.reference
    score = evaluation.surface[evaluation.alignment]
    exact = isinstance(reference, MeshReference)
    rmse = score.accuracy.rmse if exact else score.completeness.rmse
    percent = 100 * rmse / reference.size if reference is not None else math.nan
    way = "of the surface from the truth" if exact else "of the reference points from the surface"
    return _judged(
        "Accuracy" if exact else "Distance from reference", percent,
        f"{{:.2f}} % of the size ({rmse:.3g} {evaluation.truth_units})", 0.25, 1.0,
        "≤ {} %", f"RMS distance {way} after {ALIGNED[evaluation.alignment]}, in percent of the size of the reference.",
        "look for strong error colours: if everywhere, check poses and scale; if in patches, add frames there",
    )  # fmt: skip


def _worst_frame(evaluation: Evaluation) -> JudgedFigure:
    known = [
        (f.coordinate_px_median, f.name) for f in evaluation.agreement.frames if math.isfinite(f.coordinate_px_median)
    ]
    worst, name = max(known, default=(math.nan, ""))
    ratio = worst / evaluation.agreement.coordinate_px_median if known else math.nan
    return _judged(
        "Worst frame", ratio, f"{{:.1f}} times the median ({name})", 2.0, 4.0, "≤ {} times",
        "Coordinate residual of the worst frame, relative to the whole scan: no frame should contradict the others.",
        f"look at {name or 'it'} below; if its pose or decoding is wrong, leave the frame out and train again",
    )  # fmt: skip


def _geometry(evaluation: Evaluation) -> JudgedFigure:
    fit = evaluation.agreement
    return _judged(
        "Ray angle", fit.ray_angle_deg, "{:.1f}°", 8.0, 4.0, "≥ {}°",
        f"Angle between camera ray and projector ray on the surface (median). Here one pattern pixel corresponds to "
        f"{fit.depth_per_px:.3g} {evaluation.units} of depth; where that is a lot, a low residual proves little.",
        "hold the projector farther from the camera in the next scan, or keep the calibrated relative pose "
        "(refine-poses known-rig)",
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
    return tuple(hints)


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
        "unknown": "There is too little data for a judgement",
    }[band]
    return f"{start} ({evidence})."
