"""From the results of the stages to what the report shows."""

import importlib.metadata
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sl_nerfstudio import __version__
from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.processing.advice import what_to_recapture
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frame_worker import FrameStageResult, clouds_of
from sl_nerfstudio.processing.intrinsics_words import contradiction
from sl_nerfstudio.processing.placed import place_frames
from sl_nerfstudio.processing.projector.found import FoundProjector
from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord, ProcessResult
from sl_nerfstudio.processing.scan_poses import ScanPoses
from sl_nerfstudio.processing.words import degeneracy_sentence, exclusion_sentence, uncertainty_sentence
from sl_nerfstudio.registration.pairs.edge_weights import support_of
from sl_nerfstudio.registration.result import Registration, UncertainRotation
from sl_nerfstudio.verdict.agreement import CrossFrameAgreement, FrameCrossAgreement
from sl_nerfstudio.verdict.facts import FrameFacts, PairFacts, ScanFacts
from sl_nerfstudio.verdict.judge import judge_scan
from sl_nerfstudio.verdict.shared_surface import SurfaceShares

_ALONE = "too few other frames could be used"


@dataclass(frozen=True)
class Failure:
    """Why a frame is not in the scan."""

    stage: str  # reading, decoding, calibrating, registering
    reason: str  # problem, cause and remedy


def left_out(result: FrameStageResult, registration: Registration | None) -> Failure | None:
    """Why a frame cannot be in the scan; None if it was registered. `registration` is None where it was not reached."""
    if result.cloud is None:
        return Failure(result.stage, result.reason)
    if registration is None:
        return Failure("registering", _ALONE)
    if registration.registered[registration.names.index(result.name)]:
        return None
    exclusion = next(e for e in registration.exclusions if e.frame == result.name)
    return Failure("registering", exclusion_sentence(exclusion))


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
) -> ProcessResult:
    """The result of a run; without `poses` no frame is in a scan.

    `cross` and `shares` (of what others show) are of the registered frames.
    `found`: the projector, if it was found from the frames. `contradicted`: which intrinsics the epipolar geometry
    contradicts; what the joint adjustment finds is said where this is empty.
    """
    frames = _with_others([_record(result, registration, poses) for result in results], cross, shares)
    edges = () if registration is None else registration.edges
    records = tuple(EdgeRecord(e.frames, float(e.overlap), float(e.fitness), e.used, e.undecided) for e in edges)
    adjusted = None if poses is None else poses.adjusted
    wrong = contradicted or _contradiction(results, adjusted)
    return ProcessResult(
        config=config,
        decoder=decoder,
        units="arbitrary" if poses is None else poses.units,
        scale_source=poses.scale.source if poses is not None and poses.scale.known else "",
        frames=frames,
        edges=records,
        remarks=(
            *([wrong] if wrong else []),
            *([found.doubt] if found and found.doubt else []),
            *_uncertain(registration),
        ),
        recapture=what_to_recapture(frames, records, not config.unordered),
        joint_px=None if adjusted is None else _both_known(adjusted.median_before_px, adjusted.median_after_px),
        cross_px=None if cross is None else _both_known(cross.px_median, cross.px_p95),
        verdict=judge_scan(
            ScanFacts(
                tuple(map(_facts, frames)),
                tuple(
                    PairFacts(e.frames, e.used, support_of(e.overlap, e.fitness))
                    for e in records
                    if e.used or not e.undecided
                ),
                cross,
                bool(wrong),
                () if registration is None else registration.turns_deg,
                registration is not None and registration.by_order,
                adjusted=not config.no_adjust,
            )
        ),
        projector=found,
        contradiction=wrong,
        placed=place_frames(results, registration, poses),
        versions={"sl_nerfstudio": __version__, **{p: importlib.metadata.version(p) for p in ("numpy", "torch")}},
    )


def _with_others(
    frames: Sequence[FrameRecord], cross: CrossFrameAgreement | None, shares: Sequence[SurfaceShares]
) -> tuple[FrameRecord, ...]:
    """The records with what the other frames say about each."""
    if cross is None:
        return tuple(frames)
    found = iter(zip(cross.frames, shares or [SurfaceShares(None, None)] * len(cross.frames), strict=True))
    return tuple(_agreeing(f, *next(found)) if f.in_scan else f for f in frames)


def _agreeing(frame: FrameRecord, found: FrameCrossAgreement, shares: SurfaceShares) -> FrameRecord:
    figures = {"cross_share": found.share, "cross_px_median": found.px_median, "cross_px_p95": found.px_p95,
               "cross_excess": found.excess}  # fmt: skip
    known = {key: value for key, value in figures.items() if np.isfinite(value)}
    return replace(frame, seen_share=found.seen, shared_decoded=shares.decoded, missing_share=shares.missing, **known)


def _facts(frame: FrameRecord) -> FrameFacts:
    """What the verdict judges of a frame."""
    return FrameFacts(
        frame.name,
        frame.in_scan,
        frame.component if frame.component >= 0 else None,
        frame.undecided,
        frame.sigma_rotation_deg,
        frame.decode_rate,
        frame.shared_decoded,
        frame.missing_share,
        frame.own_share,
        bool(frame.degeneracies),
    )


def _contradiction(results: Sequence[FrameStageResult], adjusted: AdjustedFrames | None) -> str:
    """Which intrinsics the captures contradict; "" if none."""
    clouds = clouds_of(results)
    if adjusted is None or not clouds:
        return ""
    return contradiction(adjusted.intrinsics, [cloud.camera for cloud in clouds], clouds[0].projector)


def _uncertain(registration: Registration | None) -> tuple[str, ...]:
    """What registration could not decide."""
    return () if registration is None else tuple(map(uncertainty_sentence, registration.uncertainties))


def _both_known(before: float, after: float) -> tuple[float, float] | None:
    """None where no point of one frame was seen by another: then there is nothing to compare."""
    return (float(before), float(after)) if np.isfinite([before, after]).all() else None


def _record(result: FrameStageResult, registration: Registration | None, poses: ScanPoses | None) -> FrameRecord:
    """What is known of one frame."""
    decoded = result.stage not in ("reading", "decoding")
    rate, share = (result.decode_rate, result.mask_share) if decoded else (None, None)
    failure, cloud = left_out(result, registration), result.cloud
    if cloud is None:
        return FrameRecord(result.name, False, result.stage, result.reason, rate, share)
    if failure is None and poses is None:
        failure = Failure("registering", _ALONE)
    record = FrameRecord(
        name=result.name,
        in_scan=failure is None,
        stage="" if failure is None else failure.stage,
        reason="" if failure is None else failure.reason,
        decode_rate=rate,
        mask_share=share,
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
