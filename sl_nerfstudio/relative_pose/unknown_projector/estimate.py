"""The projector's intrinsics from all frames: starts, joint fit, choice of the model, and what is uncertain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.ray_pairs import subsample
from sl_nerfstudio.relative_pose.unknown_projector.camera_doubt import covariance_by_camera
from sl_nerfstudio.relative_pose.unknown_projector.joint_fit import JointFit, JointProblem, Prior
from sl_nerfstudio.relative_pose.unknown_projector.matches import FrameMatches, Matches, Poses
from sl_nerfstudio.relative_pose.unknown_projector.model_choice import choose_model
from sl_nerfstudio.relative_pose.unknown_projector.parameters import (
    CX,
    CY,
    LOG_FOCAL,
    prior_sigma,
    values_of,
)
from sl_nerfstudio.relative_pose.unknown_projector.settings import (
    UNKNOWN_PROJECTOR_DEFAULTS,
    UnknownProjectorSettings,
)
from sl_nerfstudio.relative_pose.unknown_projector.starts import FOCAL_AND_CENTRE, best_start, poses_with
from sl_nerfstudio.threads import one_library_thread

Cause = Literal["few frames", "similar frames", "flat", "unknown"]


@dataclass(frozen=True)
class ProjectorEstimate:
    """Intrinsics with their uncertainty. Those that are not free are as stated, or those of square pixels."""

    projector: Device
    covariance: Float64[ndarray, "5 5"]  # of `parameters.NAMES`; zero where not free
    free: tuple[int, ...]
    noise_px: float  # robust standard deviation of the epipolar errors, projector pixels
    frames: tuple[str, ...]  # that were used
    cause: Cause | None  # why it is uncertain; None: it is well determined
    centre_kept: bool  # the principal point is the stated one: the frames do not determine it

    @property
    def sigma(self) -> Float64[ndarray, "5"]:
        """1 sigma of `parameters.NAMES`."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class NoProjector:
    """The frames do not determine the projector's intrinsics."""

    cause: Cause
    frames: int  # that could be used
    sigma: float  # of the least certain one, share of the focal length; inf: nothing was found
    noise_px: float


@one_library_thread()
def estimate_projector(
    frames: Sequence[FrameMatches],
    projector: Device,
    stated: bool,
    seed: int = 0,
    settings: UnknownProjectorSettings = UNKNOWN_PROJECTOR_DEFAULTS,
    camera_sigma: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ProjectorEstimate | NoProjector:
    """Intrinsics of the projector for which the epipolar errors of all frames together are smallest.

    `projector` gives size and model, and if `stated` a start for the rest. A model without fundamental matrices (DOE)
    needs a stated one. Lens terms other than k1 stay as they are. `camera_sigma`: 1 sigma of the cameras' focal length
    and principal point, as shares of the focal length.
    """
    if len(frames) < settings.fewest_frames and not stated:
        return NoProjector("few frames", len(frames), np.inf, np.inf)
    rng = np.random.default_rng(seed)
    prior = Prior(values_of(projector), prior_sigma(settings.prior))
    device = _start(frames, projector, stated, prior, rng, settings)
    if device is None:
        return NoProjector("unknown", 0, np.inf, np.inf)
    refined = _refined(frames, device, prior, rng, seed, settings)
    if isinstance(refined, NoProjector):
        return refined
    first, matches, index = refined
    undetermined = _uncertainty(first) > settings.largest_sigma
    if undetermined and stated:
        found = JointProblem(matches, projector, (LOG_FOCAL,), prior, settings.fit).fit(first.poses)
    else:
        found = choose_model(matches, first, prior, settings)
    doubtful = _uncertainty(found) > settings.doubtful_sigma or len(index) < settings.fewest_frames
    cause = _cause(found, len(index), len(frames), settings) if doubtful else None
    if _uncertainty(found) > settings.largest_sigma or found.noise_px > settings.largest_noise_share * projector.w:
        return NoProjector(cause or "unknown", len(index), _uncertainty(found), found.noise_px)
    covariance = np.zeros((5, 5))
    used = [frames[k] for k in index]
    by_camera = covariance_by_camera(
        used, camera_sigma, found, lambda f: _matches(f, projector, seed, settings), prior, settings.fit
    ) if any(camera_sigma) else 0.0  # fmt: skip
    covariance[np.ix_(found.free, found.free)] = found.covariance + by_camera
    return ProjectorEstimate(
        found.projector,
        covariance,
        found.free,
        found.noise_px,
        tuple(frames[k].name for k in index),
        cause,
        undetermined and stated,
    )


def _start(
    frames: Sequence[FrameMatches],
    projector: Device,
    stated: bool,
    prior: Prior,
    rng: np.random.Generator,
    settings: UnknownProjectorSettings,
) -> Device | None:
    """A projector with which the frames' poses can be found."""
    if projector.model == "DOE":
        return projector if stated else None
    matches = Matches.of(frames, projector, settings.blocks, settings.fundamental.most, rng)
    found = best_start(matches, projector, stated, prior, rng, settings)
    if found is None:
        return projector if stated else None
    return found[0].projector


def _refined(
    frames: Sequence[FrameMatches],
    device: Device,
    prior: Prior,
    rng: np.random.Generator,
    seed: int,
    settings: UnknownProjectorSettings,
) -> tuple[JointFit, Matches, list[int]] | NoProjector:
    """Fit to all frames with depth, with their correspondences and numbers.

    Poses are searched for anew with every projector found: with a wrong one, flat frames end in the wrong one of their
    two solutions. Frames that show a plane fit any projector; their noise would pass for depth.
    """
    some = [_thinned(frame, settings, rng) for frame in frames]
    found: tuple[JointFit, Matches, list[int]] | NoProjector = NoProjector("unknown", 0, np.inf, np.inf)
    for _ in range(settings.rounds):
        poses = poses_with(some, device, seed, settings)
        firm = [one for one in poses if not one.flat]
        if len(firm) < settings.fewest_posed:
            return NoProjector("flat" if len(poses) >= settings.fewest_posed else "unknown", len(firm), np.inf, np.inf)
        index = [one.frame for one in firm]
        matches = _matches([frames[k] for k in index], device, seed, settings)
        start = Poses.of([one.pose for one in firm])
        fit = JointProblem(matches, device, FOCAL_AND_CENTRE, prior, settings.fit).fit(start)
        change = np.abs(values_of(fit.projector) - values_of(device))[list(FOCAL_AND_CENTRE)]
        found, device = (fit, matches, index), fit.projector
        if (change < settings.settled * np.sqrt(np.diag(fit.covariance))).all():
            break
    return found


def _matches(frames: Sequence[FrameMatches], device: Device, seed: int, settings: UnknownProjectorSettings) -> Matches:
    """As many correspondences as the joint fit takes."""
    most = min(settings.fit.most_per_frame, max(settings.fit.most // len(frames), 1))
    return Matches.of(frames, device, settings.blocks, most, np.random.default_rng(seed))


def _thinned(frame: FrameMatches, settings: UnknownProjectorSettings, rng: np.random.Generator) -> FrameMatches:
    """The frame with as many correspondences as a first pose needs."""
    keep = subsample(np.arange(len(frame.uv_camera)), settings.pose.most, rng)
    return replace(frame, uv_camera=frame.uv_camera[keep], uv_projector=frame.uv_projector[keep])


def _uncertainty(found: JointFit) -> float:
    """The largest sigma of focal length and principal point, as a share of the focal length."""
    widths = found.projector.w / found.projector.fl_x
    unit = {LOG_FOCAL: 1.0, CX: widths, CY: widths}
    sigma = np.sqrt(np.diag(found.covariance))
    return max(unit[k] * float(s) for k, s in zip(found.free, sigma, strict=True) if k in unit)


def _cause(found: JointFit, used: int, frames: int, settings: UnknownProjectorSettings) -> Cause:
    """What was measured that explains why the focal length is uncertain."""
    R = Rotation.from_matrix(found.poses.R)
    turns = np.degrees((R * R[0].inv()).magnitude())
    swings = np.degrees(np.arccos((found.poses.t @ found.poses.t[0]).clip(-1, 1)))
    if used > 1 and max(float(turns.max()), float(swings.max())) < settings.alike_deg:
        return "similar frames"
    if 2 * used < frames:
        return "flat"
    return "few frames" if used < settings.few_frames else "unknown"
