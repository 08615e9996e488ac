"""`--rig rigid`: camera and projector are fixed to each other, so that all frames have one relative pose."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from sl_nerfstudio.decoding.decoded import Decoded
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, FrameWorker, with_kept_cloud
from sl_nerfstudio.processing.kept.large_clouds import LargeClouds
from sl_nerfstudio.progress import track
from sl_nerfstudio.registration.frame_cloud import FrameCloud, frame_cloud
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.relative_pose.estimation import (
    RelativePose,
    RelativePoseError,
    estimate_relative_pose,
    relative_pose_near,
)
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of, subsample

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
        cloud: FrameCloud | None = frame_cloud(
            result.name, coords, job.camera, job.projector, pose, light=decoded.light, seen=seen
        )
    except RelativePoseError as error:
        return replace(result, cloud=None, stage="calibrating", reason=f"{result.frame.images[0]}: {error}")
    return replace(result, cloud=cloud, stage="", reason="")


def with_equal_baselines(registration: Registration) -> Registration:
    """The registration with one baseline for all frames: their geometric mean, which is one."""
    baseline = np.where(registration.registered, 1.0, np.nan)
    return replace(registration, baseline=baseline)
