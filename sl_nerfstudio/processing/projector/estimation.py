"""`--estimate-projector` for devices that move freely: intrinsics from all decoded frames."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, FrameWorker
from sl_nerfstudio.processing.kept.stages import StageStore
from sl_nerfstudio.processing.projector.found import FoundProjector
from sl_nerfstudio.processing.projector.words import doubt_sentence, not_found
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of
from sl_nerfstudio.relative_pose.unknown_projector.estimate import (
    NoProjector,
    estimate_projector,
)
from sl_nerfstudio.relative_pose.unknown_projector.matches import FrameMatches
from sl_nerfstudio.relative_pose.unknown_projector.parameters import CX, CY, K1, LOG_ASPECT, LOG_FOCAL


def decoded_matches(
    job: FrameJob, results: Sequence[FrameStageResult]
) -> tuple[list[FrameStageResult], list[FrameMatches]]:
    """Frames that were decoded, and their correspondences."""
    worker = FrameWorker(job)
    decoded = [result for result in results if result.key]
    coords = [worker.load(result).coords for result in decoded]
    return decoded, [
        FrameMatches(result.name, *correspondences_of(uv), job.camera_of(result.frame))
        for result, uv in zip(decoded, coords, strict=True)
    ]


def find_projector(job: FrameJob, results: Sequence[FrameStageResult], stated: bool) -> FoundProjector:
    """The projector from the epipolar geometry of all decoded frames.

    Raises UserError, with the cause that was measured and what to add, where the frames do not determine it.
    """
    _, matches = decoded_matches(job, results)
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
    """1 sigma of fl_x, fl_y, cx, cy, k1, from the covariance of `parameters.NAMES`."""
    log_fl_y = C[LOG_FOCAL, LOG_FOCAL] + 2 * C[LOG_FOCAL, LOG_ASPECT] + C[LOG_ASPECT, LOG_ASPECT]
    s = np.sqrt([C[LOG_FOCAL, LOG_FOCAL], max(log_fl_y, 0.0), C[CX, CX], C[CY, CY], C[K1, K1]])
    unit = np.array([device.fl_x, device.fl_y, device.w, device.w, 1.0])
    a, b, c, d, e = (s * unit).tolist()
    return a, b, c, d, e
