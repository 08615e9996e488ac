"""Good, acceptable or poor, with the reasons: verdicts on scans and on calibrations.

The verdict is the worst of everything that is known, not an average. Limits are multiples of the measured noise, shares
of pixels and of frames, and degrees; no lengths.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median_high
from typing import Literal

import numpy as np

from sl_nerfstudio.bundle_adjustment.modes import Mode
from sl_nerfstudio.bundle_adjustment.parameters import USUAL_FRAME_ROTATION_DEG
from sl_nerfstudio.calibration.board import BoardCalibration
from sl_nerfstudio.geometry.lie import DevicePoses, angle_deg
from sl_nerfstudio.review.agreement import (
    CONTRADICTING_EXCESS,
    GOOD_EXCESS,
    GOOD_SHARE,
    CrossFrameAgreement,
    FrameCrossAgreement,
    agreeing_groups,
    bridges,
)
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.scan.check_mixed_poses import SUSPECT_SIGMAS

Band = Literal["good", "acceptable", "poor"]
BANDS: tuple[Band, ...] = ("good", "acceptable", "poor")
_LISTED = 6  # names in a sentence

Help = Literal["", "again", "between", "light", "nearer", "poses", "adjust", "intrinsics", "boards"]
"""What helps; each command says it in its own words. "again": other captures of these views; "between": captures that
connect frames; "light": more of the pattern decoded; "nearer": captures whose projector is better determined;
"poses": better poses, or a true statement of how rough they are; "adjust": the joint
adjustment; "intrinsics": a calibration; "boards": more poses of the board. "": the sentence says it."""


@dataclass(frozen=True)
class Reason:
    """Something that keeps a scan from being good, and how far it does."""

    band: Band
    sentence: str  # names frames and figures
    help: Help = ""


@dataclass(frozen=True)
class Verdict:
    """The worst of all judgements."""

    band: Band
    reasons: tuple[str, ...]  # the worst first; empty for a good scan
    helps: tuple[Help, ...] = ()  # for each reason, what helps

    def with_help(self, words: Mapping[Help, str]) -> "Verdict":
        """Let each reason end with what helps, in the words of a command; kinds without words add nothing."""
        both = zip(self.reasons, self.helps, strict=True)
        return replace(self, reasons=tuple("; ".join(filter(None, [one, words.get(help)])) for one, help in both))


def worst(reasons: Iterable[Reason]) -> Verdict:
    """The verdict that some reasons lead to; good if there are none."""
    ordered = sorted((r for r in reasons if r.band != "good"), key=lambda r: -BANDS.index(r.band))
    return Verdict(
        ordered[0].band if ordered else "good", tuple(r.sentence for r in ordered), tuple(r.help for r in ordered)
    )


def listed(names: Sequence[str], most: int = _LISTED) -> str:
    """Names for a sentence: the first few, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


# Frames that ended farther from their starting poses than these were stated to be off, or than is usual.

_MOST_SIGMA = 6.0  # for each axis, RMS: by chance less than once in 10^20 frames


@dataclass(frozen=True)
class DepartedFrame:
    """A frame whose starting pose and result exclude each other: one of them is wrong."""

    name: str
    turned_deg: float  # of the camera, from its starting pose
    sigma_deg: float  # 1 sigma of that, about each axis
    stated: bool = True  # by the scan; otherwise what is usual


def departed_frames(scan: Scan, poses: DevicePoses) -> list[DepartedFrame]:
    """Frames whose cameras are turned by far more than the uncertainty of their starts: stated, or else usual.

    Positions are not compared: they depend on turns by as much as the camera is away from what it sees.
    """
    found = []
    for frame, T_start, T_end in zip(scan.frames, scan.poses.T_world_camera, poses.T_world_camera, strict=True):
        stated = frame.pose_sigma
        sigma = USUAL_FRAME_ROTATION_DEG if stated is None else stated.camera_rotation_deg
        turned = angle_deg(T_start[:3, :3].T @ T_end[:3, :3])
        if turned > _MOST_SIGMA * np.sqrt(3) * sigma:
            found.append(DepartedFrame(frame.name, turned, sigma, stated is not None))
    return found


def describe_departed(found: Sequence[DepartedFrame]) -> str:
    """Each frame in a few words."""
    return ", ".join(
        f"{one.name} ({one.turned_deg:.1f} deg, {'stated' if one.stated else 'usual'} {one.sigma_deg:.2g})"
        for one in found
    )


def departed_reasons(found: Sequence[DepartedFrame]) -> list[Reason]:
    """A result that excludes what it started from is not good, whichever of them is wrong."""
    return [Reason("acceptable", f"{describe_departed([one])}: far from its starting pose", "again") for one in found]


# The verdict on a calibration from boards, and why. Limits of a good calibration, and of an acceptable one:

DEVICES = ("camera", "projector")
_FOCAL = (0.003, 0.01)  # standard deviation of a focal length, relative to it
_UNDETERMINED_FOCAL = 0.05  # the same, beyond which the poses do not determine it and no result is written
_CENTRE = (0.005, 0.015)  # standard deviation of a principal point, relative to the focal length
_RMS_PX = (0.6, 1.5)  # of the corners in either device
_GOOD_PREDICTION = 2.0  # error of predicted corners in left-out poses, relative to the RMS of the fit
_GOOD_COVERAGE = 0.3  # share of the image's cells that hold corners
_LEAST_TILT_DEG = 20.0  # largest angle between two boards, below which they count as parallel
_LEAST_DEPTH_RATIO = 1.15  # distance of the farthest board over that of the nearest, below which they stand at one


def judge_calibration(found: BoardCalibration) -> Verdict:
    """The verdict on a calibration with all reasons."""
    return worst(_reasons(found))


def undetermined(found: BoardCalibration) -> tuple[str, ...]:
    """The devices whose focal length the poses do not determine."""
    return tuple(
        name
        for name, device, sigma in zip(DEVICES, found.adjusted.rig.devices, found.sigmas, strict=False)
        if sigma.focal() > _UNDETERMINED_FOCAL * device.fl_x
    )


def shortcomings(found: BoardCalibration) -> tuple[str, ...]:
    """Shortcomings of the poses, in half sentences."""
    c, out = found.coverage, []
    if c.tilt_deg < _LEAST_TILT_DEG:
        out.append(f"the boards are nearly parallel (the largest angle between two is {c.tilt_deg:.0f} degrees)")
    if c.depth_ratio < _LEAST_DEPTH_RATIO:
        out.append("all boards stand at one distance")
    if c.camera < _GOOD_COVERAGE:
        out.append(f"corners fill only {c.camera:.0%} of the camera's image")
    if c.projector is not None and c.projector < _GOOD_COVERAGE:
        out.append(f"corners fill only {c.projector:.0%} of the pattern")
    return tuple(out)


def _reasons(found: BoardCalibration) -> Iterator[Reason]:
    """Every judgement; `worst` leaves out what is good."""
    lacking = shortcomings(found)
    because = f"; {', and '.join(lacking)}" if lacking else ""
    for k, (device, sigma) in enumerate(zip(found.adjusted.rig.devices, found.sigmas, strict=True)):
        name = DEVICES[k]
        focal, centre = sigma.focal() / device.fl_x, sigma.centre() / device.fl_x
        uncertain = f"of the {name} is uncertain by"
        yield Reason(_band(focal, _FOCAL), f"the focal length {uncertain} {focal:.2%} (1 sigma){because}", "boards")
        pixels = f"{sigma.centre():.0f} px (1 sigma){because}"
        yield Reason(_band(centre, _CENTRE), f"the principal point {uncertain} {pixels}", "boards")
        corners = f"corners are {found.rms_px[k]:.2f} px (RMS) from where the {name} should see them"
        yield Reason(_band(found.rms_px[k], _RMS_PX), corners, "boards")
        if found.left_out.error_px[k] > _GOOD_PREDICTION * max(found.rms_px[k], found.adjusted.sigma_px[k]):
            yield Reason(
                "acceptable",
                f"corners of left-out poses are predicted to {found.left_out.error_px[k]:.2f} px in the {name}, "
                f"fitted ones to {found.rms_px[k]:.2f} px",
                "boards",
            )
    if found.misfit is not None:
        yield Reason(
            "acceptable",
            "the model of the camera's lens does not fit: with their distance from the middle of the image, corners "
            f"lie up to {-found.misfit.inwards_px:.2g} px inside and {found.misfit.outwards_px:.2g} px outside of "
            "where it puts them. The focal length may be wrong by more than its sigma. Wide-angle and fisheye lenses "
            "have no model beyond k1, k2: use a longer lens, or crop photographs and captures alike to the middle",
        )


def _band(value: float, limits: tuple[float, float]) -> Band:
    return "good" if not value > limits[0] else "acceptable" if value <= limits[1] else "poor"


# What a scan is judged by, as facts. What a command does not know is None, and is not judged.


@dataclass(frozen=True)
class FrameFacts:
    """One capture."""

    name: str
    in_scan: bool = True
    component: int | None = 0  # group of frames that registration connects: 0 the largest; None or -1: none
    undecided: bool = False  # registration could not decide its pose
    sigma_rotation_deg: float | None = None  # of the camera in the scan, 1 sigma per axis
    decode_rate: float | None = None  # of the visible pattern
    shared_decoded: float | None = None  # of the surface that other frames show, where this one sees the pattern
    missing_share: float | None = None  # of the surface that other frames show in its sight: where it saw no pattern
    own_share: float | None = None  # of the decoded pixels, those that agree with the pose of the frame's own projector
    rays_px: float | None = None  # how far its rays miss each other, where its pose states an uncertainty, pattern px
    stated_px: float | None = None  # of this, what the stated uncertainty explains, 1 sigma
    degeneracies: tuple[str, ...] = ()  # why the frame itself determines the pose of its projector only weakly


@dataclass(frozen=True)
class PairFacts:
    """Two frames that registration connected."""

    frames: tuple[str, str]
    used: bool  # False: contradicted by other pairs
    support: float = 1.0  # how much their surfaces share, and how little of that contradicts: from 0 to 1


@dataclass(frozen=True)
class OtherPlace:
    """Frames that may stand elsewhere as one: what was seen leaves it possible."""

    frames: tuple[str, ...]
    angle_deg: float  # by which they would be turned against the others
    odds: float  # of that place against the one in the scan

    def sentence(self) -> str:
        """Name the frames, how far the other place is, and how likely."""
        likely = f"1 in {1 / self.odds + 1:.0f}" if self.odds < 1 else "as likely"
        return f"{listed(self.frames)}: may be turned by {self.angle_deg:.0f} degrees against the others ({likely})"


def other_places(modes: Sequence[Mode], names: Sequence[str]) -> tuple[OtherPlace, ...]:
    """Other poses that an adjustment leaves possible; `names` of all its frames."""
    return tuple(
        OtherPlace(tuple(names[k] for k in mode.frames), mode.angle_deg, math.exp(min(mode.log_odds, 0.0)))
        for mode in modes
    )


@dataclass(frozen=True)
class ScanFacts:
    """All captures of a scan, in order."""

    frames: tuple[FrameFacts, ...]
    pairs: tuple[PairFacts, ...] | None = None  # of registration
    cross: CrossFrameAgreement | None = None  # of the frames in the scan, in their order
    wrong_intrinsics: bool = False  # the captures contradict the stated intrinsics
    turns_deg: tuple[float, ...] = ()  # after which the surface looks the same, so that frames may be turned by them
    by_order: tuple[str, ...] = ()  # frames that fit at several sides, of which the order of capture decided
    moving_share: float | None = None  # of the decoded pixels: what moves before cameras that stand still
    moving_registered: bool = False  # only this is in the scan
    other_places: tuple[OtherPlace, ...] = ()  # of frames in the scan
    adjusted: bool = True  # False: sl-process was told to leave the poses as registration found them

    @property
    def in_scan(self) -> tuple[FrameFacts, ...]:
        """Frames in the scan."""
        return tuple(frame for frame in self.frames if frame.in_scan)


# The verdict on a scan. A single frame beyond a limit keeps it from being good.

_MOST_FRAMES = 0.25  # share of frames that may be left out, undecided, unconfirmed or weakly decoded in a usable scan
_LEAST_DECODED = 0.5  # share of the surface that other frames show which must be decoded in every frame; of the visible
# pattern, where others show too little
_MOST_MISSING = 0.05  # share of the surface that others show, and that a frame should have seen, of which it may have
# seen nothing; in a single frame, something may have cast a shadow
_LEAST_OWN_SHARE = 0.5  # of a frame's decoded pixels, those that must agree with the frame's own pose of its projector:
# with less, another pose could explain the majority
_GOOD_SIGMA_DEG = 1.0  # standard deviation of a frame's rotation up to which a scan is good, and beyond which it is
# acceptable: edges of the object may be smeared by a hundredth of its size
_LARGEST_SIGMA_DEG = 3.0  # beyond which the frame may well be wrong and the scan is poor
_ACCEPTABLE_ODDS, _POOR_ODDS = 1e-3, 5e-2  # of another place of frames, from which a scan is not good, and is poor
_LEAST_SEEN = 0.15  # share of a frame's points that other frames must be able to judge, as registration demands
_LEAST_SHARE = 0.85  # of the judged points, those that must agree in an acceptable scan, in every frame and over all


def judge_scan(facts: ScanFacts) -> Verdict:
    """The verdict with all reasons; facts that are not known are not judged."""
    return worst(reasons_of(facts))


def reasons_of(facts: ScanFacts) -> Iterator[Reason]:
    """Everything that keeps the scan from being good."""
    if len(facts.in_scan) < 2:
        yield Reason("poor", f"only {len(facts.in_scan)} of {len(facts.frames)} frames could be used", "again")
        return
    if facts.moving_share is not None:
        yield _turntable(facts.moving_share, facts.moving_registered)
    yield from _left_out(facts)
    yield from _undecided(facts)
    for place in facts.other_places:
        if place.odds > _ACCEPTABLE_ODDS:
            yield Reason("poor" if place.odds > _POOR_ODDS else "acceptable", place.sentence(), "between")
    if facts.by_order:
        yield _placed_by_order(facts.by_order, facts.turns_deg)
    elif facts.turns_deg:
        yield Reason("poor", symmetry_sentence(facts.turns_deg))
    if facts.pairs is not None:
        yield from _weak_connections(facts)
    if facts.cross is not None:
        yield from cross_reasons([f.name for f in facts.in_scan], facts.cross)
    yield from _starting_poses(facts)
    yield from _decoding(facts)
    yield from _missing(facts)
    degenerate = [f.name for f in facts.in_scan if f.degeneracies]
    if len(degenerate) > _MOST_FRAMES * len(facts.in_scan):
        yield Reason("acceptable", f"the pose of the projector is weakly determined in {listed(degenerate)}", "nearer")
    if not facts.adjusted:
        yield Reason(
            "acceptable", "the poses are those of the registration alone (--no-adjust); frames were compared within "
            "its uncertainty only", "adjust",
        )  # fmt: skip
    if facts.wrong_intrinsics:
        yield Reason("acceptable", "the captures contradict the stated intrinsics", "intrinsics")


def _turntable(share: float, registered: bool) -> Reason:
    """Say that what turns was taken before something that stands still."""
    if registered:
        return Reason(
            "acceptable",
            f"turntable with a static background: only what moves, {share:.0%} of the decoded pixels, is in the scan. "
            "See in the report that it is all of the object; to be certain, cover the background, or leave it out with "
            "sl-process --masks",
        )
    return Reason(
        "poor",
        f"all cameras are in one place while {share:.0%} of the decoded pixels show something that moves: turntable "
        "with a static background. The scan holds the background, and the object in several positions: leave the "
        "background out with sl-process --masks, or cover it and capture again",
    )


def _left_out(facts: ScanFacts) -> Iterator[Reason]:
    """Frames that are not in the scan: those that form groups of their own, and single ones."""
    lost = [f for f in facts.frames if not f.in_scan]
    band = _share_band(len(lost), len(facts.frames))
    apart = sorted({f.component for f in lost if f.component and f.component > 0})
    for number in apart:
        names = [f.name for f in lost if f.component == number]
        yield Reason(
            band,
            f"{listed(names)}: {'form a group of their own' if len(names) > 1 else 'stands alone'}; the connection to "
            "the other frames is not certain, so they are not in the scan",
            "between",
        )
    single = [f.name for f in lost if f.component not in apart]
    if single:
        yield Reason(band, f"{len(single)} of {len(facts.frames)} frames were left out: {listed(single)}", "again")


def _undecided(facts: ScanFacts) -> Iterator[Reason]:
    """Frames in the scan whose pose is not certain."""
    good, largest = _GOOD_SIGMA_DEG, _LARGEST_SIGMA_DEG
    lost = [f for f in facts.in_scan if (f.sigma_rotation_deg or 0.0) > largest]
    if lost:
        yield Reason("poor", _known_only(lost, largest), "between")
    loose = [f for f in facts.in_scan if good < (f.sigma_rotation_deg or 0.0) <= largest]
    if loose and facts.adjusted:  # without the adjustment, it is so in every frame of any scan
        yield Reason("acceptable", _known_only(loose, good), "between")
    names = [f.name for f in facts.in_scan if f.undecided and f not in lost + loose]
    if names:
        band = _share_band(len(names), len(facts.in_scan))
        yield Reason(band, f"{listed(names)}: the pose is undecided; along the surface, others fit as well", "between")


def _known_only(frames: Sequence[FrameFacts], limit_deg: float) -> str:
    """Say that the rotation of frames is uncertain, with the most uncertain one."""
    sigma = max(f.sigma_rotation_deg or 0.0 for f in frames)
    said = f"{sigma:.2g}" if sigma < 10 else f"{sigma:.0f}"
    return (
        f"{listed([f.name for f in frames])}: rotation known only to {said} degrees (1 sigma of the least certain; at "
        f"most {limit_deg:g})"
    )


def symmetry_sentence(turns_deg: Sequence[float]) -> str:
    """Say that the surface looks the same after turns, and what it means."""
    return (
        f"{_same_after(turns_deg)}, and pairs of frames contradict each other by it: frames may be placed at another "
        "side than they show. The surface is right if the object really is that symmetric; for the poses, capture in "
        "small steps around it, or put something beside it that looks different from all sides"
    )


def _placed_by_order(names: Sequence[str], turns_deg: Sequence[float]) -> Reason:
    """Say what it means that the order of capture decided which side frames show."""
    how = "placed by the order of capture, each turned on from the one before as most are"
    if not turns_deg:
        return Reason(
            "acceptable",
            f"{listed(names)}: fit at several sides of the object; {how}. Unless they were captured in this order, in "
            "small steps, they are at other sides than they show",
        )
    return Reason(
        "poor",
        f"{listed(names)}: {_same_after(turns_deg)}, and nothing certain tells which side of it these show; {how}. "
        f"That is right if the frames were captured in this order, in steps of less than {min(turns_deg) / 2:.0f} "
        "degrees; to be certain, put something beside it that looks different from all sides",
    )


def _same_after(turns_deg: Sequence[float]) -> str:
    return f"the object looks the same after a turn by {listed([f'{angle:.0f}' for angle in turns_deg])} degrees"


def _weak_connections(facts: ScanFacts) -> Iterator[Reason]:
    """Pairs of frames that contradict other pairs, and single pairs that hold the scan together."""
    pairs, names = facts.pairs or (), [f.name for f in facts.in_scan]
    inside = [p for p in pairs if set(p.frames) <= set(names)]
    used = [p.frames for p in inside if p.used]
    # frames from opposite sides are compared, too, where no order is known, and fit somewhere, though not well
    doubtful = [name for name in names if _support(name, inside, False) > _support(name, inside, True)]
    if doubtful:
        yield Reason(
            _share_band(len(doubtful), len(names)),
            f"{listed(doubtful)}: most pairs with other frames contradict the pose found",
            "again",
        )
    index = {name: k for k, name in enumerate(names)}
    if len(names) < 3:
        return  # the only pair: nothing could confirm it but the agreement of its coordinates, which is judged
    for (a, b), part in bridges([(index[a], index[b]) for a, b in used], len(names)):
        yield Reason(
            "acceptable",
            f"only the pair {names[a]} and {names[b]} connects {listed([names[k] for k in part])} to the other frames; "
            "no other pair confirms it",
            "between",
        )


def _support(name: str, pairs: Iterable[PairFacts], used: bool) -> float:
    """Sum the support of the pairs of a frame that are used, or are not."""
    return math.fsum(p.support for p in pairs if name in p.frames and p.used == used)


def cross_reasons(names: Sequence[str], cross: CrossFrameAgreement) -> Iterator[Reason]:
    """Reasons in how the coordinates of the frames agree; `names` in the order of `cross.frames`."""
    alone = [name for name, f in zip(names, cross.frames, strict=True) if not f.seen >= _LEAST_SEEN]
    if alone:
        yield Reason(
            _share_band(len(alone), len(names)),
            f"{listed(alone)}: no other frame shows enough of the same surface (at least {_LEAST_SEEN:.0%}) to "
            "confirm the pose",
            "between",
        )
    if not cross.pairs:
        return
    groups = agreeing_groups(cross)
    named = {k for group in groups[1:] for k in group}
    yield from _contradicting_groups(names, cross, groups)
    for k, (name, frame) in enumerate(zip(names, cross.frames, strict=True)):
        band = frame_band(frame)
        if band != "good" and k not in named:
            yield Reason(band, _frame_sentence(name, frame, cross, band), "again")
    if cross.share < GOOD_SHARE:
        yield Reason(
            "poor" if cross.share < _LEAST_SHARE else "acceptable",
            f"of all points that two frames saw, {cross.share:.0%} agree: 95 % lie within {cross.px_p95:.2g} px, the "
            f"noise is {cross.noise_px:.2g} px",
            "poses",
        )


def _starting_poses(facts: ScanFacts) -> Iterator[Reason]:
    """Relative poses that the coordinates of their own frames exclude, by what is stated of them."""
    known = [(f.rays_px / f.stated_px, f) for f in facts.in_scan if f.rays_px is not None and f.stated_px]
    if not known:
        return
    if median_high([excess for excess, _ in known]) > SUSPECT_SIGMAS:
        rays, stated = (median_high([value or 0.0 for value in values]) for values in zip(
            *((f.rays_px, f.stated_px) for _, f in known), strict=True
        ))  # fmt: skip
        yield Reason(
            "poor",
            f"the rays of camera and projector miss each other by {rays:.2g} px (median), the stated uncertainty of "
            f"the poses explains {stated:.2g} px: poses or intrinsics are of another calibration, or sl_pose_sigma is "
            "too small. Without sl_pose_sigma the training searches farther from these poses; sl-process finds "
            "poses from the photographs",
        )
        return
    bad = [(excess, f) for excess, f in known if excess > _MOST_SIGMA]
    if bad:
        frame = max(bad, key=lambda one: one[0])[1]
        yield Reason(
            _share_band(len(bad), len(facts.in_scan)),
            f"{listed([f.name for _, f in bad])}: the rays of camera and projector miss each other by far more than "
            f"the stated uncertainty of the poses explains ({frame.name}: {frame.rays_px:.2g} px, stated "
            f"{frame.stated_px:.2g} px); give these frames another pose of the projector, or leave them out",
        )


def frame_band(frame: FrameCrossAgreement) -> Band:
    """The judgement on one frame by its agreement with the others."""
    if frame.share < _LEAST_SHARE or frame.excess > CONTRADICTING_EXCESS:
        return "poor"
    return "acceptable" if frame.share < GOOD_SHARE or frame.excess > GOOD_EXCESS else "good"


def _contradicting_groups(
    names: Sequence[str], cross: CrossFrameAgreement, groups: Sequence[Sequence[int]]
) -> Iterator[Reason]:
    if len(groups) > 1 and len(groups[0]) <= len(names) / 4:
        yield Reason(
            "poor",
            f"the frames contradict each other: at most {len(groups[0])} of {len(names)} agree, and 95 % of the points "
            f"that two frames saw lie only within {cross.px_p95:.2g} px",
            "poses",
        )
        return
    for group in groups[1:]:
        between = [p.px_p95 for p in cross.pairs if len(set(p.frames) & set(group)) == 1]
        if not between:
            yield Reason(
                "poor",
                f"{listed([names[k] for k in group])}: no surface in common with the other frames, so nothing confirms "
                "how the two parts lie to each other",
                "between",
            )
            continue
        if len(group) == 1:
            yield Reason("poor", _frame_sentence(names[group[0]], cross.frames[group[0]], cross, "poor"), "again")
            continue
        yield Reason(
            "poor",
            f"{listed([names[k] for k in group])}: agree with each other and contradict the other frames: 95 % of the "
            f"points that both saw lie only within {median_high(between):.2g} px (in the whole scan: noise "
            f"{cross.noise_px:.2g} px)",
            "again",
        )


def _frame_sentence(name: str, frame: FrameCrossAgreement, cross: CrossFrameAgreement, band: Band) -> str:
    usual = median_high([f.px_p95 for f in cross.frames if math.isfinite(f.px_p95)])
    return (
        f"{name}: {'contradicts' if band == 'poor' else 'agrees less well with'} the frames that saw the same surface: "
        f"{frame.excess:.2g} times the usual residual, {frame.share:.0%} of its points within the noise, 95 % within "
        f"{frame.px_p95:.2g} px (usual in this scan: {usual:.2g} px)"
    )


def _decoding(facts: ScanFacts) -> Iterator[Reason]:
    """Frames with little decoded, and frames whose coordinates contradict their own pose."""
    own = "of the decoded pixels agree with the pose of the projector"
    seen = [(f.shared_decoded, f) for f in facts.in_scan]
    alone = [(f.decode_rate, f) for f in facts.in_scan if f.shared_decoded is None]
    for shares, least, words in (
        (seen, _LEAST_DECODED, "of the surface that other frames show was decoded"),
        (alone, _LEAST_DECODED, "of the visible pattern was decoded"),
        ([(f.own_share, f) for f in facts.in_scan], _LEAST_OWN_SHARE, own),
    ):
        weak = [(value, f.name) for value, f in shares if value is not None and value < least]
        if weak:
            share, name = min(weak)
            others = f"; also little in {listed([n for _, n in weak if n != name])}" if len(weak) > 1 else ""
            band = _share_band(len(weak), len(facts.in_scan))
            sentence = f"{name}: only {share:.0%} {words} (at least {least:.0%}){others}"
            yield Reason(band, sentence, "again" if words == own else "light")


def _missing(facts: ScanFacts) -> Iterator[Reason]:
    """Frames that saw nothing where others show a surface."""
    found = [(f.missing_share, f.name) for f in facts.in_scan if (f.missing_share or 0.0) > _MOST_MISSING]
    if found:
        worst_share = max(share or 0.0 for share, _ in found)
        yield Reason(
            _share_band(len(found), len(facts.in_scan)),
            f"{listed([name for _, name in found])}: saw nothing of the pattern where other frames show a surface in "
            f"the sight of both devices ({worst_share:.0%} of it in the worst of them; at most {_MOST_MISSING:.0%}): "
            "something cast a shadow, or frames are at the wrong place",
            "again",
        )


def _share_band(count: int, total: int) -> Band:
    return "poor" if count > _MOST_FRAMES * total else "acceptable"
