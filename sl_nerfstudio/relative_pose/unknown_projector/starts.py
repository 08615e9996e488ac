"""First solutions for intrinsics and poses: from fundamental matrices, and from the stated projector."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.robust import geman_mcclure_cost
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, estimate_relative_pose
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs
from sl_nerfstudio.relative_pose.unknown_projector.fundamental import (
    fundamental_matrix,
    grid_starts,
    pose_of_fundamental,
)
from sl_nerfstudio.relative_pose.unknown_projector.joint_fit import JointFit, JointProblem, Prior
from sl_nerfstudio.relative_pose.unknown_projector.matches import FrameMatches, Matches, Poses, UnitPose
from sl_nerfstudio.relative_pose.unknown_projector.parameters import CX, CY, LOG_FOCAL, device_with
from sl_nerfstudio.relative_pose.unknown_projector.settings import UnknownProjectorSettings

FOCAL_AND_CENTRE = (LOG_FOCAL, CX, CY)


def frame_rays(matches: Matches, projector: Device, k: int) -> RayPairs:
    """The rays of one frame."""
    part = matches.of_frame(k)
    return matches.rays(projector).chosen(np.arange(part.start, part.stop))


def best_start(
    matches: Matches,
    projector: Device,
    stated: bool,
    prior: Prior,
    rng: np.random.Generator,
    settings: UnknownProjectorSettings,
) -> tuple[JointFit, list[int]] | None:
    """Focal length and principal point that fit a small part of the correspondences best, and the frames they are from.

    Frames without a fundamental matrix are left out. None if too few have one, or none of the starts converges.
    """
    F = [fundamental_matrix(matches, k, projector, settings.fundamental) for k in range(matches.frames)]
    index = [k for k, one in enumerate(F) if one is not None]
    known = [one for one in F if one is not None]
    if len(known) < 2:
        return None
    some = _thinned(matches, index, settings.start_most, rng)
    places = grid_starts(known, projector, settings.grid)
    log_w = np.log(projector.w)
    devices = [device_with(projector, [np.log(f) + log_w, 0.0, x, y, projector.k1]) for f, x, y in places]
    if stated:
        devices.insert(0, projector)
    fits = [_fit_from(device, known, some, prior, settings) for device in devices]
    return min(fits, key=_ranking(fits, some, settings)), index


def _fit_from(
    device: Device,
    F: Sequence[Float64[ndarray, "3 3"]],
    matches: Matches,
    prior: Prior,
    settings: UnknownProjectorSettings,
) -> JointFit:
    poses = [pose_of_fundamental(one, device, frame_rays(matches, device, k)) for k, one in enumerate(F)]
    fit = replace(settings.fit, iterations=settings.start_iterations)
    return JointProblem(matches, device, FOCAL_AND_CENTRE, prior, fit).fit(Poses.of(poses))


def _ranking(fits: Sequence[JointFit], matches: Matches, settings: UnknownProjectorSettings):
    """Mean robust cost at the width of the best noise: a fit that gives up half of the pixels must not win."""
    width = settings.fit.kernel_sigmas * min(fit.noise_px for fit in fits)

    def cost(fit: JointFit) -> float:
        r = matches.residuals(fit.poses, matches.rays(fit.projector))
        return float(geman_mcclure_cost((np.nan_to_num(r, nan=1e6) / width).clip(-1e6, 1e6) ** 2).mean())

    return cost


def _thinned(matches: Matches, index: Sequence[int], most: int, rng: np.random.Generator) -> Matches:
    """Some correspondences of some frames, which are numbered anew."""
    keep, number = [], []
    for new, k in enumerate(index):
        part = np.arange(*matches.of_frame(k).indices(len(matches.frame))[:2])
        part = part if len(part) <= most else np.sort(rng.choice(part, most, replace=False))
        keep.append(part)
        number.append(np.full(len(part), new))
    rows = np.concatenate(keep)
    return Matches(
        matches.d_camera[rows], matches.uv_projector[rows], np.concatenate(number), matches.block[rows], len(index)
    )


@dataclass(frozen=True)
class FramePose:
    """The relative pose of a frame with one projector."""

    frame: int
    pose: UnitPose
    flat: bool  # what it sees is a plane within the noise, or the devices are in one place: it says nothing


def poses_with(
    frames: Sequence[FrameMatches], projector: Device, seed: int, settings: UnknownProjectorSettings
) -> list[FramePose]:
    """The relative poses of all frames that have one with a projector."""
    found = []
    for k, frame in enumerate(frames):
        try:
            one = estimate_relative_pose(
                frame.uv_camera, frame.uv_projector, frame.camera, projector, seed, settings.pose
            )
        except RelativePoseError:
            continue
        T = one.T_camera_projector
        flat = any(d.kind in ("planar", "pure rotation") for d in one.degeneracies)
        found.append(FramePose(k, (T[:3, :3], T[:3, 3]), flat))
    return found
