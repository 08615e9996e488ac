from dataclasses import replace

import pytest

from sl_nerfstudio.evaluation.capture_agreement import CaptureAgreement, FrameAgreement
from sl_nerfstudio.evaluation.evaluate import Evaluation
from sl_nerfstudio.evaluation.verdict import judge

FRAME = FrameAgreement("frame_00000", 1000, 1.0, 1.0, 0.9, 0.35, 1.0, 0.2, 0.95, 0.5, 20.0)
AGREEMENT = CaptureAgreement(0.35, 1.0, 0.2, 0.95, 0.99, 0.5, 20.0, (FRAME, replace(FRAME, name="frame_00001")))
GOOD = Evaluation("mm", AGREEMENT, None, {}, None, None, starting_poses=True)


def test_good_agreement_is_good_and_needs_nothing() -> None:
    verdict = judge(GOOD)
    assert verdict.band == "good"
    assert {figure.band for figure in verdict.figures} == {"good"}
    assert verdict.next_steps == []
    assert "no truth is known" in verdict.sentence  # and does not pretend to know more


def test_what_is_wrong_with_the_intrinsics_comes_first() -> None:
    poor = judge(
        replace(GOOD, starting_poses=False, agreement=replace(AGREEMENT, hit_share=0.5)), "The camera is too long"
    )
    assert poor.next_steps[0] == "The camera is too long" and poor.next_steps[1].startswith("Coverage")
    assert judge(GOOD, "The camera is too long").next_steps == ["The camera is too long"]


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
        ({"frames": (FRAME, replace(FRAME, name="frame_00007", coordinate_px_median=3.5))}, "Worst frame", "poor"),
    ],
)
def test_the_worst_figure_decides_and_says_what_to_do(change: dict, check: str, band: str) -> None:
    verdict = judge(replace(GOOD, agreement=replace(AGREEMENT, **change)))
    judged = {c.name: c for c in verdict.figures}
    assert judged[check].band == band
    if band == "unknown":
        assert judged[check].text == "none"
    else:
        assert verdict.band == band
        assert verdict.next_steps[0].startswith("These figures are for the scan's starting poses")
        assert verdict.next_steps[1].startswith(check)
    if check == "Worst frame":
        assert "frame_00007" in judged[check].text and "frame_00007" in judged[check].advice


def test_without_a_unit_the_scale_is_not_an_error() -> None:
    assert GOOD.alignment == "rigid"
    unknown = replace(GOOD, units="arbitrary")
    assert unknown.alignment == "similarity"
    assert (GOOD.truth_units, unknown.truth_units) == ("mm", "units of the truth")
