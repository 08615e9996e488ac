"""From what the stages left to what the report shows."""

import importlib.metadata
from collections.abc import Sequence

import numpy as np

from sl_nerfstudio import __version__
from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.processing.advice import what_to_recapture
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frame_stage import FrameOutcome
from sl_nerfstudio.processing.intrinsics_words import contradiction
from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord, ProcessResult
from sl_nerfstudio.processing.words import degeneracy_sentence, exclusion_sentence, uncertainty_sentence
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.scan.types import Scale


def summarise(
    config: ProcessConfig,
    decoder: str,
    outcomes: Sequence[FrameOutcome],
    registration: Registration | None,
    joint: AdjustedFrames | None,
    units: str,
    scale: Scale,
) -> ProcessResult:
    """The result of a run; without `joint` no frame is in a scan."""
    row = {name: k for k, name in enumerate(registration.names)} if registration is not None else {}
    frames = tuple(_record(o, registration, joint, row.get(o.name)) for o in outcomes)
    edges = () if registration is None else registration.edges
    records = tuple(EdgeRecord(e.frames, float(e.overlap), float(e.fitness), e.used, e.undecided) for e in edges)
    return ProcessResult(
        config=config,
        decoder=decoder,
        units=units,
        scale_source=scale.source if scale.known else "",
        frames=frames,
        edges=records,
        remarks=_remarks(outcomes, registration, joint),
        recapture=what_to_recapture(frames, records, not config.unordered),
        joint_px=None if joint is None else _both_known(joint.median_before_px, joint.median_after_px),
        versions={"sl_nerfstudio": __version__, **{p: importlib.metadata.version(p) for p in ("numpy", "torch")}},
    )


def _remarks(
    outcomes: Sequence[FrameOutcome], registration: Registration | None, joint: AdjustedFrames | None
) -> tuple[str, ...]:
    """What remains uncertain."""
    placed = () if registration is None else tuple(map(uncertainty_sentence, registration.uncertainties))
    clouds = [o.cloud for o in outcomes if o.cloud is not None]
    if joint is None or not clouds:
        return placed
    wrong = contradiction(joint.intrinsics, [cloud.camera for cloud in clouds], clouds[0].projector)
    return (wrong, *placed) if wrong else placed


def _both_known(before: float, after: float) -> tuple[float, float] | None:
    """None where no point of one frame was seen by another: there is nothing to compare."""
    return (float(before), float(after)) if np.isfinite([before, after]).all() else None


def _record(
    outcome: FrameOutcome, registration: Registration | None, joint: AdjustedFrames | None, k: int | None
) -> FrameRecord:
    cloud = outcome.cloud
    known = outcome.stage not in ("reading", "decoding")
    rate, share = (outcome.decode_rate, outcome.mask_share) if known else (None, None)
    if cloud is None:
        return FrameRecord(outcome.name, False, outcome.stage, outcome.reason, rate, share)
    pose = cloud.pose
    placed = registration is not None and k is not None and bool(registration.registered[k])
    reason = "" if placed else _exclusion(outcome.name, registration)
    baseline = fitness = None
    if placed and joint is not None and registration is not None and k is not None:
        baseline = float(joint.poses.baseline[k])
        fitness = float(np.nan_to_num(registration.fitness[k]))
    return FrameRecord(
        name=outcome.name,
        in_scan=placed and joint is not None,
        stage="" if placed else "registering",
        reason=reason,
        decode_rate=rate,
        mask_share=share,
        epipolar_px=float(pose.residual_px),
        sigma_rotation_deg=pose.sigma_rotation_deg,
        sigma_direction_deg=pose.sigma_direction_deg,
        fitness=fitness,
        baseline=baseline,
        degeneracies=tuple(map(degeneracy_sentence, pose.degeneracies)),
    )


def _exclusion(name: str, registration: Registration | None) -> str:
    """Why a frame with a relative pose is not in the scan."""
    if registration is None:
        return "too few other frames could be used"
    return next(exclusion_sentence(e) for e in registration.exclusions if e.frame == name)
