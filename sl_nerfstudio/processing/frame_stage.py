"""The part of the work that every frame needs by itself: decoding, auto-calibration, triangulation."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from sl_nerfstudio.decoding.decoded import Decoded, DecodingError
from sl_nerfstudio.decoding.decoders import DecoderName, Layout, decoder_key, make_decoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.captures import CapturedFrame
from sl_nerfstudio.processing.store import DecodedStore
from sl_nerfstudio.registration.frame_cloud import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, estimate_relative_pose
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of
from sl_nerfstudio.scan.file_error import FileError


@dataclass(frozen=True)
class FrameJob:
    """All that decoding and calibrating frames needs to know, the same for every frame."""

    work: Path
    decoder: DecoderName
    layout: Layout
    camera: Device
    projector: Device
    seed: int


@dataclass(frozen=True)
class FrameOutcome:
    """What came of one frame."""

    frame: CapturedFrame
    key: str  # of the decoded frame in the store; "" if it could not even be read
    resumed: bool  # it had been decoded before
    decode_rate: float  # decoded pixels of those in the mask
    mask_share: float  # of the image
    cloud: FrameCloud | None  # None: left out
    stage: str = ""  # at which the frame failed: "reading", "decoding", "calibrating"
    reason: str = ""  # problem, cause and remedy, with the file they are about

    @property
    def name(self) -> str:
        """The frame's name."""
        return self.frame.name


class FrameWorker:
    """Takes frames one after the other; the decoder is made when the first one needs it."""

    def __init__(self, job: FrameJob) -> None:
        self._job = job
        self._store = DecodedStore(job.work, decoder_key(job.decoder, job.layout))
        self._decode: Callable[[Sequence[Path]], Decoded] | None = None

    def __call__(self, frame: CapturedFrame) -> FrameOutcome:
        """Decode (or load) and calibrate a frame; what the user can mend becomes part of the outcome."""
        try:
            key = self._store.key(frame)
            decoded = self._store.load(frame, key)
            resumed = decoded is not None
            if decoded is None:
                decoded = self._store.save(frame, key, self._decoded(frame))
        except FileError as error:
            return FrameOutcome(frame, "", False, 0.0, 0.0, None, "reading", str(error))
        except DecodingError as error:
            return FrameOutcome(frame, "", False, 0.0, 0.0, None, "decoding", _about(frame, error))
        share = float(decoded.mask.mean())
        try:
            cloud = self._calibrated(frame, decoded)
        except RelativePoseError as error:
            return FrameOutcome(frame, key, resumed, decoded.rate, share, None, "calibrating", _about(frame, error))
        return FrameOutcome(frame, key, resumed, decoded.rate, share, cloud)

    def load(self, outcome: FrameOutcome) -> Decoded:
        """The decoded maps of a frame that this worker or another has kept."""
        decoded = self._store.load(outcome.frame, outcome.key)
        if decoded is None:
            raise UserError(
                f"{self._job.work}: the decoded frame {outcome.name} has gone\n"
                "    cause:  files were removed while sl-process was running\n    remedy: start again"
            )
        return decoded

    def _decoded(self, frame: CapturedFrame) -> Decoded:
        if self._decode is None:
            self._decode = make_decoder(self._job.decoder, self._job.layout)
        return self._decode(frame.images)

    def _calibrated(self, frame: CapturedFrame, decoded: Decoded) -> FrameCloud:
        job = self._job
        pose = estimate_relative_pose(*correspondences_of(decoded.coords), job.camera, job.projector, job.seed)
        return frame_cloud(frame.name, decoded.coords, job.camera, job.projector, pose)


def run_frames(job: FrameJob, frames: Sequence[CapturedFrame], jobs: int) -> Iterator[FrameOutcome]:
    """Outcomes in the order in which they are ready, from `jobs` processes (1: this one)."""
    if jobs == 1 or len(frames) < 2:
        yield from map(FrameWorker(job), frames)
        return
    pool = ProcessPoolExecutor(min(jobs, len(frames)), get_context("spawn"), _start_worker, (job,))
    try:
        for future in as_completed([pool.submit(_work, frame) for frame in frames]):
            yield future.result()
    except BrokenProcessPool as error:
        raise UserError(
            f"a process that decoded frames was ended from outside\n    cause:  {jobs} of them need more memory than "
            "there is\n    remedy: give a smaller number with --jobs; frames decoded so far are kept"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_worker: FrameWorker | None = None  # of a worker process


def _start_worker(job: FrameJob) -> None:
    global _worker
    import torch

    torch.set_num_threads(1)  # the processes share the cores
    _worker = FrameWorker(job)


def _work(frame: CapturedFrame) -> FrameOutcome:
    if _worker is None:
        raise RuntimeError("a worker process was not set up")
    return _worker(frame)


def _about(frame: CapturedFrame, error: UserError) -> str:
    """The error with the file it is about: the image, or the folder of a sequence."""
    place = frame.images[0] if len(frame.images) == 1 else frame.images[0].parent
    return f"{place}: {error}"
