from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.evaluation.agreement import CaptureAgreement, FrameAgreement
from sl_nerfstudio.evaluation.evaluate import Evaluation
from sl_nerfstudio.evaluation.judgement import judge
from sl_nerfstudio.review.verdict import DepartedFrame
from tests.review.cases import ring

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
    poor = judge(
        replace(GOOD, starting_poses=False, agreement=replace(AGREEMENT, hit_share=0.5)), "The camera is too long"
    )
    assert poor.next_steps[0] == "The camera is too long" and poor.next_steps[1].startswith("Coverage")
    assert judge(GOOD, "The camera is too long").next_steps == ["The camera is too long"]


def test_a_frame_that_training_could_not_place_makes_the_scan_poor() -> None:
    verdict = judge(GOOD, unplaced=["frame_00001"]).verdict
    assert verdict.band == "poor" and verdict.reasons[0].startswith("frame_00001: could not be placed")


def test_a_frame_far_from_its_start_is_not_good_and_one_that_was_not_placed_is_named_once() -> None:
    departed = [DepartedFrame("frame_00001", 19.86, 1.0)]
    verdict = judge(GOOD, departed=departed).verdict
    assert verdict.band == "acceptable" and verdict.reasons[0].startswith("frame_00001 (19.9 deg, stated 1): far from")
    assert len(judge(GOOD, unplaced=["frame_00001"], departed=departed).verdict.reasons) == 1


@pytest.mark.parametrize(("sigma", "band"), [(0.002, "good"), (0.008, "acceptable"), (0.05, "poor")])
def test_lengths_that_are_badly_known_are_no_good_scan(sigma: float, band: str) -> None:
    verdict = judge(GOOD, length_sigma=sigma)
    assert verdict.verdict.band == band
    assert [f.text for f in verdict.figures if f.name == "Sigma of lengths"] == [f"{100 * sigma:.2f} %"]


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
        (_with(covered_share=0.8), "Coverage of the worst frame", "acceptable"),
        (_with(largest_hole=0.01), "Largest hole", "acceptable"),
        (_with(largest_hole=0.05), "Largest hole", "poor"),
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
        assert verdict.next_steps[0].startswith("These figures are for the scan's starting poses")
        assert verdict.next_steps[1].startswith(check)
    if "frames" in change:
        assert "frame_00007" in verdict.verdict.reasons[0]
        assert "frame_00007" in judged[check].text and "frame_00007" in judged[check].advice


def test_without_a_unit_the_scale_is_not_an_error() -> None:
    assert GOOD.alignment == "rigid"
    unknown = replace(GOOD, units="arbitrary")
    assert unknown.alignment == "similarity"
    assert (GOOD.truth_units, unknown.truth_units) == ("mm", "units of the truth")
    assert replace(unknown, true_units="mm").truth_units == "mm"  # the truth's own files say
