"""From results of the stages to the records of the report, with their sentences and what to capture again."""

import typing
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sl_nerfstudio.processing.captures import CapturedFrame
from sl_nerfstudio.processing.consistency import compare_registered
from sl_nerfstudio.processing.frames import FrameStageResult, clouds_of
from sl_nerfstudio.processing.result import (
    EdgeRecord,
    FrameRecord,
    degeneracy_sentence,
    exclusion_sentence,
    left_out,
    summarise,
    uncertainty_sentence,
    unconnected_neighbours,
    what_to_recapture,
)
from sl_nerfstudio.processing.scan_poses import stated_scale
from sl_nerfstudio.registration.result import (
    CoordinatesDisagree,
    Exclusion,
    KnownLength,
    NoCommonSurface,
    OpenPlace,
    PoorPair,
    SeparateComponent,
    SeparatePoses,
    SurfaceDisagrees,
    UncertainRotation,
    UndecidedProjector,
)
from sl_nerfstudio.relative_pose.estimation import Degeneracy, DegeneracyKind, estimate_relative_pose
from sl_nerfstudio.review.agreement import SurfaceShares
from sl_nerfstudio.scan import PickedPixel, Scale
from tests.formulas import pixels
from tests.processing.ramp_scan import NAMES
from tests.relative_pose.two_views import view


@pytest.fixture
def summary(ramp_scan, tmp_path, results, registration, poses):
    """Summarises the run, of which something may be otherwise."""
    found = {"results": results, "registration": registration, "poses": poses}
    return lambda **changes: summarise(ramp_scan.config(tmp_path), "ramps", **{**found, **changes})


def test_registered_frames_have_all_figures(summary, results):
    result = summary()
    assert result.registered == 4 and result.decoder == "ramps"
    assert (result.units, result.scale_source) == ("arbitrary", "")
    baselines = [frame.baseline for frame in result.frames]
    assert np.exp(np.mean(np.log(baselines))) == pytest.approx(1, abs=0.02)  # no length is known
    for frame, stage in zip(result.frames, results, strict=True):
        assert frame.in_scan and frame.stage == frame.reason == ""
        assert (frame.decode_rate, frame.mask_share) == (stage.decode_rate, stage.mask_share)
        assert frame.epipolar_px == stage.cloud.pose.residual_px < 0.01
        figures = vars(frame)
        assert figures["fitness"] > 0.9
        assert figures["relative_sigma_rotation_deg"] < 0.01 and figures["relative_sigma_direction_deg"] < 0.01
        assert 0 < figures["sigma_rotation_deg"] < 0.12 and frame.component == 0 and not frame.undecided
        assert figures["own_share"] > 0.95
    assert result.joint_px is not None
    before, after = result.joint_px
    assert after < before < 0.2
    assert {edge.frames for edge in result.edges} >= set(pairwise(NAMES))
    assert set(result.versions) == {"sl_nerfstudio", "numpy", "torch"}


SHARES = [SurfaceShares(0.9, 0.0), SurfaceShares(0.8, 0.01), SurfaceShares(None, None), SurfaceShares(0.7, 0.02)]


def test_coordinates_of_the_other_frames_are_part_of_the_record(summary, results, registration, poses):
    cross = compare_registered(clouds_of(results), registration, poses.adjusted)
    result = summary(cross=cross, shares=SHARES)
    assert [frame.shared_decoded for frame in result.frames] == [0.9, 0.8, None, 0.7]
    assert [frame.missing_share for frame in result.frames] == [0.0, 0.01, None, 0.02]
    document = result.document()
    assert (result.verdict.band, document["verdict"], document["reasons"]) == ("good", "good", [])
    for frame, found in zip(result.frames, cross.frames, strict=True):
        assert (frame.seen_share, frame.cross_share, frame.cross_px_p95) == (found.seen, found.share, found.px_p95)
        assert found.share > 0.95
    assert result.cross_px == (cross.px_median, cross.px_p95)


def test_an_undecided_frame_keeps_the_scan_from_being_good_and_its_sigma_says_so(summary, registration):
    doubts = (UncertainRotation(NAMES[1], 7.5), UncertainRotation(NAMES[2], 2.0))
    result = summary(registration=replace(registration, uncertainties=doubts))
    assert result.verdict.band == "poor"
    assert result.verdict.reasons[0].startswith(f"{NAMES[1]}: rotation known only to 7.5 degrees")
    assert result.frames[1].sigma_rotation_deg == 7.5
    assert [frame.undecided for frame in result.frames] == [False, True, True, False]
    assert result.document()["frames"][1]["undecided"] is True
    one = summary(registration=replace(registration, uncertainties=doubts[1:]))
    assert one.verdict.band == "acceptable" and NAMES[2] in one.verdict.reasons[0]


def test_placed_points_are_where_both_devices_see_them(summary, results, poses):
    """Projected by hand: into the camera they are the pixels' centres, into the projector the decoded coordinates."""
    (group,) = summary().placed
    assert group.component == 0 and [frame.name for frame in group.frames] == list(NAMES)
    clouds = clouds_of(results)
    for k, frame in enumerate(group.frames):
        assert 100 < len(frame.points) <= 10_000
        np.testing.assert_array_equal(frame.T_world_camera, poses.adjusted.poses.T_world_camera[k])
        np.testing.assert_allclose(pixels(frame.camera, frame.T_world_camera, frame.points), frame.uv_camera, atol=0.1)
        column, row = np.floor(frame.uv_camera).astype(int).T
        seen = pixels(frame.projector, frame.T_world_projector, frame.points)
        off = np.linalg.norm(seen - clouds[k].coords[row, column], axis=1)
        assert np.median(off) < 0.1 and off.max() < 1


def test_other_groups_and_single_frames_are_placed_in_axes_of_their_own(summary, results, registration):
    T = np.stack([np.eye(4), np.eye(4)])
    T[1, :3, 3] = [1.0, 2.0, 3.0]
    apart = replace(
        registration,
        registered=np.array([True, True, False, False]),
        component=np.array([0, 0, 1, 1]),
        exclusions=tuple(NoCommonSurface(name) for name in NAMES[2:]),
        separate=(SeparatePoses(tuple(NAMES[2:]), T, np.array([0.5, 2.0])),),
    )
    scan, other = summary(registration=apart).placed
    assert (scan.component, other.component) == (0, 1)
    assert [[f.name for f in g.frames] for g in (scan, other)] == [list(NAMES[:2]), list(NAMES[2:])]
    for k, frame in enumerate(other.frames):
        np.testing.assert_array_equal(frame.T_world_camera, T[k])
        baseline = np.linalg.norm(frame.T_world_projector[:3, 3] - T[k, :3, 3])
        assert baseline == pytest.approx((0.5, 2.0)[k])
        np.testing.assert_allclose(pixels(frame.camera, T[k], frame.points), frame.uv_camera, atol=0.1)
    alone = summary(registration=replace(apart, separate=())).placed
    assert [(g.component, len(g.frames)) for g in alone] == [(0, 2), (-1, 1), (-1, 1)]
    assert [g.frames[0].name for g in alone[1:]] == list(NAMES[2:])
    nowhere = summary(registration=None, poses=None).placed  # registration was not reached
    assert [g.component for g in nowhere] == [-1] * 4
    part = np.zeros(clouds_of(results)[0].coords.shape[:2], np.uint8)
    assert not len(scan.only_object({NAMES[0]: part}).frames[0].points)  # nothing of it is the object
    assert scan.only_object({}).frames == scan.frames


@pytest.mark.parametrize(
    ("stage", "rate", "share"), [("reading", None, None), ("decoding", None, None), ("calibrating", 0.5, 0.25)]
)
def test_a_frame_that_failed_has_only_the_figures_that_were_reached(summary, results, registration, stage, rate, share):
    reason = "x.png: is bad\n    cause:  a\n    remedy: b"
    lost = FrameStageResult(CapturedFrame("lost", ()), "k", False, 0.5, 0.25, None, stage, reason)
    frame = summary(results=[lost, *results]).frames[0]
    assert (frame.in_scan, frame.stage, frame.reason) == (False, stage, lost.reason)
    assert (frame.decode_rate, frame.mask_share) == (rate, share)
    assert frame.epipolar_px is frame.baseline is frame.fitness is None
    assert left_out(lost, registration) == (stage, lost.reason)


def test_a_frame_that_was_not_registered_says_why(summary, results, registration):
    alone = NoCommonSurface(NAMES[2])
    without = replace(registration, registered=np.array([True, True, False, True]), exclusions=(alone,))
    frame = summary(registration=without).frames[2]
    assert (frame.in_scan, frame.stage, frame.reason) == (False, "registering", exclusion_sentence(alone))
    assert vars(frame)["epipolar_px"] < 0.01 and frame.baseline is None and frame.fitness is None
    assert left_out(results[0], without) is None


@pytest.mark.parametrize("registered", [False, True])
def test_without_a_scan_every_frame_is_left_out_for_a_reason(summary, registration, registered):
    result = summary(registration=registration if registered else None, poses=None)
    assert result.registered == 0 and result.joint_px is None and result.units == "arbitrary"
    assert {(f.stage, f.reason) for f in result.frames} == {("registering", "too few other frames could be used")}


def test_residuals_that_do_not_exist_are_left_out(summary, poses):
    none = replace(poses, adjusted=replace(poses.adjusted, median_before_px=np.nan, median_after_px=np.nan))
    result = summary(poses=none)
    assert result.joint_px is None and result.document()["joint_adjustment_px"] is None


def _edge(a, b, used=True):
    return EdgeRecord((a, b), 0.5, 0.9, used, False)


def test_every_reason_is_named():
    frames = [
        FrameRecord("a", decode_rate=0.3, mask_share=0.4, fitness=0.95),
        FrameRecord(
            "b", in_scan=False, stage="decoding", reason="b.png: is black\n    cause:  dark\n    remedy: light"
        ),
        FrameRecord("c", decode_rate=0.9, mask_share=0.01, degeneracies=("all points lie in one plane",)),
        FrameRecord("d", decode_rate=0.9, mask_share=0.5, fitness=0.4),
        FrameRecord("e", decode_rate=0.9, shared_decoded=0.5),
        FrameRecord("f", decode_rate=0.1, shared_decoded=0.9),  # background that no frame decoded
    ]
    said = what_to_recapture(frames, [_edge("a", "c"), _edge("c", "d", used=False)], ordered=True)
    assert said[0] == "b: capture it again; it was left out (b.png: is black)"
    assert said[1].startswith("between c and d: add a frame; the two share too little of the surface")
    text = "\n".join(said)
    assert "a: only 30% of the pattern was decoded" in text
    assert "c: all points lie in one plane" in text and "c: the pattern fills only 1.0% of the image" in text
    assert "d: only 40% of its points agree" in text
    assert "e: only 50% of the surface that other frames show was decoded" in text and "f: only" not in text


def test_unordered_frames_with_a_single_connection():
    frames = [FrameRecord(n) for n in "abcd"]
    edges = [_edge("a", "b"), _edge("b", "c"), _edge("c", "a"), _edge("c", "d")]
    said = what_to_recapture(frames, edges, ordered=False)
    assert said == ("near d: add a frame; only one other frame overlaps it",)


def test_frames_of_one_group_share_a_sentence():
    apart = {"in_scan": False, "stage": "registering", "reason": "it may slip\n    cause:  round"}
    kinds = {"a": {"component": 0}, "b": {**apart, "component": 2}, "c": {**apart, "component": -1},
             "d": {**apart, "component": 2}, "e": {"component": 0}, "f": {**apart, "reason": "it is dark"},
             "g": apart}  # fmt: skip
    frames = [FrameRecord(name, **values) for name, values in kinds.items()]
    assert what_to_recapture(frames, [_edge("a", "e")], ordered=True) == (
        "b, d: capture views that connect this group 2 with the scan; b was left out (it may slip)",
        "c, g: capture them again; each was left out (it may slip)",
        "f: capture it again; it was left out (it is dark)",
    )
    assert unconnected_neighbours(frames, [_edge("a", "e")]) == []
    assert unconnected_neighbours(frames, [_edge("a", "b")]) == [("a", "e")]


def test_the_figures_that_a_frame_has_fit_their_sentences():
    kinds = set()
    for offset, relief in (((0.004, 0.0, 0.0), 1.0), ((1.0, 0.2, 0.0), 0.0), ((0.05, 0.04, -2.0), 1.0)):
        frame = view(offset=offset, relief=relief).noisy(0.3, seed=0)
        for degeneracy in estimate_relative_pose(*frame.arguments).degeneracies:
            assert len(degeneracy_sentence(degeneracy)) > 30
            kinds.add(degeneracy.kind)
    assert {"pure rotation", "planar", "epipole in view"} <= kinds


def test_a_baseline_is_stated_by_the_name_of_itsFrameRecord():
    found = stated_scale(KnownLength(0.085, "mm", ("IMG 7",)))
    assert found == Scale(True, "baseline of frame IMG 7", baseline_of="IMG 7")


@pytest.mark.parametrize(("unit", "length"), [("m", 0.05), ("cm", 5.0), ("mm", 50.0), ("um", 50_000.0)])
def test_a_scale_bar_is_stated_by_its_pixels_and_its_length_in_the_unit(unit, length):
    found = stated_scale(KnownLength(0.05, unit, ("a", "b"), ((410.5, 200.0), (35.0, 80.0))))
    ends = (PickedPixel("a", (410.5, 200.0)), PickedPixel("b", (35.0, 80.0)))
    assert found.known and found.baseline_of is None and found.bar is not None
    assert found.bar.ends == ends and found.bar.length == pytest.approx(length, rel=1e-12)


DEGENERACIES: dict[DegeneracyKind, tuple[tuple[float, ...], str]] = {
    "few points": ((37.0,), "only 37 decoded pixels"),
    "small part of the pattern": ((12.0, 375.0), "only 12 of 375 squares"),
    "pure rotation": ((0.4321,), "within 0.43 px"),
    "small parallax": ((1.234,), "only 1.2 degrees"),
    "planar": ((0.5678,), "within 0.57 px"),
    "epipole in view": ((), "move the projector to the side"),
    "ambiguous": ((0.874, 0.891), "87% of the coordinates, and this one 89%"),
    "many outliers": ((0.412,), "41% of the coordinates"),
    "poor fit": ((3.14,), "by 3.1 px"),
    "uncertain": ((0.614, 1.87), "0.61 degrees (rotation) and 1.9 degrees"),
}
EXCLUSIONS: list[tuple[Exclusion, tuple[str, ...]]] = [
    (SurfaceDisagrees("a", 0.42), ("42%", "capture this view again")),
    (NoCommonSurface("a"), ("capture views in between",)),
    (SeparateComponent("a", ("a",), False, "b"), ("its connection", "not certain", "between it and b")),
    (SeparateComponent("a", ("a", *"cdefg"), False, None), ("it and c, d, e and 2 more", "and the other frames")),
    (SeparateComponent("a", ("a",), True, "b"), ("may slip", "between it and b", "chalk")),
    (OpenPlace("a", ("a",), 19.0, 0.2, "b"), ("it fits", "19 degrees apart (even odds)", "between it and b", "a mark")),
    (OpenPlace("a", ("a", "c"), 90.0, 3.0, None), ("it and c fit", "odds of 20 to 1", "the other frames")),
    (CoordinatesDisagree("a", ("a",)), ("its coordinates contradict", "capture this view again")),
    (CoordinatesDisagree("a", ("a", "b")), ("its coordinates and those of b agree",)),
    (PoorPair("a", "b", 0.11, 0.23, 4.4, 10.0), ("partner, b,", "11%", "23%", "4 nats", "needed: 10", "capture views")),
    (UndecidedProjector("a", 12.3), ("12 degrees apart", "show parts at other depths")),
]


def test_every_fact_about_a_frame_has_a_sentence_with_its_figures_and_its_remedy():
    assert DEGENERACIES.keys() == set(typing.get_args(DegeneracyKind))
    for kind, (figures, words) in DEGENERACIES.items():
        assert words in degeneracy_sentence(Degeneracy(kind, figures))
    assert {type(fact) for fact, _ in EXCLUSIONS} == set(typing.get_args(Exclusion))
    for fact, words in EXCLUSIONS:
        assert all(word in exclusion_sentence(fact) for word in words)
    said = uncertainty_sentence(UncertainRotation("a", 3.14))
    assert said.startswith("a: ") and "slip" in said and "3.1 degrees" in said
