"""The result of `sl-process`, for the report and for programs."""

import importlib.metadata
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sl_nerfstudio import __version__
from sl_nerfstudio.bundle_adjustment.parameters import SelfCalibration
from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.calibration.stated import describe_change
from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frames import FrameStageResult, capture_sentences, clouds_of
from sl_nerfstudio.processing.inputs import CaptureNotes
from sl_nerfstudio.processing.object_only import ObjectOnly, object_document
from sl_nerfstudio.processing.projector import FoundProjector
from sl_nerfstudio.processing.scan_poses import PlacedGroup, ScanPoses, place_frames
from sl_nerfstudio.registration.pairs import support_of
from sl_nerfstudio.registration.result import (
    CoordinatesDisagree,
    Exclusion,
    NoCommonSurface,
    OpenPlace,
    Registration,
    SeparateComponent,
    SurfaceDisagrees,
    UncertainRotation,
    UndecidedProjector,
)
from sl_nerfstudio.registration.surfaces import FrameCloud
from sl_nerfstudio.relative_pose.estimation import Degeneracy, DegeneracyKind
from sl_nerfstudio.review.agreement import CrossFrameAgreement, SurfaceShares
from sl_nerfstudio.review.moving_part import MovingPart, in_one_place
from sl_nerfstudio.review.verdict import (
    FrameFacts,
    Help,
    PairFacts,
    ScanFacts,
    Verdict,
    judge_scan,
    listed,
    other_places,
)
from sl_nerfstudio.scan.document import FileError, read_document

# Sentences for what relative pose estimation and registration found out about frames.

_LISTED = 3  # other frames of a group in a sentence
_DEGENERACIES: dict[DegeneracyKind, str] = {
    "few points": "only {:.0f} decoded pixels agree with each other; capture the object larger in the image, or with "
    "more light",
    "small part of the pattern": "decoded pixels cover only {:.0f} of {:.0f} squares of the pattern; let more of the "
    "pattern fall on the object",
    "pure rotation": "a rotation of the projector alone, without any distance to the camera, explains the coordinates "
    "to within {:.2g} px; hold the projector farther from the camera",
    "small parallax": "camera rays and projector rays meet at only {:.2g} degrees; hold the projector farther from the "
    "camera",
    "planar": "all points lie in one plane to within {:.2g} px, and a plane does not determine the pose; show parts at "
    "other depths in this view",
    "epipole in view": "one device is in the other's view of the object, and depth cannot be measured around that "
    "place; move the projector to the side",
    "ambiguous": "a second pose explains {:.0%} of the coordinates, and this one {:.0%}; show parts at other depths in "
    "this view",
    "many outliers": "{:.0%} of the coordinates contradict the rest; check the pattern file and the light",
    "poor fit": "coordinates miss their epipolar curves by {:.2g} px; check the intrinsics of both devices and the "
    "projector's model (OPENCV or DOE)",
    "uncertain": "the pose is known only to {:.2g} degrees (rotation) and {:.2g} degrees (direction of the baseline)",
}


def degeneracy_sentence(degeneracy: Degeneracy) -> str:
    """What was found in a frame, and what to do about it."""
    return _DEGENERACIES[degeneracy.kind].format(*degeneracy.figures)


def exclusion_sentence(exclusion: Exclusion) -> str:
    """Why a frame was not registered, and what to do about it."""
    if isinstance(exclusion, SurfaceDisagrees):
        return (
            f"only {exclusion.fitness:.0%} of its surface agrees with that of the other frames where its pairs place "
            "it; the object moved, or the relative pose of this frame is wrong: capture this view again"
        )
    if isinstance(exclusion, NoCommonSurface):
        return "no other frame shows any of its surface; capture views in between"
    if isinstance(exclusion, OpenPlace):
        others = [name for name in exclusion.group if name != exclusion.frame]
        group = f"it and {listed(others, _LISTED)} fit" if others else "it fits"
        where = f"between it and {exclusion.partner}" if exclusion.partner else "between it and the other frames"
        odds = f"odds of {np.exp(exclusion.log_odds):.0f} to 1" if exclusion.log_odds > 1 else "even odds"
        return (
            f"{group} the other frames in two ways, {exclusion.turn_deg:.0f} degrees apart ({odds}); capture views "
            f"{where}, or put a mark on the object (chalk, tape, a screw) that both see"
        )
    if isinstance(exclusion, UndecidedProjector):
        return (
            f"two poses of the projector, {exclusion.angle_deg:.0f} degrees apart, explain its coordinates, and the "
            "other frames do not decide between them; show parts at other depths in this view"
        )
    if isinstance(exclusion, CoordinatesDisagree):
        others = [name for name in exclusion.group if name != exclusion.frame]
        with_others = f" and those of {listed(others, _LISTED)} agree with each other but" if others else ""
        who = f"its coordinates{with_others}"
        return f"{who} contradict those of the other frames wherever these place it; capture this view again"
    if isinstance(exclusion, SeparateComponent):
        others = [name for name in exclusion.component if name != exclusion.frame]
        group = f"it and {listed(others, _LISTED)} form a group whose" if others else "its"
        remedy = f"between it and {exclusion.partner}" if exclusion.partner else "between it and the other frames"
        why = "may slip along the surface (of revolution, or a plane)" if exclusion.slips else "is not certain"
        more = (
            ", with marks on the object (chalk, tape) or something beside it that does not look the same from all sides"
        )
        return f"{group} connection to the other frames {why}; capture views {remedy}{more if exclusion.slips else ''}"
    return (
        f"its best partner, {exclusion.partner}, shares {exclusion.overlap:.0%} of the surface, and "
        f"{exclusion.fitness:.0%} of what both saw agrees, which does not say where they belong (evidence of "
        f"{exclusion.log_odds:.0f} nats, needed: {exclusion.least_odds:.0f}); capture views in between"
    )


def uncertainty_sentence(uncertainty: UncertainRotation) -> str:
    """What is uncertain about a registered frame."""
    return (
        f"{uncertainty.frame}: it may slip along the surface; its rotation is known only to "
        f"{uncertainty.sigma_deg:.1f} degrees (surface of revolution, or plane?)"
    )


def contradiction(found: SelfCalibration | None, cameras: Sequence[Device], projector: Device) -> str:
    """Which intrinsics would agree better; "" if the captures do not contradict the stated ones."""
    if found is None or not found.contradicts():
        return ""
    change, sigma = (IntrinsicsChange.of(values.tolist()) for values in (found.change, found.sigma))
    return "\n".join(
        [
            f"The intrinsics contradict the captures (chi square {found.chi_square:.0f}, by chance 6). These changes, "
            "together, would agree better:",
            *(f"    {line}" for line in describe_change(change, sigma, cameras, projector)),
            "    cause:  the calibration of a device is off, or was made with another zoom, focus or image size",
            "    remedy: calibrate again, or train with --pipeline.model.refine-intrinsics True",
        ]
    )


# The records.

_Record = TypeVar("_Record", "FrameRecord", "EdgeRecord")


@dataclass(frozen=True)
class FrameRecord(FrameFacts):
    """All figures of one frame, and why it was left out if it was. Figures that do not exist are None."""

    component: int = -1  # group of frames that registration connects: 0 the largest, which is in the scan; -1: none
    stage: str = ""  # in which it failed: reading, decoding, calibrating, registering, separating; "" if it did not
    reason: str = ""  # problem, cause and remedy
    mask_share: float | None = None  # of the image
    epipolar_px: float | None = None  # robust standard deviation of the epipolar error, pattern pixels
    relative_sigma_rotation_deg: float | None = None  # of the projector against the camera, from this frame alone
    relative_sigma_direction_deg: float | None = None
    fitness: float | None = None  # share of the points seen by other frames, too, that agree with them
    seen_share: float | None = None  # of its points, those that other frames can judge by their coordinates
    cross_share: float | None = None  # of these, those that agree: the median over the frames it is compared with
    cross_px_median: float | None = None  # their residual, pattern pixels, the same median
    cross_px_p95: float | None = None  # 95 % of the residuals are smaller
    cross_excess: float | None = None  # residual in units of what is expected, relative to the scan's better pairs
    baseline: float | None = None  # camera to projector, in the scan's unit


@dataclass(frozen=True)
class EdgeRecord:
    """Two frames that were registered with each other."""

    frames: tuple[str, str]
    overlap: float
    fitness: float
    used: bool
    undecided: bool


@dataclass(frozen=True, kw_only=True)
class ProcessRecord:
    """What processing.json says of the captures."""

    decoder: str
    units: str
    scale_source: str  # "": not known
    frames: tuple[FrameRecord, ...]
    edges: tuple[EdgeRecord, ...]
    remarks: tuple[str, ...]
    recapture: tuple[str, ...]  # what to capture again or in addition, and why
    joint_px: tuple[float, float] | None  # cross-frame residual before and after the joint adjustment
    cross_px: tuple[float, float] | None  # the same over all points that two frames saw: median, 95 %
    verdict: Verdict
    versions: dict[str, str]

    @property
    def registered(self) -> int:
        """Number of frames in the scan."""
        return sum(frame.in_scan for frame in self.frames)


def read_record(path: Path) -> ProcessRecord:
    """Read a processing.json. Raises FileError if it is none."""
    document = read_document(path)
    try:
        return ProcessRecord(
            decoder=document["decoder"],
            units=document["units"],
            scale_source=document["scale"] or "",
            frames=tuple(_recorded(FrameRecord, frame) for frame in document["frames"]),
            edges=tuple(_recorded(EdgeRecord, edge) for edge in document["overlaps"]),
            remarks=tuple(document["remarks"]),
            recapture=tuple(document["recapture"]),
            joint_px=_pair(document["joint_adjustment_px"]),
            cross_px=_pair(document["cross_frame_px"]),
            verdict=Verdict(document["verdict"], tuple(document["reasons"])),
            versions=document["versions"],
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileError(
            path, f"is not what sl-process writes ({error})", "it was edited, or is of another version",
            "run the same sl-process again, which takes seconds, or remove this file",
        ) from error  # fmt: skip


def _recorded(kind: type[_Record], stated: dict[str, Any]) -> _Record:
    """A record with lists as tuples; what other versions wrote besides does not count."""
    known = {one.name for one in fields(kind)}
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in stated.items() if k in known}
    return kind(**values)


def _pair(values: list[float] | None) -> tuple[float, float] | None:
    if values is None:
        return None
    first, second = map(float, values)
    return first, second


@dataclass(frozen=True, kw_only=True)
class ProcessResult(ProcessRecord):
    """Everything the report shows."""

    config: ProcessConfig
    projector: FoundProjector | None = None  # None: the projector is the stated one
    contradiction: str = ""  # which intrinsics the captures contradict; it is among the remarks, too
    object_only: ObjectOnly | None = None  # None: surroundings were not looked for
    captured: CaptureNotes | None = None  # on the captures
    placed: tuple[PlacedGroup, ...] = field(default=(), compare=False)  # for the 3D view of the report

    def document(self) -> dict[str, Any]:
        """Return the content of processing.json."""
        return {
            "verdict": self.verdict.band,
            "reasons": list(self.verdict.reasons),
            "decoder": self.decoder,
            "units": self.units,
            "scale": self.scale_source or None,
            "projector": None if self.projector is None else self.projector.document(),
            "frames": [
                {key: value for key, value in vars(frame).items() if value not in (None, "", ())}
                for frame in self.frames
            ],
            "overlaps": [vars(edge) for edge in self.edges],
            "remarks": list(self.remarks),
            "recapture": list(self.recapture),
            "joint_adjustment_px": self.joint_px,
            "captures": None if self.captured is None else self.captured.document(),
            "object_only": None if self.object_only is None else object_document(self.object_only),
            "cross_frame_px": self.cross_px,
            "versions": self.versions,
        }


def without_empty(frames: Sequence[FrameRecord], found: ObjectOnly) -> tuple[FrameRecord, ...]:
    """The records; frames that show nothing of the object are not in the scan."""
    reason = (
        "shows nothing of the object\n    cause:  all decoded pixels belong to its surroundings, by --object-only\n"
        "    remedy: capture the object in this view, or leave --object-only out"
    )
    empty = set(found.empty_frames())
    return tuple(
        replace(f, in_scan=False, stage="separating", reason=reason) if f.in_scan and f.name in empty else f
        for f in frames
    )


# What helps against each reason of the verdict, and what to capture again, and why.

HELP: dict[Help, str] = {
    "again": "capture these views again, and run the same sl-process with them",
    "between": "capture views in between, and run the same sl-process with them",
    "light": "focus better, with more light from the projector and less from the room, capture it again, and run the "
    "same sl-process",
    "nearer": "hold the projector farther from the camera, show parts at other depths, and run the same sl-process",
    "poses": "calibrate both devices again with sl-calibrate, and run sl-process with the new intrinsics",
    "adjust": "run the same sl-process without --no-adjust",
    "intrinsics": "calibrate again with sl-calibrate, or train with ns-train sl-neus --data SCAN "
    "--pipeline.model.refine-intrinsics True",
}

_LOW_RATE = 0.6  # decoded share of the pattern
_SMALL_SHARE = 0.03  # of the image that shows the pattern
_POOR_FITNESS = 0.65  # share of a frame's points that agree with other frames


def what_to_recapture(frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord], ordered: bool) -> tuple[str, ...]:
    """One sentence for each problem, the most important first; empty if nothing is needed."""
    return (*_lost(frames), *_gaps(frames, edges, ordered), *(s for f in frames if f.in_scan for s in _weak(f)))


def _lost(frames: Sequence[FrameRecord]) -> list[str]:
    """One sentence for all frames that were left out for the same reason, or are connected with each other."""
    together: dict[tuple[int, str], list[FrameRecord]] = {}
    for frame in frames:
        if not frame.in_scan:
            key = (frame.component, "") if frame.component > 0 else (-1, first_line(frame.reason))
            together.setdefault(key, []).append(frame)
    sentences = []
    for (component, _), group in together.items():
        advice = "capture them again; each"
        if len(group) == 1:
            advice = "capture it again; it"
        elif component > 0:
            advice = f"capture views that connect this group {component} with the scan; {group[0].name}"
        names = ", ".join(frame.name for frame in group)
        sentences.append(f"{names}: {advice} was left out ({first_line(group[0].reason)})")
    return sentences


def first_line(reason: str) -> str:
    """The problem without cause and remedy."""
    return reason.strip().splitlines()[0] if reason.strip() else "no reason known"


def _gaps(frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord], ordered: bool) -> list[str]:
    """Places where frames are connected to the others badly or not at all."""
    if ordered:
        return [
            f"between {a} and {b}: add a frame; the two share too little of the surface to be registered directly"
            for a, b in unconnected_neighbours(frames, edges)
        ]
    present, used = _present_and_used(frames, edges)
    single = [name for name in present if sum(name in pair for pair in used) == 1 and len(present) > 2]
    return [f"near {name}: add a frame; only one other frame overlaps it" for name in single]


def unconnected_neighbours(frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord]) -> list[tuple[str, str]]:
    """Frames of the scan that follow each other, but were not registered with each other."""
    present, used = _present_and_used(frames, edges)
    return [(a, b) for a, b in pairwise(present) if frozenset((a, b)) not in used]


def _present_and_used(
    frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord]
) -> tuple[list[str], set[frozenset[str]]]:
    """The frames of the scan, and the pairs that were used."""
    return [f.name for f in frames if f.in_scan], {frozenset(edge.frames) for edge in edges if edge.used}


def _weak(frame: FrameRecord) -> list[str]:
    """What makes a frame of the scan unreliable."""
    advice = list(frame.degeneracies)
    shared = frame.shared_decoded is not None
    rate, what = (frame.shared_decoded, "surface that other frames show") if shared else (frame.decode_rate, "pattern")
    if rate is not None and rate < _LOW_RATE:
        advice.append(
            f"only {rate:.0%} of the {what} was decoded; focus better, use more light from the projector and less from "
            "the room, and expose so that lines are neither faint nor saturated"
        )
    if frame.mask_share is not None and frame.mask_share < _SMALL_SHARE:
        advice.append(f"the pattern fills only {frame.mask_share:.1%} of the image; go closer, or aim better")
    if frame.fitness is not None and frame.fitness < _POOR_FITNESS:
        advice.append(
            f"only {frame.fitness:.0%} of its points agree with the frames it overlaps; something moved, or its pose "
            "is uncertain: capture it again"
        )
    return [f"{frame.name}: {one}" for one in advice]


# From the results of the stages to what the report shows.

_ALONE = "too few other frames could be used"


def left_out(result: FrameStageResult, registration: Registration | None) -> tuple[str, str] | None:
    """Stage and reason of a frame that cannot be in the scan; None if it was registered.

    `registration` is None where it was not reached.
    """
    if result.cloud is None:
        return result.stage, result.reason
    if registration is None:
        return "registering", _ALONE
    if registration.registered[registration.names.index(result.name)]:
        return None
    exclusion = next(e for e in registration.exclusions if e.frame == result.name)
    return "registering", exclusion_sentence(exclusion)


def summarise(
    config: ProcessConfig,
    decoder: str,
    results: Sequence[FrameStageResult],
    registration: Registration | None,
    poses: ScanPoses | None,
    cross: CrossFrameAgreement | None = None,
    shares: Sequence[SurfaceShares] = (),
    found: FoundProjector | None = None,
    contradicted: str = "",
    captured: CaptureNotes | None = None,
    parts: ObjectOnly | None = None,
    moving: MovingPart | None = None,
) -> ProcessResult:
    """The result of a run; without `poses` no frame is in a scan.

    `cross` and `shares` (of what others show) are of the frames in the scan: registered, and not empty by `parts`.
    `moving`: what moves before a static background.
    `found`: the projector, if it was found from the frames. `contradicted`: which intrinsics the epipolar geometry
    contradicts; what the joint adjustment finds is said where this is empty.
    """
    records = [_record(result, registration, poses) for result in results]
    frames = _with_others(records if parts is None else without_empty(records, parts), cross, shares)
    edges = () if registration is None else registration.edges
    pairs = tuple(EdgeRecord(e.frames, float(e.overlap), float(e.fitness), e.used, e.undecided) for e in edges)
    adjusted = None if poses is None else poses.adjusted
    wrong = contradicted or _contradiction(results, adjusted)
    placed = place_frames(results, registration, poses)
    decided = [e for e in pairs if e.used or not e.undecided]
    facts = ScanFacts(
        frames,
        tuple(PairFacts(e.frames, e.used, support_of(e.overlap, e.fitness)) for e in decided),
        cross,
        bool(wrong),
        () if registration is None else registration.turns_deg,
        () if registration is None else registration.by_order,
        None if moving is None else moving.share,
        moving is not None and moving.registered,
        () if adjusted is None else other_places(adjusted.modes, [cloud.name for cloud in clouds_of(results)]),
        adjusted=not config.no_adjust,
    )
    return ProcessResult(
        config=config,
        decoder=decoder,
        units="arbitrary" if poses is None else poses.units,
        scale_source=poses.scale.source if poses is not None and poses.scale.known else "",
        frames=frames,
        edges=pairs,
        remarks=(
            *([wrong] if wrong else []),
            *([found.doubt] if found and found.doubt else []),
            *(map(uncertainty_sentence, registration.uncertainties) if registration else ()),
            *capture_sentences([(result.name, result.notes) for result in results]),
        ),
        recapture=what_to_recapture(frames, pairs, not config.unordered),
        joint_px=None if adjusted is None else _both_known(adjusted.median_before_px, adjusted.median_after_px),
        cross_px=None if cross is None else _both_known(cross.px_median, cross.px_p95),
        verdict=judge_scan(facts).with_help(HELP),
        projector=found,
        contradiction=wrong,
        object_only=parts,
        captured=captured,
        placed=placed if parts is None else tuple(group.only_object(parts.parts) for group in placed),
        versions={"sl_nerfstudio": __version__, **{p: importlib.metadata.version(p) for p in ("numpy", "torch")}},
    )


def _with_others(
    frames: Sequence[FrameRecord], cross: CrossFrameAgreement | None, shares: Sequence[SurfaceShares]
) -> tuple[FrameRecord, ...]:
    """The records with what the other frames say about each."""
    if cross is None:
        return tuple(frames)
    found = iter(zip(cross.frames, shares or [SurfaceShares(None, None)] * len(cross.frames), strict=True))
    out = []
    for frame in frames:
        if frame.in_scan:
            agreement, own = next(found)
            figures = {"cross_share": agreement.share, "cross_px_median": agreement.px_median,
                       "cross_px_p95": agreement.px_p95, "cross_excess": agreement.excess}  # fmt: skip
            known: dict[str, float | None] = {key: value for key, value in figures.items() if np.isfinite(value)}
            known |= {"seen_share": agreement.seen, "shared_decoded": own.decoded, "missing_share": own.missing}
            frame = replace(frame, **known)
        out.append(frame)
    return tuple(out)


def _contradiction(results: Sequence[FrameStageResult], adjusted: AdjustedFrames | None) -> str:
    """Which intrinsics the captures contradict; "" if none."""
    clouds = clouds_of(results)
    if adjusted is None or not clouds or repeat_each_other(adjusted.poses, clouds):
        return ""
    cameras = [cloud.camera.scaled(float(results[0].frame.shrink)) for cloud in clouds]  # one factor for all frames
    return contradiction(adjusted.intrinsics, cameras, clouds[0].projector)


def repeat_each_other(poses: DevicePoses, clouds: Sequence[FrameCloud]) -> bool:
    """Whether both devices stood still in all frames: their errors repeat, and say nothing more than those of one."""
    placed = np.isfinite(poses.T_world_camera).all((1, 2))
    chosen = poses[placed]
    depths = [-float(np.median(cloud.points[:, 2])) for cloud in clouds]
    depth = float(np.median(depths)) * float(np.median(chosen.baseline)) if len(chosen) else 0.0
    projectors = DevicePoses(chosen.T_world_projector, chosen.T_world_camera)
    return in_one_place(chosen, depth) and in_one_place(projectors, depth)


def _both_known(before: float, after: float) -> tuple[float, float] | None:
    """Both values; None where no point of one frame was seen by another: then there is nothing to compare."""
    return (float(before), float(after)) if np.isfinite([before, after]).all() else None


def _record(result: FrameStageResult, registration: Registration | None, poses: ScanPoses | None) -> FrameRecord:
    """What is known of one frame."""
    cloud, failure = result.cloud, left_out(result, registration)
    if failure is None and poses is None:
        failure = "registering", _ALONE
    stage, reason = failure or ("", "")
    record = FrameRecord(result.name, failure is None, stage=stage, reason=reason)
    if result.stage not in ("reading", "decoding"):
        record = replace(record, decode_rate=result.decode_rate, mask_share=result.mask_share)
    if cloud is None:
        return record
    record = replace(
        record,
        epipolar_px=float(cloud.pose.residual_px),
        own_share=float(cloud.pose.inliers.mean()),
        relative_sigma_rotation_deg=cloud.pose.sigma_rotation_deg,
        relative_sigma_direction_deg=cloud.pose.sigma_direction_deg,
        degeneracies=tuple(map(degeneracy_sentence, cloud.pose.degeneracies)),
    )
    return record if registration is None else _registered(record, registration, poses)


def _registered(record: FrameRecord, registration: Registration, poses: ScanPoses | None) -> FrameRecord:
    """The record with what registration and the joint adjustment found."""
    k = registration.names.index(record.name)
    record = replace(record, component=int(registration.component[k]))
    if not record.in_scan or poses is None:
        return record
    doubts = [u for u in registration.uncertainties if u.frame == record.name]
    stated = poses.adjusted.sigma[k]
    sigmas = [u.sigma_deg for u in doubts if isinstance(u, UncertainRotation)]
    return replace(
        record,
        undecided=bool(doubts),
        sigma_rotation_deg=max([*sigmas, *([] if stated is None else [stated.camera_rotation_deg])], default=None),
        fitness=float(np.nan_to_num(registration.fitness[k])),
        baseline=float(poses.adjusted.poses.baseline[k]),
    )
