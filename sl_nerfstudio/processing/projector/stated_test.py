"""Whether the stated intrinsics can be right, by the epipolar geometry of all frames: before anything is registered."""

from collections.abc import Sequence
from dataclasses import replace

from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.calibration.stated_sigma import StatedSigma
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, clouds_of
from sl_nerfstudio.processing.kept.stages import StageStore
from sl_nerfstudio.processing.projector.words import wrong_intrinsics
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of
from sl_nerfstudio.relative_pose.unknown_projector.matches import FrameMatches
from sl_nerfstudio.relative_pose.unknown_projector.stated_intrinsics import check_intrinsics

_FEWEST = 2  # frames: four constraints on three values
_DECISIVE = 0.5  # share of the errors that other intrinsics leave: then it is they that made frames look doubtful


def contradiction_by_epipolar_geometry(job: FrameJob, results: Sequence[FrameStageResult]) -> str:
    """Which intrinsics the frames contradict, with the values that would agree; "" if none."""
    every = clouds_of(results)
    firm = _firm(every)
    clouds = firm if len(firm) >= _FEWEST else every
    if len(clouds) < _FEWEST or len({cloud.camera for cloud in clouds}) > 1:
        return ""
    frames = [FrameMatches(c.name, *correspondences_of(c.coords), c.camera) for c in clouds]
    poses = [(c.pose.T_camera_projector[:3, :3], c.pose.T_camera_projector[:3, 3]) for c in clouds]
    evidence = StageStore(job.work).kept(
        "test of intrinsics",
        (frames, poses, job.projector, job.seed),
        lambda: check_intrinsics(frames, poses, job.projector, job.seed),
    )
    evidence = evidence.allowing(job.stated.either)
    stated_px, best_px = evidence.projector.noise_px
    decisive = len(firm) >= _FEWEST or best_px < _DECISIVE * stated_px
    return wrong_intrinsics(evidence) if decisive and evidence.contradicts() else ""


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
