"""From the results of the stages to what the report shows."""

import importlib.metadata
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sl_nerfstudio import __version__
from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.processing.advice import what_to_recapture
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frame_worker import FrameStageResult, clouds_of
from sl_nerfstudio.processing.intrinsics_words import contradiction
from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord, ProcessResult
from sl_nerfstudio.processing.scan_poses import ScanPoses
from sl_nerfstudio.processing.words import degeneracy_sentence, exclusion_sentence, uncertainty_sentence
from sl_nerfstudio.registration.result import Registration

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
) -> ProcessResult:
    """The result of a run; without `poses` no frame is in a scan."""
    frames = tuple(_record(result, registration, poses) for result in results)
    edges = () if registration is None else registration.edges
    records = tuple(EdgeRecord(e.frames, float(e.overlap), float(e.fitness), e.used, e.undecided) for e in edges)
    adjusted = None if poses is None else poses.adjusted
    return ProcessResult(
        config=config,
        decoder=decoder,
        units="arbitrary" if poses is None else poses.units,
        scale_source=poses.scale.source if poses is not None and poses.scale.known else "",
        frames=frames,
        edges=records,
        remarks=_remarks(results, registration, adjusted),
        recapture=what_to_recapture(frames, records, not config.unordered),
        joint_px=None if adjusted is None else _both_known(adjusted.median_before_px, adjusted.median_after_px),
        versions={"sl_nerfstudio": __version__, **{p: importlib.metadata.version(p) for p in ("numpy", "torch")}},
    )


def _remarks(
    results: Sequence[FrameStageResult], registration: Registration | None, adjusted: AdjustedFrames | None
) -> tuple[str, ...]:
    """What remains uncertain."""
    remarks = () if registration is None else tuple(map(uncertainty_sentence, registration.uncertainties))
    clouds = clouds_of(results)
    if adjusted is None or not clouds:
        return remarks
    wrong = contradiction(adjusted.intrinsics, [cloud.camera for cloud in clouds], clouds[0].projector)
    return (wrong, *remarks) if wrong else remarks


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
    baseline = fitness = None
    if failure is None and poses is not None and registration is not None:
        k = registration.names.index(result.name)
        baseline = float(poses.adjusted.poses.baseline[k])
        fitness = float(np.nan_to_num(registration.fitness[k]))
    pose = cloud.pose
    return FrameRecord(
        name=result.name,
        in_scan=failure is None,
        stage="" if failure is None else failure.stage,
        reason="" if failure is None else failure.reason,
        decode_rate=rate,
        mask_share=share,
        epipolar_px=float(pose.residual_px),
        sigma_rotation_deg=pose.sigma_rotation_deg,
        sigma_direction_deg=pose.sigma_direction_deg,
        fitness=fitness,
        baseline=baseline,
        degeneracies=tuple(map(degeneracy_sentence, pose.degeneracies)),
    )
