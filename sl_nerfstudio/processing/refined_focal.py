"""The projector's focal length from all frames, and every frame calibrated again with it."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, FrameWorker, clouds_of
from sl_nerfstudio.progress import track
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.relative_pose.estimation import RelativePose
from sl_nerfstudio.relative_pose.projector_focal import PosedFrame, refine_projector_focal
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of


def refine_focal(
    job: FrameJob, results: Sequence[FrameStageResult], log: Callable[[str], None]
) -> tuple[FrameJob, list[FrameStageResult]]:
    """The job with the refined projector, and the frames calibrated with it.

    Every frame starts again from all of its decoded coordinates: those that its first pose rejected may be right. A
    frame that cannot be calibrated now is left out, like any other. Nothing changes if the refined focal length does
    not differ significantly from the stated one.
    """
    views = [
        PosedFrame(*correspondences_of(cloud.coords), cloud.camera, _all_inliers(cloud)) for cloud in clouds_of(results)
    ]
    found = refine_projector_focal(views, job.projector, job.seed)
    log(f"projector's focal length: {found.factor:.4f} of the stated one, plus or minus {found.sigma:.4f}")
    if not found.significant:
        log("that is no significant change: the stated one is kept")
        return job, list(results)
    refined = replace(job, projector=found.projector)
    worker = FrameWorker(refined)
    return refined, [
        result if result.cloud is None else worker.calibrate(result, worker.load(result))
        for result in track(results, "calibrating again", len(results))
    ]


def _all_inliers(cloud: FrameCloud) -> RelativePose:
    """The frame's pose for the coordinates of its cloud, which are all inliers."""
    count = int(np.isfinite(cloud.coords).all(-1).sum())
    noise_px = np.full(count, cloud.pose.residual_px)
    return replace(cloud.pose, inliers=np.ones(count, dtype=bool), noise_px=noise_px, alternatives=())
