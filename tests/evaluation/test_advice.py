"""What to do next, in words."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.evaluation.completeness import NextView, assess_completeness
from sl_nerfstudio.evaluation.judgement import TrainedSteps, capture_next, disagreeing_frames, judge, trained_steps
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh

from .completeness.test_openings import cut_sphere
from .test_judgement import AGREEMENT, FRAME, GOOD

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
    assert disagreeing_frames(REFINED) == ()
    everywhere = tuple(replace(frame, agreeing_share=0.1) for frame in FRAMES)
    assert disagreeing_frames(replace(REFINED, agreement=replace(AGREEMENT, frames=everywhere))) == ()


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
    assert judged["Observed surface"].band == "acceptable" and judged["Observed surface"].text == "98.0 % present"
    assert judged["Holes"].band == "acceptable" and "openings: 2, 4." in judged["Holes"].text
    assert judged["Holes"].acceptable == "any"  # nobody can judge what nobody saw
    closed = assess_completeness(IndexedMesh(cut_sphere()), REFINED.agreement)
    assert closed.hole_share == 0 and closed.rim_area == 0 and closed.observed == pytest.approx(0.999)


@pytest.mark.parametrize(("done", "band"), [(1000, "good"), (400, "acceptable"), (40, "poor")])
def test_an_unfinished_training_shows(done, band):
    verdict = judge(REFINED, steps=TrainedSteps(done, 1000))
    assert verdict.verdict.band == band
    if band != "good":
        assert f"({done} of 1000 steps)" in verdict.verdict.reasons[0]


def test_steps_are_those_of_the_training_and_the_recommended_ones():
    settings = {"step": 149, "recommended_steps": 1000, "schedule_iterations": 150}
    assert trained_steps({"settings": settings}) == TrainedSteps(150, 1000)
    assert trained_steps({"settings": {**settings, "schedule_iterations": 5000}}) == TrainedSteps(150, 5000)
    assert trained_steps({"settings": {**settings, "recommended_steps": None}}) == TrainedSteps(150, 150)
    for unknown in (None, {}, {"settings": {}}, {"settings": {"step": 149}}):
        assert trained_steps(unknown) is None
