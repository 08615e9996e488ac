"""Projector and rig: intrinsics found from the frames, tested and refined; all frames calibrated with them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.parameters import RefinePoses, SelfCalibration
from sl_nerfstudio.bundle_adjustment.registered_frames import (
    DEPENDENCE,
    AdjustedFrames,
    ProjectorKnowledge,
    RegisteredFramesSettings,
)
from sl_nerfstudio.calibration.stated import Shares, StatedSigma
from sl_nerfstudio.console import track
from sl_nerfstudio.decoding.decoder import Decoded
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device, DeviceChange
from sl_nerfstudio.geometry.lie import angle_deg
from sl_nerfstudio.processing.cache import StageStore
from sl_nerfstudio.processing.config import FEWEST_FRAMES, ProcessConfig, Rig
from sl_nerfstudio.processing.consistency import ConsistentFrames, adjust_consistent
from sl_nerfstudio.processing.frames import (
    FrameJob,
    FrameStageResult,
    FrameWorker,
    capture_sentences,
    clouds_of,
    describe_frame_stage,
    matches_of,
    run_frame_stage,
    run_frame_stage_again,
    with_kept_cloud,
)
from sl_nerfstudio.processing.inputs import CaptureNotes, Inputs
from sl_nerfstudio.processing.records import LargeClouds
from sl_nerfstudio.registration.result import NoCommonSurface, Registration
from sl_nerfstudio.registration.static_projector import (
    NoPlacement,
    StaticPlacement,
    place_under_static_projector,
)
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, subsample
from sl_nerfstudio.relative_pose.estimation import (
    RelativePose,
    RelativePoseError,
    estimate_relative_pose,
    relative_pose_near,
)
from sl_nerfstudio.relative_pose.intrinsics import Explanation, IntrinsicsEvidence, check_intrinsics
from sl_nerfstudio.relative_pose.joint_fit import CX, CY, K1, LOG_ASPECT, LOG_FOCAL, FrameMatches
from sl_nerfstudio.relative_pose.unknown_projector import (
    DOUBTFUL_SIGMA,
    Cause,
    NoProjector,
    ProjectorEstimate,
    estimate_projector,
)

# Sentences on intrinsics that were found, could not be found, or are contradicted.

_MORE_CAMERAS = (
    "add views from places that differ more, of something with depth; or give the projector's intrinsics (sl-calibrate)"
)
_CAUSES: dict[Cause, tuple[str, str]] = {
    "few frames": (
        "there are few frames, and each leaves only two constraints on the intrinsics",
        "add frames (ten or more) in which the projector stands differently against the camera: turned by 90 degrees, "
        "nearer, on the other side",
    ),
    "similar frames": (
        "the projector stands in the same way against the camera in all frames, which then leave only two constraints "
        "on the intrinsics together",
        "add frames in which it stands differently against the camera: turned by 90 degrees, nearer, on the other "
        "side; or calibrate it with sl-calibrate",
    ),
    "flat": (
        "most frames show hardly more than a plane, which leaves no constraint on the intrinsics",
        "add frames of something with depth, a corner of a room or a crumpled sheet; or calibrate with sl-calibrate",
    ),
    "unknown": (
        "not found",
        "check that pattern.json is the pattern that was projected and that the intrinsics are this camera's (at this "
        "size and focus); or calibrate the projector with sl-calibrate",
    ),
}


def doubt_sentence(found: ProjectorEstimate) -> str:
    """Why the intrinsics are uncertain and what to add; "" if they are well determined."""
    if found.centre_kept:
        return (
            "the frames do not determine the projector's principal point; it was kept as stated, and the focal length "
            "is right only if it is\n    remedy: " + _CAUSES["few frames"][1]
        )
    if found.cause is None:
        return ""
    cause, remedy = _CAUSES[found.cause]
    return (
        f"the projector's intrinsics are uncertain (1 sigma of the focal length: {100 * found.sigma[0]:.1f} %)\n"
        f"    cause:  {cause}\n    remedy: {remedy}"
    )


def wrong_intrinsics(evidence: IntrinsicsEvidence, shrink: int = 1) -> str:
    """Which intrinsics the frames contradict, and the values with which they agree: of photographs before `shrink`."""
    found = [
        replace(one, device=one.device.scaled(float(shrink))) if one.role == "camera" else one
        for one in evidence.explanations()
    ]
    chi_square = min(evidence.projector.chi_square, evidence.camera.chi_square)
    head = (
        "The stated intrinsics contradict the captures (epipolar geometry of all frames together: chi square "
        f"{chi_square:.0f}, by chance 3)."
    )
    if len(found) == 1:
        (one,) = found
        remedy = "find the projector's from the captures: --estimate-projector"
        if one.role == "camera":
            remedy = "calibrate the camera again at this zoom, focus and image size (sl-calibrate --camera-only)"
        return (
            f"{head} One change explains it, and no other that was tried does: {one.role}, {_values(one)}\n"
            f"    cause:  the {one.role}'s {one.part} is not as stated (another zoom, focus, lens shift, size?)\n"
            f"    remedy: {remedy}"
        )
    return "\n".join(
        [
            f"{head} One of these would agree, by itself:",
            *(f"    {one.role}: {_values(one)}" for one in found),
            "    cause:  the calibration of a device is off, or was made with another zoom, focus, lens shift or image "
            "size; the frames do not tell whose",
            "    remedy: calibrate again (sl-calibrate); if the camera's intrinsics are certain, find the projector's "
            "from the captures: --estimate-projector",
        ]
    )


def _values(one: Explanation) -> str:
    """The values that would agree, with 1 sigma; those that are right are left out."""
    device, shares, sigma = one.device, one.change, one.sigma
    words = []
    if sigma[0]:
        focal = device.fl_x * (1 + shares[0])
        words.append(f"focal length {focal:.1f} ± {device.fl_x * sigma[0]:.1f} px ({100 * shares[0]:+.1f} %)")
    if sigma[1]:
        x, y = device.cx + device.fl_x * shares[1], device.cy + device.fl_x * shares[2]
        words.append(
            f"principal point ({x:.1f} ± {device.fl_x * sigma[1]:.1f}, {y:.1f} ± {device.fl_x * sigma[2]:.1f}) px "
            f"instead of ({device.cx:.1f}, {device.cy:.1f})"
        )
    return ", ".join(words)


def static_doubt(sigma_focal: float, frames: int) -> str:
    """Why the intrinsics of a static projector are uncertain; "" if they are well determined."""
    if sigma_focal <= DOUBTFUL_SIGMA:
        return ""
    return (
        f"the projector's focal length is known only to {100 * sigma_focal:.1f} % (1 sigma), from {frames} cameras\n"
        f"    remedy: {_MORE_CAMERAS}"
    )


def static_not_found(found: NoPlacement, frames: int) -> UserError:
    """The error for cameras that cannot be placed by the codes, or a projector that does not follow from them."""
    if found.fault == "no pair":
        return UserError(
            f"--rig static-projector: no two of {frames} cameras can be placed against each other\n"
            f"    cause:  the best two have {found.common} squares of the pattern in common, or these show no depth\n"
            "    remedy: capture views that overlap more, from places that differ by 10 to 30 degrees; if the "
            "projector was moved, leave --rig out"
        )
    if found.fault == "no projector":
        return UserError(
            "--rig static-projector: no place and no intrinsics of one projector explain what the cameras see\n"
            "    cause:  the projector was moved between the frames, or everything seen lies in one plane\n"
            f"    remedy: if it was moved, leave --rig out; otherwise {_MORE_CAMERAS}"
        )
    return UserError(
        f"--rig static-projector: {frames} cameras do not determine the projector's intrinsics (1 sigma of the focal "
        f"length: {100 * found.sigma_focal:.0f} %)\n    cause:  what is seen is too flat, or the cameras are too close "
        f"to each other\n    remedy: {_MORE_CAMERAS}"
    )


def not_found(found: NoProjector) -> UserError:
    """The error for frames that do not determine the projector."""
    cause, remedy = _CAUSES[found.cause]
    known = f" (known to {100 * found.sigma:.0f} % of the focal length, 1 sigma)" if found.sigma < 10 else ""
    frames = f"{found.frames} frame" + ("" if found.frames == 1 else "s")
    return UserError(
        f"--estimate-projector: {frames} that could be used do not determine the projector's intrinsics{known}\n"
        f"    cause:  {cause}\n    remedy: {remedy}"
    )


# A projector's intrinsics that were found from the frames, with their uncertainty, for reports and for programs.

FIELDS = ("fl_x", "fl_y", "cx", "cy", "k1")


@dataclass(frozen=True)
class FoundProjector:
    """The projector, and 1 sigma of `FIELDS`: pixels, and k1 as it is; 0 where a value was kept."""

    projector: Device
    sigma: tuple[float, float, float, float, float]
    frames: int  # that it was found from
    noise_px: float  # robust standard deviation of what is left, projector pixels
    method: str  # in words
    doubt: str = ""  # why it is uncertain, and what to add; "" if it is well determined

    @property
    def sigma_share(self) -> Float64[ndarray, "3"]:
        """1 sigma of focal length and principal point, as shares of the focal length."""
        focal = self.projector.fl_x
        return np.array([self.sigma[0], self.sigma[2], self.sigma[3]]) / focal

    def sigmas(self) -> dict[str, float]:
        """1 sigma by the name of the value."""
        return dict(zip(FIELDS, self.sigma, strict=True))

    def document(self) -> dict[str, Any]:
        """Return the figures as JSON."""
        device = self.projector
        return {
            "method": self.method,
            **{key: getattr(device, key) for key in FIELDS},
            "sigma": self.sigmas(),
            "frames": self.frames,
            "noise_px": self.noise_px,
            "doubt": self.doubt or None,
        }


def describe(found: FoundProjector) -> str:
    """One sentence with all values and 1 sigma of each."""
    d, s = found.projector, found.sigma
    focal = f"focal lengths {d.fl_x:.1f} ± {s[0]:.1f}, {d.fl_y:.1f} ± {s[1]:.1f} px"
    centre = f"principal point ({d.cx:.1f} ± {s[2]:.1f}, {d.cy:.1f} ± {s[3]:.1f}) px"
    lens = f", k1 {d.k1:.4f} ± {s[4]:.4f}" if s[4] else ""
    return f"projector, {found.method}: {focal}, {centre}{lens}"


# `--estimate-projector` for devices that move freely: intrinsics from all decoded frames.


def find_projector(job: FrameJob, results: Sequence[FrameStageResult], stated: bool) -> FoundProjector:
    """The projector from the epipolar geometry of all decoded frames.

    Raises UserError, with the cause that was measured and what to add, where the frames do not determine it.
    """
    worker = FrameWorker(job)
    matches = [
        FrameMatches(result.name, *correspondences_of(worker.load(result).coords), job.camera_of(result.frame))
        for result in results
        if result.key
    ]
    if not matches:
        raise UserError("no frame was decoded, so the projector's intrinsics cannot be estimated")
    found = StageStore(job.work).kept(
        "projector",
        (matches, job.projector, stated, job.seed, job.stated.camera),
        lambda: estimate_projector(matches, job.projector, stated, job.seed, camera_sigma=job.stated.camera),
    )
    if isinstance(found, NoProjector):
        raise not_found(found)
    return FoundProjector(
        found.projector,
        sigma_of_fields(found.projector, found.covariance),
        len(found.frames),
        found.noise_px,
        "from the epipolar geometry of all frames" + (", principal point as stated" if found.centre_kept else ""),
        doubt_sentence(found),
    )


def sigma_of_fields(device: Device, C: Float64[ndarray, "5 5"]) -> tuple[float, float, float, float, float]:
    """1 sigma of fl_x, fl_y, cx, cy, k1, from the covariance of `joint_fit.NAMES`."""
    log_fl_y = C[LOG_FOCAL, LOG_FOCAL] + 2 * C[LOG_FOCAL, LOG_ASPECT] + C[LOG_ASPECT, LOG_ASPECT]
    s = np.sqrt([C[LOG_FOCAL, LOG_FOCAL], max(log_fl_y, 0.0), C[CX, CX], C[CY, CY], C[K1, K1]])
    unit = np.array([device.fl_x, device.fl_y, device.w, device.w, 1.0])
    a, b, c, d, e = (s * unit).tolist()
    return a, b, c, d, e


# The projector's intrinsics refined by the joint adjustment: what is known of them before is the prior.

_ROUNDS = 3
_NEGLIGIBLE = 0.5  # chi square of three values: the change is well within its uncertainty


_MOVES: dict[Rig, RefinePoses] = {"free": "free", "rigid": "rigid-rig", "static-projector": "static-projector"}


def adjustment_settings(rig: Rig, found: FoundProjector | None) -> RegisteredFramesSettings:
    """The joint adjustment for a kind of rig, with the uncertainty of a projector that was found."""
    return RegisteredFramesSettings(refine=_MOVES[rig], projector=None if found is None else knowledge(found))


def knowledge(found: FoundProjector, projector: Device | None = None) -> ProjectorKnowledge:
    """The prior for the adjustment; `projector`: the current one, if it was changed since."""
    a, b, c = found.sigma_share.tolist()
    known, now = found.projector, projector or found.projector
    change = DeviceChange(now.fl_x / known.fl_x - 1, (now.cx - known.cx) / known.fl_x, (now.cy - known.cy) / known.fl_x)
    return ProjectorKnowledge((a, b, c), change)


def refine_projector(
    clouds: Sequence[FrameCloud],
    consistent: ConsistentFrames,
    found: FoundProjector,
    camera_sigma: Shares,
    settings: RegisteredFramesSettings,
    log: Callable[[str], None],
) -> tuple[Sequence[FrameCloud], ConsistentFrames, FoundProjector]:
    """Gauss-Newton steps of focal length and principal point, with all poses adjusted again after each.

    Returns the clouds, what follows from them, and the projector. A step is kept if less of a contradiction is left
    than before. `camera_sigma`: how uncertain the camera is; what follows from it is part of the projector's
    uncertainty.
    """
    projector, covariance = found.projector, None  # None: no step was taken
    for _ in range(_ROUNDS):
        calibration = consistent.adjusted.intrinsics
        if calibration is None or not calibration.known:
            break
        step, _ = calibration.of_projector()
        chi_square = _chi_square(calibration)
        if chi_square < _NEGLIGIBLE:
            break
        new = DeviceChange(*step.tolist()).applied(projector)
        new_clouds = with_projector(clouds, consistent, new)
        again = adjust_consistent(
            new_clouds, at_adjusted_poses(consistent), log, replace(settings, projector=knowledge(found, new))
        )
        left = again.adjusted.intrinsics
        if left is None or not left.known or _chi_square(left) >= chi_square:
            break
        clouds, consistent, projector, covariance = new_clouds, again, new, _covariance(left, camera_sigma)
    return clouds, consistent, _with_sigma(found, projector, covariance)


def _chi_square(calibration: SelfCalibration) -> float:
    """Chi square of the best change of the projector alone: about three if nothing is wrong."""
    step, uncertainty = calibration.of_projector()
    return float(step @ torch.linalg.solve(uncertainty, step))


def _covariance(calibration: SelfCalibration, camera_sigma: Shares) -> Float[Tensor, "3 3"]:
    """Covariance of the projector, by correlated errors of neighbouring pixels and by an uncertain camera."""
    return DEPENDENCE**2 * calibration.of_projector()[1] + calibration.projector_by_camera(camera_sigma)


def _with_sigma(found: FoundProjector, projector: Device, covariance: Float[Tensor, "3 3"] | None) -> FoundProjector:
    """The refined values; their uncertainty never exceeds that of the start.

    It stays that of the start where aspect or k1 were found, too: the adjustment takes them as exact.
    """
    if covariance is None:
        return found
    if found.sigma[4] > 0 or found.sigma[1] != found.sigma[0]:
        return replace(found, projector=projector)
    shares = np.sqrt(covariance.diagonal().clamp_min(0).numpy())
    focal, x, y = np.minimum(shares, found.sigma_share) * projector.fl_x
    return replace(found, projector=projector, sigma=(float(focal), float(focal), float(x), float(y), 0.0))


def with_projector(clouds: Sequence[FrameCloud], consistent: ConsistentFrames, projector: Device) -> list[FrameCloud]:
    """The clouds with another projector: their poses follow, from the adjusted ones where there are such."""
    poses, kept = consistent.adjusted.poses, LargeClouds()
    out = []
    for k, cloud in enumerate(clouds):
        T = poses.T_camera_projector[k] if consistent.registration.registered[k] else cloud.pose.T_camera_projector
        pose = relative_pose_near(T, *correspondences_of(cloud.coords), cloud.camera, projector)
        out.append(kept.kept(cloud.with_pose(projector, pose)))
    return out


def at_adjusted_poses(consistent: ConsistentFrames) -> Registration:
    """The registration with the adjusted cameras and baselines."""
    poses = consistent.adjusted.poses
    return replace(consistent.registration, T_world_camera=poses.T_world_camera, baseline=poses.baseline)


# `--rig rigid`: camera and projector are fixed to each other, so that all frames have one relative pose.

_MOST_PER_FRAME = 5000  # correspondences in the fit of the one pose


def with_one_pose(job: FrameJob, results: Sequence[FrameStageResult]) -> list[FrameStageResult]:
    """The frames with the relative pose that fits the coordinates of all of them together.

    Frames that have none alone, because they show a plane, say, get it as well. Raises UserError if no pose fits.
    """
    worker = FrameWorker(job)
    decoded = {result.name: worker.load_with_seen(result) for result in results if result.key}
    rng = np.random.default_rng(job.seed)
    parts = []
    for one, _ in decoded.values():
        uv_camera, uv_projector = correspondences_of(one.coords)
        keep = subsample(np.arange(len(uv_camera)), _MOST_PER_FRAME, rng)
        parts.append((uv_camera[keep], uv_projector[keep]))
    if not parts:
        return list(results)
    uv_camera, uv_projector = (np.concatenate(part) for part in zip(*parts, strict=True))
    common = estimate_relative_pose(uv_camera, uv_projector, job.camera, job.projector, job.seed)
    clouds = LargeClouds()
    return [
        with_kept_cloud(_with_pose(job, result, *decoded[result.name], common), clouds)
        if result.name in decoded
        else result
        for result in track(results, "calibrating with one pose", len(results))
    ]


def _with_pose(
    job: FrameJob, result: FrameStageResult, decoded: Decoded, seen: Bool[ndarray, "h w"], common: RelativePose
) -> FrameStageResult:
    T, coords = common.T_camera_projector, decoded.coords
    own = relative_pose_near(T, *correspondences_of(coords), job.camera, job.projector, job.seed)
    pose = replace(own, T_camera_projector=T, covariance=common.covariance, degeneracies=common.degeneracies)
    try:
        cloud = frame_cloud(result.name, coords, job.camera, job.projector, pose, light=decoded.light, seen=seen)
    except RelativePoseError as error:
        return result.failed("calibrating", f"{result.frame.images[0]}: {error}")
    return result.calibrated(cloud)


def with_equal_baselines(registration: Registration) -> Registration:
    """The registration with one baseline for all frames: their geometric mean, which is one."""
    baseline = np.where(registration.registered, 1.0, np.nan)
    return replace(registration, baseline=baseline)


# Whether the stated intrinsics can be right, by the epipolar geometry of all frames: before anything is registered.

_DECISIVE = 0.5  # share of the errors that other intrinsics leave: then it is they that made frames look doubtful


def contradiction_by_epipolar_geometry(job: FrameJob, results: Sequence[FrameStageResult]) -> str:
    """Which intrinsics the frames contradict, with the values that would agree; "" if none."""
    every = clouds_of(results)
    firm = _firm(every)
    clouds = firm if len(firm) >= FEWEST_FRAMES else every  # of two, four constraints on three values
    if len({cloud.camera for cloud in clouds}) > 1:
        return ""
    frames, poses = matches_of(_without_repeats(clouds))
    if len(frames) < FEWEST_FRAMES:
        return ""
    evidence = StageStore(job.work).kept(
        "test of intrinsics",
        (frames, poses, job.projector, job.seed),
        lambda: check_intrinsics(frames, poses, job.projector, job.seed),
    )
    evidence = evidence.allowing(job.stated.either)
    stated_px, best_px = evidence.projector.noise_px
    decisive = len(firm) >= FEWEST_FRAMES or best_px < _DECISIVE * stated_px
    return wrong_intrinsics(evidence, job.shrink) if decisive and evidence.contradicts() else ""


_REPEATED_PX = 1.0  # pattern pixels, within which a pixel shows in two frames what it showed before
_REPEATED_SIGMAS = 4.0  # of the noise of both frames, the same
_SAME_PLACE_DEG = 1.0  # between the relative poses of frames that may repeat each other
_MOSTLY = 0.5  # share of a frame's correspondences that an earlier frame has already, from which it adds nothing


def _without_repeats(clouds: Sequence[FrameCloud]) -> list[FrameCloud]:
    """The frames that do not mostly show again, at the same pixels, what an earlier one shows.

    A fixed rig before something that stands still measures the same again: the errors of decoder and lens are the same
    in every frame, and more frames do not make them smaller.
    """
    kept: list[FrameCloud] = []
    for cloud in clouds:
        uv_camera, uv_projector = correspondences_of(cloud.coords)
        column, row = uv_camera.astype(np.int64).T
        R, noise = cloud.pose.T_camera_projector[:3, :3], cloud.pose.residual_px
        shown = [
            np.linalg.norm(other.coords[row, column] - uv_projector, axis=1)
            < max(_REPEATED_PX, _REPEATED_SIGMAS * float(np.hypot(noise, other.pose.residual_px)))
            for other in kept
            if angle_deg(R.T @ other.pose.T_camera_projector[:3, :3]) < _SAME_PLACE_DEG
        ]
        if not shown or np.any(shown, axis=0).mean() < _MOSTLY:
            kept.append(cloud)
    return kept


def within_stated_doubt(adjusted: AdjustedFrames, stated: StatedSigma) -> AdjustedFrames:
    """What the joint adjustment says of the intrinsics, where the files state how uncertain those are."""
    found = adjusted.intrinsics
    return adjusted if found is None else replace(adjusted, intrinsics=found.allowing(stated.both))


def _firm(clouds: Sequence[FrameCloud]) -> list[FrameCloud]:
    """Frames with depth and one solution for the projector's pose: a wrong pose would contradict everything."""
    return [
        cloud
        for cloud in clouds
        if not cloud.alternatives and not {d.kind for d in cloud.pose.degeneracies} & {"planar", "pure rotation"}
    ]


# `--rig static-projector`: cameras placed by the codes, the projector by resection, every frame calibrated with it.


def place_static(
    job: FrameJob, results: Sequence[FrameStageResult], stated: bool, estimate: bool
) -> "CalibratedFrames":
    """Placement of all decoded frames; the projector's intrinsics are found if none are stated, or on request.

    Raises UserError, with what was measured and what to add, where the frames do not determine the poses.
    """
    decoded = [result for result in results if result.key]
    if len(decoded) < FEWEST_FRAMES:
        job = replace(job, last_step="match")
        return CalibratedFrames(job, results, None, _registration((), np.zeros((0, 4, 4)), np.zeros(0)))
    worker, known = FrameWorker(job), stated and not estimate
    coords = [worker.load(result).coords for result in decoded]
    inputs = (coords, [job.camera_of(result.frame) for result in decoded], job.projector, known, stated)
    placed = StageStore(job.work).kept("static projector", inputs, lambda: place_under_static_projector(*inputs))
    if isinstance(placed, NoPlacement):
        raise static_not_found(placed, len(decoded))
    job = replace(job, projector=placed.projector, last_step="match")
    T = {result.name: pose for result, pose in zip(decoded, placed.T_world_camera, strict=True)}
    maps = {result.name: uv for result, uv in zip(decoded, coords, strict=True)}
    clouds = LargeClouds()
    results = [
        with_kept_cloud(_calibrated(r, maps[r.name], T[r.name], placed, job), clouds) if r.name in T else r
        for r in results
    ]
    names = [cloud.name for cloud in clouds_of(results)]
    poses = np.stack([T[name] for name in names]) if names else np.zeros((0, 4, 4))
    baseline = np.linalg.norm(poses[:, :3, 3] - placed.T_world_projector[:3, 3], axis=1)
    found = None if known else _found(placed, len(decoded))
    return CalibratedFrames(job, results, found, _registration(names, poses, baseline))


def _found(placed: StaticPlacement, frames: int) -> FoundProjector:
    sigma = sigma_of_fields(placed.projector, placed.covariance)
    doubt = static_doubt(sigma[0] / placed.projector.fl_x, frames)
    return FoundProjector(placed.projector, sigma, frames, placed.noise_px, "by resection from the cameras", doubt)


def _calibrated(
    result: FrameStageResult,
    coords: Float32[ndarray, "_ _ 2"],
    T_world_camera: Float64[ndarray, "4 4"],
    placed: StaticPlacement,
    job: FrameJob,
) -> FrameStageResult:
    """The frame with the relative pose that the placement gives, refined by its own coordinates; or left out."""
    if not np.isfinite(T_world_camera).all():
        return result.failed(
            "calibrating",
            f"{result.frame.images[0].parent}: it shares too little with the other frames to place its camera\n"
            "    cause:  few codes of the projector are seen by it and by another camera\n"
            "    remedy: capture views in between",
        )
    camera = job.camera_of(result.frame)
    relative = np.linalg.inv(T_world_camera) @ placed.T_world_projector
    own = relative_pose_near(relative, *correspondences_of(coords), camera, placed.projector, job.seed)
    relative[:3, 3] /= np.linalg.norm(relative[:3, 3])
    pose = replace(own, T_camera_projector=relative)  # all frames together know it better than this one alone
    try:
        return result.calibrated(frame_cloud(result.name, coords, camera, placed.projector, pose))
    except RelativePoseError as error:
        return result.failed("calibrating", str(error))


def _registration(
    names: Sequence[str], T_world_camera: Float64[ndarray, "n 4 4"], baseline: Float64[ndarray, "n"]
) -> Registration:
    """What registration says of frames that were placed by their codes: all in one component, in the first's axes.

    No pairs of surfaces were compared, so there are no edges.
    """
    n = len(names)
    if n < FEWEST_FRAMES:
        alone = tuple(map(NoCommonSurface, names))
        T, one, inside, component = np.full((n, 4, 4), np.nan), np.full(n, np.nan), np.zeros(n, bool), np.full(n, -1)
        return Registration(tuple(names), T, one, inside, component, one, (), alone, ())
    scale = 1 / np.exp(np.log(baseline).mean())
    T = np.linalg.inv(T_world_camera[0]) @ T_world_camera
    T[:, :3, 3] *= scale
    inside, component, fitness = np.ones(n, bool), np.zeros(n, np.int64), np.ones(n)
    return Registration(tuple(names), T, scale * baseline, inside, component, fitness, (), (), ())


# All frames, with what is known of the projector and of the rig.

Log = Callable[[str], None]


@dataclass(frozen=True)
class CalibratedFrames:
    """Frames with their clouds, the projector with which they were calibrated, and the registration if it is known."""

    job: FrameJob
    results: Sequence[FrameStageResult]
    found: FoundProjector | None = None  # None: the projector is the stated one
    registration: Registration | None = None  # of a projector that stands still; of the frames that have clouds
    notes: CaptureNotes = field(default_factory=CaptureNotes)  # on the captures


def calibrate_frames(config: ProcessConfig, inputs: Inputs, log: Log) -> CalibratedFrames:
    """Decode and calibrate all frames. Raises UserError where a projector is to be found and cannot be."""
    job, found = inputs.job, None
    results = run_frame_stage(config, job, inputs.captures)
    for sentence in capture_sentences([(result.name, result.notes) for result in results]):
        log(sentence)
    if config.finds_projector:
        log(f"decoded {sum(bool(result.key) for result in results)} of {len(results)} frames")
        if config.rig == "static-projector":
            placed = place_static(job, results, inputs.projector_stated, config.estimate_projector)
            if placed.found is not None:
                log(describe(placed.found))
            log(describe_frame_stage(placed.results))
            return replace(placed, notes=inputs.notes)
        found = find_projector(job, results, inputs.projector_stated)
        log(describe(found))
        job = replace(job, projector=found.projector, last_step="match")
        results = run_frame_stage_again(config, job, inputs.captures, results)
    log(describe_frame_stage(results))
    if config.rig == "rigid":
        results = with_one_pose(job, results)
    return CalibratedFrames(job, results, found, notes=inputs.notes)
