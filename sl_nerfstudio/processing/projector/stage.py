"""The frame stage with what is known of the projector and of the rig: every frame decoded and calibrated."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frame_stage import describe_frame_stage, run_frame_stage, run_frame_stage_again
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult
from sl_nerfstudio.processing.inputs import Inputs
from sl_nerfstudio.processing.projector.estimation import find_projector
from sl_nerfstudio.processing.projector.found import FoundProjector, describe
from sl_nerfstudio.processing.projector.rigid import with_one_pose
from sl_nerfstudio.processing.projector.static import place_static
from sl_nerfstudio.registration.result import Registration

Log = Callable[[str], None]


@dataclass(frozen=True)
class CalibratedFrames:
    """Frames with their clouds, the projector with which they were calibrated, and the registration if it is known."""

    job: FrameJob
    results: Sequence[FrameStageResult]
    found: FoundProjector | None = None  # None: the projector is the stated one
    registration: Registration | None = None  # of a projector that stands still; of the frames that have clouds


def calibrate_frames(config: ProcessConfig, inputs: Inputs, log: Log) -> CalibratedFrames:
    """Decode and calibrate all frames. Raises UserError where a projector is to be found and cannot be."""
    job = inputs.job
    results = run_frame_stage(config, job, inputs.captures)
    if job.projector_known:
        log(describe_frame_stage(results))
        return _as_moved(config, CalibratedFrames(job, results))
    decoded = sum(bool(result.key) for result in results)
    log(f"decoded {decoded} of {len(results)} frames")
    if config.rig == "static-projector":
        return place_static_frames(config, inputs, job, results, log)
    found = find_projector(job, results, inputs.projector_stated)
    log(describe(found))
    job = replace(job, projector=found.projector, projector_known=True)
    results = run_frame_stage_again(config, job, inputs.captures, results)
    log(describe_frame_stage(results))
    return _as_moved(config, CalibratedFrames(job, results, found))


def place_static_frames(
    config: ProcessConfig, inputs: Inputs, job: FrameJob, results: Sequence[FrameStageResult], log: Log
) -> CalibratedFrames:
    """All frames under a projector that stands still."""
    placed = place_static(job, results, inputs.projector_stated, config.estimate_projector)
    if placed.found is not None:
        log(describe(placed.found))
    job = replace(job, projector=placed.projector, projector_known=True)
    log(describe_frame_stage(placed.results))
    return CalibratedFrames(job, placed.results, placed.found, placed.registration)


def _as_moved(config: ProcessConfig, calibrated: CalibratedFrames) -> CalibratedFrames:
    if config.rig == "rigid":
        return replace(calibrated, results=with_one_pose(calibrated.job, calibrated.results))
    return calibrated
