"""How figures are judged, and what to do next, in words."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.evaluation.agreement import CaptureAgreement, FrameAgreement
from sl_nerfstudio.evaluation.completeness import NextView, assess_completeness
from sl_nerfstudio.evaluation.evaluate import Evaluation
from sl_nerfstudio.evaluation.judgement import (
    TrainedSteps,
    capture_next,
    disagreeing_frames,
    further_commands,
    judge,
    trained_steps,
)
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.review.verdict import DepartedFrame
from tests.review.cases import ring

from .test_completeness import cut_sphere

FRAME = FrameAgreement("frame_00000", 1000, 1.0, 1.0, 0.9, 0.35, 1.0, 0.2, 0.95, 0.5, 20.0, 0.99, 0.97, 0.001, 0.0)
AGREEMENT = CaptureAgreement(0.35, 1.0, 0.2, 0.95, 0.99, 0.5, 20.0, (FRAME, replace(FRAME, name="frame_00001")))
GOOD = Evaluation("mm", AGREEMENT, None, {}, None, None, starting_poses=True)


def test_good_agreement_is_good_and_needs_nothing() -> None:
    verdict = judge(GOOD)
    assert verdict.verdict.band == "good" and verdict.verdict.reasons == ()
    assert {figure.band for figure in verdict.figures} == {"good"}
    assert verdict.next_steps == []
    assert "no truth is known" in verdict.sentence  # and does not pretend to know more


def test_what_is_wrong_with_the_intrinsics_comes_first() -> None:
    lacking = replace(GOOD, starting_poses=False, agreement=replace(AGREEMENT, hit_share=0.5))
    poor = judge(lacking, "The camera is too long")
    assert poor.next_steps == ["The camera is too long"] and poor.verdict.reasons[0].startswith("Coverage")
    assert judge(GOOD, "The camera is too long").next_steps == ["The camera is too long"]


def test_a_frame_that_was_not_placed_makes_the_scan_poor_and_one_far_from_its_start_is_not_good() -> None:
    verdict = judge(GOOD, unplaced=["frame_00001"]).verdict
    assert verdict.band == "poor" and verdict.reasons[0].startswith("frame_00001: could not be placed")
    departed = [DepartedFrame("frame_00001", 19.86, 1.0)]
    verdict = judge(GOOD, departed=departed).verdict
    assert verdict.band == "acceptable" and verdict.reasons[0].startswith("frame_00001 (19.9 deg, stated 1): far from")
    assert len(judge(GOOD, unplaced=["frame_00001"], departed=departed).verdict.reasons) == 1  # named once


@pytest.mark.parametrize(
    ("given", "band", "text"),
    [
        ({"length_sigma": 0.002}, "good", "0.20 %"),
        ({"length_sigma": 0.008}, "acceptable", "0.80 %"),
        ({"length_sigma": 0.05}, "poor", "5.00 %"),
        ({"steps": TrainedSteps(1000, 1000)}, "good", "100 % (1000 of 1000 steps)"),
        ({"steps": TrainedSteps(400, 1000)}, "acceptable", "40 % (400 of 1000 steps)"),
        ({"steps": TrainedSteps(40, 1000)}, "poor", "4 % (40 of 1000 steps)"),
    ],
)
def test_badly_known_lengths_and_an_unfinished_training_show(given: dict, band: str, text: str) -> None:
    verdict = judge(GOOD, **given)
    assert verdict.verdict.band == band and verdict.figures[-1].text == text
    assert (text in " ".join(verdict.verdict.reasons)) == (band != "good")


def _with(**changes) -> dict:
    """Five good frames and one that is not."""
    return {"frames": (*[FRAME] * 5, replace(FRAME, name="frame_00007", **changes))}


def test_frames_that_contradict_each_other_are_named_as_in_a_processing_report() -> None:
    excess = np.ones((3, 3))
    excess[2, :] = excess[:, 2] = 9.0
    frames = tuple(replace(FRAME, name=name) for name in "abc")
    verdict = judge(replace(GOOD, agreement=replace(AGREEMENT, frames=frames), cross=ring(excess))).verdict
    assert verdict.band == "poor"
    assert verdict.reasons[0].startswith("c: contradicts the frames that saw the same surface")


@pytest.mark.parametrize(
    ("change", "check", "band"),
    [
        ({"coordinate_px_median": 1.0}, "Coordinate residual", "acceptable"),
        ({"coordinate_px_median": 3.0}, "Coordinate residual", "poor"),
        ({"coordinate_px_median": float("nan")}, "Coordinate residual", "unknown"),
        ({"epipolar_px_median": 2.0}, "Epipolar residual", "poor"),
        ({"pattern_cosine": 0.8}, "Pattern agreement", "acceptable"),
        ({"pattern_cosine": 0.3}, "Pattern agreement", "poor"),
        ({"hit_share": 0.5}, "Coverage", "poor"),
        ({"ray_angle_deg": 2.0}, "Ray angle", "poor"),
        (_with(coordinate_px_median=3.5), "Worst frame", "poor"),
        (_with(coordinate_px_p95=4.0), "Worst frame, 95 %", "acceptable"),
        (_with(agreeing_share=0.5), "Agreement in the worst frame", "poor"),
        (_with(covered_share=0.8), "Coverage", "acceptable"),
        (_with(largest_hole=0.01), "Coverage", "acceptable"),
        (_with(largest_hole=0.05), "Coverage", "poor"),
    ],
)
def test_the_worst_figure_decides_and_says_what_to_do(change: dict, check: str, band: str) -> None:
    verdict = judge(replace(GOOD, agreement=replace(AGREEMENT, **change)))
    judged = {c.name: c for c in verdict.figures}
    assert judged[check].band == band
    if band == "unknown":
        assert judged[check].text == "none"
    else:
        assert verdict.verdict.band == band
        assert verdict.verdict.reasons[0].startswith(f"{check}: ")
        assert verdict.verdict.reasons[0].endswith(judged[check].advice) and judged[check].advice
        assert len([reason for reason in verdict.verdict.reasons if reason.startswith(f"{check}:")]) == 1
        assert verdict.next_steps[0].startswith("These figures are for the scan's starting poses")
    if "frames" in change:
        assert "frame_00007" in verdict.verdict.reasons[0] and "frame_00007" in judged[check].text


@pytest.mark.parametrize(("step", "train"), [(9, True), (999, False), (1500, False)])
def test_only_an_unfinished_training_is_to_be_trained_further_and_with_a_command(step: int, train: bool) -> None:
    commands = {"train": ["ns-train", "sl-neus", "--data", "my scan"], "export": ["sl-export", "--resolution", "1024"]}
    training = {"settings": {"step": step, "recommended_steps": 1000}, "commands": commands}
    lacking = replace(GOOD, agreement=replace(AGREEMENT, hit_share=0.5, coordinate_px_median=3.0))
    found = judge(lacking, steps=trained_steps(training), commands=further_commands(training)).verdict.reasons
    said = "train to the end: ns-train sl-neus --data 'my scan'"
    coverage, residual = (next(r for r in found if r.startswith(name)) for name in ("Coverage", "Coordinate residual"))
    assert coverage.endswith(said if train else "export with finer cells: sl-export --resolution 1024")
    assert (said in residual) == train and ("train to the end" in " ".join(found)) == train
    assert "--resolution 1024" in further_commands(None).for_missing_surface


def test_every_reason_says_what_helps_and_no_unit_is_called_arbitrary() -> None:
    bad = replace(FRAME, name="frame_00007", coordinate_px_median=3.5, coordinate_px_p95=9.0, agreeing_share=0.1)
    fit = CaptureAgreement(3.0, 9.0, 2.0, 0.3, 0.5, 0.00546, 2.0, (*[FRAME] * 5, bad))
    verdict = judge(replace(GOOD, units="arbitrary", agreement=fit), length_sigma=0.1)
    assert len(verdict.verdict.reasons) == 9 and all("; " in reason for reason in verdict.verdict.reasons)
    assert not any("arbitrary" in figure.meaning + figure.text for figure in verdict.figures)
    assert any("0.00546 units of depth" in figure.meaning for figure in verdict.figures)


def test_without_a_unit_the_scale_is_not_an_error() -> None:
    assert GOOD.alignment == "rigid"
    unknown = replace(GOOD, units="arbitrary")
    assert unknown.alignment == "similarity"
    assert (GOOD.truth_units, unknown.truth_units) == ("mm", "units of the truth")
    assert replace(unknown, true_units="mm").truth_units == "mm"  # the truth's own files say


NAMES = [f"frame_{k:05d}" for k in range(8)]
FRAMES = tuple(replace(FRAME, name=name) for name in NAMES)
REFINED = replace(GOOD, starting_poses=False, agreement=replace(AGREEMENT, frames=FRAMES))
VIEW = NextView(np.eye(4), np.eye(4), 3.0, 4.0, 0, 0.9, nearest=2, nearest_deg=70.0, elevation_deg=-80.0)


@pytest.mark.parametrize("change", [{"coordinate_px_median": 1.0}, {"coordinate_px_p95": 4.0}, {"agreeing_share": 0.5}])
def test_a_frame_that_disagrees_is_named_with_what_to_do(change):
    frames = (*FRAMES[:3], replace(FRAMES[3], **change), *FRAMES[4:])
    evaluation = replace(REFINED, agreement=replace(AGREEMENT, frames=frames))
    said = ("frame_00003 disagrees: leave it out or capture it again",)
    assert disagreeing_frames(evaluation) == said and judge(evaluation).next_steps[0] == said[0]
    assert disagreeing_frames(replace(evaluation, starting_poses=True)) == ()  # those are rough anyway


def test_frames_are_not_blamed_if_nothing_or_everything_disagrees():
    everywhere = tuple(replace(frame, agreeing_share=0.1) for frame in FRAMES)
    for frames in (FRAMES, everywhere):
        assert disagreeing_frames(replace(REFINED, agreement=replace(AGREEMENT, frames=frames))) == ()


def test_the_next_capture_is_named_by_its_side():
    surface = IndexedMesh(cut_sphere(-0.4))
    evaluation = replace(REFINED, completeness=assess_completeness(surface, REFINED.agreement))
    text = capture_next(evaluation, VIEW)
    assert text.startswith("No frame sees the underside: capture it from below, or turn the object over")
    assert text.endswith("would show 75% of what no frame has seen (3 mm²)")
    assert "the top: capture it from above" in capture_next(evaluation, replace(VIEW, elevation_deg=80.0))
    for elevation in (10.0, float("nan")):
        side = capture_next(evaluation, replace(VIEW, elevation_deg=elevation))
        assert "the side 70° from frame_00002, the nearest frame" in side
    assert judge(evaluation, capture=VIEW).next_steps == [text]
    assert capture_next(evaluation, replace(VIEW, new_area=0.01)) == ""  # not worth a capture
    assert capture_next(evaluation, None) == "" and capture_next(REFINED, VIEW) == ""


def test_holes_and_missing_surface_are_judged():
    frames = tuple(replace(frame, hole_share=0.02) for frame in FRAMES)
    agreement = replace(AGREEMENT, frames=frames)
    found = assess_completeness(IndexedMesh(cut_sphere(0.5, -0.5)), agreement)
    assert found.observed == pytest.approx(0.98) and found.hole_share == pytest.approx(0.75 / 2, rel=0.05)
    judged = {f.name: f for f in judge(replace(REFINED, agreement=agreement, completeness=found)).figures}
    assert judged["Coverage"].band == "acceptable" and "98.0 % of what the frames decoded" in judged["Coverage"].text
    assert judged["Holes"].band == "acceptable" and "openings: 2, 4." in judged["Holes"].text
    assert judged["Holes"].acceptable == "any"  # nobody can judge what nobody saw
    closed = assess_completeness(IndexedMesh(cut_sphere()), REFINED.agreement)
    assert closed.hole_share == 0 and closed.rim_area == 0 and closed.observed == pytest.approx(0.999)


def test_steps_are_those_of_the_training_and_the_recommended_ones():
    settings = {"step": 149, "recommended_steps": 1000, "schedule_iterations": 150}
    assert trained_steps({"settings": settings}) == TrainedSteps(150, 1000)
    assert trained_steps({"settings": {**settings, "schedule_iterations": 5000}}) == TrainedSteps(150, 5000)
    assert trained_steps({"settings": {**settings, "recommended_steps": None}}) == TrainedSteps(150, 150)
    for unknown in (None, {}, {"settings": {}}, {"settings": {"step": 149}}):
        assert trained_steps(unknown) is None
