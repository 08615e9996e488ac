"""What facts lead to which verdict, in which words."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.bundle_adjustment.modes import Mode
from sl_nerfstudio.processing.result import HELP
from sl_nerfstudio.review.verdict import (
    FrameFacts,
    PairFacts,
    Reason,
    ScanFacts,
    judge_scan,
    listed,
    other_places,
    worst,
)
from tests.review.cases import ring

N = 12
NAMES = [f"f{k:02d}" for k in range(N)]
GOOD = tuple(FrameFacts(name, sigma_rotation_deg=0.1, decode_rate=0.9, own_share=0.95) for name in NAMES)
CHAIN = tuple(PairFacts((NAMES[k], NAMES[(k + gap) % N]), True) for gap in (1, 2) for k in range(N))


def scan(changes=None, **others):
    """A good scan in which some frames are other than good."""
    frames = tuple(replace(f, **(changes or {}).get(k, {})) for k, f in enumerate(GOOD))
    inside = sum(f.in_scan for f in frames)
    return ScanFacts(frames, **{"pairs": CHAIN, "cross": ring(np.ones((inside, inside))), **others})


EVEN = ring(np.ones((N, N)))
LESS_WELL = replace(EVEN, frames=tuple(replace(f, excess=2.2 if k == 4 else 1.0) for k, f in enumerate(EVEN.frames)))
HALVES = ring(np.where(np.arange(N)[:, None] // 6 == np.arange(N)[None] // 6, 1.0, np.nan))
MISSING = tuple(FrameFacts(f"f{k}", rays_px=38.0 + k, stated_px=10.0) for k in range(8))
ONE_MISSES = (replace(MISSING[0], rays_px=80.0), *(replace(f, rays_px=7.0) for f in MISSING[1:]))
BARE = tuple(FrameFacts(f"f{k}") for k in range(8))
TURNTABLE = "turntable with a static background"
OTHER_PLACE = "f1, f3: may be turned by 90 degrees against the others"


def elsewhere(log_odds):
    """Two frames that may be a quarter turn off."""
    mode = Mode(log_odds, 1.0, (1, 3), 90.0, (0.0, 0.0, 1.0))
    return ScanFacts(BARE, other_places=other_places([mode], [f.name for f in BARE]))


@pytest.mark.parametrize(
    ("facts", "band", "words"),
    [
        (scan(), "good", ()),
        (ScanFacts(GOOD), "good", ()),  # what is not known is not judged
        (scan({k: {"decode_rate": 0.2, "shared_decoded": 0.8} for k in range(N)}), "good", ()),  # a background
        (scan({k: {"in_scan": False} for k in range(1, N)}), "poor", ("only 1 of 12 frames could be used",)),
        (
            scan({k: {"in_scan": False, "component": 1} for k in (2, 3, 4)}),
            "acceptable",
            ("f02, f03, f04: form",),
        ),
        (scan(turns_deg=(60.0, 119.8)), "poor", ("the same after a turn by 60, 120 degrees",)),
        (
            scan(turns_deg=(60.0, 119.8), by_order=("f03", "f05")),
            "poor",
            ("f03, f05: the object", "less than 30 degrees"),
        ),
        (scan(by_order=("f03",)), "acceptable", ("f03: fit at several sides", "placed by the order of capture")),
        (scan(cross=LESS_WELL), "acceptable", ("f04: agrees less well", "2.2 times")),
        (scan(cross=HALVES), "poor", ("no surface in common with the other frames",)),
        (scan(cross=replace(EVEN, share=0.96)), "good", ()),
        (scan(cross=replace(EVEN, share=0.9)), "acceptable", ("of all points that two frames saw, 90% agree",)),
        (scan(cross=replace(EVEN, share=0.5)), "poor", ("of all points that two frames saw, 50% agree",)),
        (scan(wrong_intrinsics=True), "acceptable", ("contradict the stated intrinsics",)),
        (scan({0: {"degeneracies": ("flat",)}}), "good", ()),  # the other frames determine it
        (scan({k: {"degeneracies": ("flat",)} for k in range(5)}), "acceptable", ("weakly determined in f00",)),
        (ScanFacts(MISSING), "poor", ("42 px (median)", "explains 10 px", "sl_pose_sigma", "sl-process")),
        (ScanFacts(tuple(replace(f, stated_px=20.0) for f in MISSING)), "good", ()),
        (ScanFacts(ONE_MISSES), "acceptable", ("f0: the rays of camera and projector miss",)),
        (ScanFacts(BARE, moving_share=0.08), "poor", (TURNTABLE, "8%", "sl-process --masks")),
        (ScanFacts(BARE, moving_share=0.08, moving_registered=True), "acceptable", (TURNTABLE, "8%", "--masks")),
        (elsewhere(-8.0), "good", ()),
        (elsewhere(-5.7), "acceptable", (f"{OTHER_PLACE} (1 in {np.exp(5.7) + 1:.0f})",)),
        (elsewhere(-1.0), "poor", (f"{OTHER_PLACE} (1 in {np.exp(1.0) + 1:.0f})",)),
        (elsewhere(0.5), "poor", (f"{OTHER_PLACE} (as likely)",)),
    ],
)
def test_facts_lead_to_a_band_and_the_first_reason_says_why(facts, band, words):
    verdict = judge_scan(facts)
    assert verdict.band == band and bool(verdict.reasons) == bool(words)
    assert all(word in verdict.reasons[0] for word in words)


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        ({"undecided": True}, "the pose is undecided"),
        ({"sigma_rotation_deg": 5.0}, "to 5 degrees"),
        ({"decode_rate": 0.2}, "only 20% of the visible pattern"),
        ({"decode_rate": 0.9, "shared_decoded": 0.3}, "only 30% of the surface that other frames show"),
        ({"decode_rate": 0.0}, "only 0% of the visible pattern"),
        ({"missing_share": 0.07}, "saw nothing of the pattern"),
        ({"missing_share": 0.2}, "(20% of it in the worst of them; at most 5%)"),
        ({"own_share": 0.1}, "only 10% of the decoded pixels"),
        ({"in_scan": False, "component": None}, "1 of 12 frames were left out"),
        ({"in_scan": False, "component": 1}, "stands alone"),
    ],
)
def test_one_frame_is_enough_and_many_make_it_poor(change, fact):
    verdict = judge_scan(scan({3: change}))
    assert verdict.band == ("poor" if "sigma_rotation_deg" in change else "acceptable")
    assert any("f03" in reason and fact in reason for reason in verdict.reasons)
    assert judge_scan(scan({k: change for k in range(4)})).band == "poor"  # more than a quarter


@pytest.mark.parametrize("frames", [1, N])
def test_rotations_known_to_a_degree_are_acceptable_however_many(frames):
    verdict = judge_scan(scan({k: {"sigma_rotation_deg": 1.3 + 0.1 * k} for k in range(frames)}))
    assert verdict.band == "acceptable" and len(verdict.reasons) == 1
    assert f"{1.3 + 0.1 * (frames - 1):.2g} degrees" in verdict.reasons[0] and "at most 1)" in verdict.reasons[0]


def test_frames_that_are_lost_and_frames_that_are_loose_are_named_apart():
    verdict = judge_scan(scan({3: {"sigma_rotation_deg": 5.0}, 4: {"sigma_rotation_deg": 1.3}}))
    lost, loose = verdict.reasons[:2]
    assert lost.startswith("f03:") and "at most 3)" in lost and loose.startswith("f04:") and "at most 1)" in loose


def test_the_usual_uncertainty_of_a_registration_is_no_fault_of_its_frames():
    rough = {k: {"sigma_rotation_deg": 1.3} for k in range(N)}
    verdict = judge_scan(scan(rough, adjusted=False))
    assert verdict.band == "acceptable"
    assert [r for r in verdict.reasons if "known only" in r] == []
    assert judge_scan(scan(rough | {3: {"sigma_rotation_deg": 5.0}}, adjusted=False)).band == "poor"


def test_pairs_that_contradict_others_and_pairs_on_which_everything_hangs():
    rejected = tuple(replace(p, used=False) if "f05" in p.frames else p for p in CHAIN)
    verdict = judge_scan(scan(pairs=rejected))
    assert "f05: most pairs with other frames contradict the pose found" in verdict.reasons
    line = [(k, k + 1) for k in range(N - 1)] + [(k, k + 2) for k in range(N - 2) if k not in (4, 5)]
    verdict = judge_scan(scan(pairs=tuple(PairFacts((NAMES[a], NAMES[b]), True) for a, b in line)))
    assert verdict.band == "acceptable"
    assert any("only the pair f05 and f06 connects" in r and "no other pair confirms it" in r for r in verdict.reasons)


@pytest.mark.parametrize(("rejected", "doubtful"), [(7, False), (9, True)])
def test_pairs_that_contradict_count_by_how_well_they_fit(rejected, doubtful):
    """Four pairs of f05 are used. Frames from the other side of an object fit it half as well, and say nothing true."""
    others = [k for k in range(N) if k != 5]
    false = tuple(PairFacts((NAMES[5], NAMES[k]), False, 0.5) for k in others[:rejected])
    found = judge_scan(scan(pairs=(*CHAIN, *false))).reasons
    assert any("most pairs with other frames" in reason for reason in found) == doubtful


def test_the_worst_reason_comes_first():
    verdict = worst([Reason("good", "a"), Reason("acceptable", "b"), Reason("poor", "c"), Reason("acceptable", "d")])
    assert (verdict.band, verdict.reasons) == ("poor", ("c", "b", "d"))
    assert listed(list("abcdefgh")) == "a, b, c, d, e, f and 2 more"


def test_each_reason_ends_with_what_helps_in_the_words_of_a_command():
    lost = {3: {"in_scan": False}, 4: {"sigma_rotation_deg": 5.0}}
    verdict = judge_scan(scan(lost, wrong_intrinsics=True, adjusted=False)).with_help(HELP)
    assert len(verdict.reasons) == 4 and all(any(end in reason for end in HELP.values()) for reason in verdict.reasons)
    assert all("sl-process" in words or "sl-calibrate" in words for words in HELP.values())
    assert worst([Reason("poor", "a", "again"), Reason("poor", "b")]).with_help({"again": "c"}).reasons == ("a; c", "b")
