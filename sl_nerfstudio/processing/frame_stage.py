"""The frame stage: every capture decoded and calibrated by itself, in several processes."""

from collections.abc import Generator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import replace

import numpy as np

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.large_arrays import memory_of_process
from sl_nerfstudio.processing.captures import CapturedFrame, Captures
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, FrameWorker, clouds_of, with_kept_cloud
from sl_nerfstudio.processing.kept.large_clouds import LargeClouds
from sl_nerfstudio.processing.kept.store import Manifest
from sl_nerfstudio.processing.workers import default_processes, no_interrupts, worker_pool
from sl_nerfstudio.progress import track
from sl_nerfstudio.threads import one_library_thread, only_one_library_thread


def run_frame_stage(config: ProcessConfig, job: FrameJob, captures: Captures) -> list[FrameStageResult]:
    """Results of all frames, in the order of the captures; the manifest in the work folder is kept up to date."""
    found: dict[str, FrameStageResult] = {
        frame.name: FrameStageResult(frame, stage="reading", reason=str(captures.faults[frame.name]))
        for frame in captures.frames
        if frame.name in captures.faults
    }
    todo = [frame for frame in captures.frames if frame.name not in found]
    settings = {"decoder": job.decoder.name, "pattern": str(config.pattern), "images": str(config.images)}
    if job.masks is not None:
        settings |= {"masks": str(job.masks.folder), "masks_digest": job.masks.digest}
    manifest = Manifest(job.work, settings)
    largest = max((w * h for w, h in captures.sizes.values()), default=0)
    jobs, clouds = config.jobs or default_processes(largest, memory_of_process()), LargeClouds()
    with closing(run_frames(job, todo, jobs)) as ready:  # an exception here ends the workers, too
        for result in track(ready, "decoding and calibrating", len(todo)):
            found[result.name] = with_kept_cloud(result, clouds)
            done = "decoded before" if result.resumed else "decoded"
            status = f"failed in {result.stage}" if result.stage else done
            manifest.note(result.name, result.matched or result.key, status, result.reason)
    return [found[frame.name] for frame in captures.frames]


def run_frame_stage_again(
    config: ProcessConfig, job: FrameJob, captures: Captures, before: Sequence[FrameStageResult]
) -> list[FrameStageResult]:
    """The same with another job, for frames that this run has decoded."""
    resumed = {result.name: result.resumed for result in before}
    return [replace(r, resumed=resumed[r.name]) for r in run_frame_stage(config, job, captures)]


def describe_frame_stage(results: Sequence[FrameStageResult]) -> str:
    """One line: how many frames can be used, and how good they are."""
    resumed = sum(result.resumed for result in results)
    again = f" ({resumed} had been decoded before)" if resumed else ""
    clouds = clouds_of(results)
    begin = f"decoded and calibrated {len(clouds)} of {len(results)} frames{again}"
    if not clouds:
        return begin
    rate = float(np.median([result.decode_rate for result in results if result.cloud is not None]))
    epipolar = float(np.median([cloud.pose.residual_px for cloud in clouds]))
    return f"{begin}: {rate:.0%} of the pattern, epipolar residual {epipolar:.2f} px (medians)"


def run_frames(job: FrameJob, frames: Sequence[CapturedFrame], jobs: int) -> Generator[FrameStageResult, None, None]:
    """Results in the order in which they are ready, from `jobs` processes (1: this one).

    Raises UserError if a process was killed.
    """
    if jobs == 1 or len(frames) < 2:
        worker = FrameWorker(job)
        for frame in frames:
            with one_library_thread():  # as in worker processes: sums over several threads differ in the last digit
                result = worker(frame)
            yield result
        return
    try:
        with worker_pool(min(jobs, len(frames)), _start_worker, job) as pool:
            with no_interrupts():  # a future keeps its result: of those that are done, none may be kept
                ready = as_completed([pool.submit(_work, frame) for frame in frames])
            for future in ready:
                yield future.result()
    except BrokenProcessPool as error:
        raise UserError(
            f"a process that decoded frames was killed\n    cause:  {jobs} processes need more memory than there is\n"
            "    remedy: give a smaller number with --jobs; frames decoded so far are kept"
        ) from error


_worker: FrameWorker | None = None  # of a worker process


def _start_worker(job: FrameJob) -> None:
    global _worker
    only_one_library_thread()
    _worker = FrameWorker(job)


def _work(frame: CapturedFrame) -> FrameStageResult:
    if _worker is None:
        raise RuntimeError("a worker process was not set up")
    return _worker(frame)
