"""The frame stage: every capture decoded and calibrated by itself, in several processes."""

import multiprocessing
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from sl_nerfstudio.calibration.stated import StatedSigma
from sl_nerfstudio.console import track
from sl_nerfstudio.decoding.decoder import Decoded, Decoder, DecodingError
from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.matching.lines import pixels_a_period
from sl_nerfstudio.matching.matcher import DecodedImage, LineMatcher
from sl_nerfstudio.parallel import (
    cores,
    end_with_parent,
    memory_of_process,
    no_interrupts,
    one_library_thread,
    only_one_library_thread,
)
from sl_nerfstudio.processing.cache import StageStore, stage_key
from sl_nerfstudio.processing.captures import CapturedFrame, Captures
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.masks import UserMasks
from sl_nerfstudio.processing.records import KEY_LENGTH, DecodedStore, LargeClouds, Manifest
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of
from sl_nerfstudio.relative_pose.estimation import (
    RelativePose,
    RelativePoseError,
    estimate_relative_pose,
    relative_pose_near,
)
from sl_nerfstudio.relative_pose.joint_fit import FrameMatches
from sl_nerfstudio.review.verdict import listed
from sl_nerfstudio.scan.document import FileError
from sl_nerfstudio.scan.images import Pixels, as_grey

# One frame by itself: decoding, the relative pose of the projector, matching along its lines, triangulation.

Step = Literal["decode", "calibrate", "match"]
"""How far a frame is processed, each step after those before: without a projector frames are only decoded, and without
an exact camera they are not matched along epipolar lines."""


@dataclass(frozen=True)
class FrameJob:
    """What decoding and calibrating a frame needs, the same for every frame."""

    work: Path  # folder of the decoded frames
    decoder: Decoder[Any]
    camera: Device
    projector: Device
    seed: int
    masks: UserMasks | None = None  # of the user
    cameras: dict[str, Device] = field(default_factory=dict)  # by name, if there are several; `camera` is the first
    stated: StatedSigma = field(default_factory=StatedSigma)  # how uncertain the files say the intrinsics are
    last_step: Step = "match"
    shrink: int = 1  # by which photographs are shrunk when they are read; cameras and maps are of that size

    def camera_of(self, frame: CapturedFrame) -> Device:
        """The camera that took a frame."""
        return self.cameras.get(frame.camera, self.camera)


@dataclass(frozen=True)
class FrameStageResult:
    """What the frame stage made of one frame."""

    frame: CapturedFrame
    key: str = ""  # of the decoded frame in the store; "" if it was not decoded
    resumed: bool = False  # it had been decoded by an earlier run
    decode_rate: float = 0.0  # decoded pixels of those in the mask
    mask_share: float = 0.0  # of the image
    cloud: FrameCloud | None = None  # None: the frame is left out
    stage: str = ""  # in which the frame failed: "reading", "decoding", "calibrating"; "" if it did not
    reason: str = ""  # problem, cause and remedy, with the file they are about
    matched: str = ""  # key of the frame matched along epipolar lines in the store; "" if it was not matched
    notes: tuple[str, ...] = ()  # of the decoder, on the capture

    @property
    def name(self) -> str:
        """The frame's name."""
        return self.frame.name

    def failed(self, stage: str, reason: str) -> "FrameStageResult":
        """The frame left out."""
        return replace(self, cloud=None, stage=stage, reason=reason)

    def showing(self, selected: Decoded) -> "FrameStageResult":
        """The frame with the figures of what was decoded."""
        return replace(self, decode_rate=selected.rate, mask_share=float(selected.mask.mean()))

    def calibrated(self, cloud: FrameCloud) -> "FrameStageResult":
        """The frame with its cloud, whatever stopped it before."""
        return replace(self, cloud=cloud, stage="", reason="")


def clouds_of(results: Sequence[FrameStageResult]) -> list[FrameCloud]:
    """The clouds of all frames that are not left out."""
    return [result.cloud for result in results if result.cloud is not None]


def captures_of(results: Sequence[FrameStageResult]) -> tuple[int, ...]:
    """Numbers, from 0, of the captures that those clouds are of."""
    return tuple(k for k, result in enumerate(results) if result.cloud is not None)


def matches_of(clouds: Sequence[FrameCloud]) -> tuple[list[FrameMatches], list[tuple[ndarray, ndarray]]]:
    """The correspondences of frames, and R and t of their relative poses: what fits to all frames start from."""
    frames = [FrameMatches(cloud.name, *correspondences_of(cloud.coords), cloud.camera) for cloud in clouds]
    T = [cloud.pose.T_camera_projector for cloud in clouds]
    return frames, [(one[:3, :3], one[:3, 3]) for one in T]


def with_clouds(results: Sequence[FrameStageResult], clouds: Sequence[FrameCloud]) -> list[FrameStageResult]:
    """The results with other clouds of the same frames, in the order of `clouds_of`."""
    found = iter(clouds)
    return [result if result.cloud is None else replace(result, cloud=next(found)) for result in results]


def with_kept_cloud(result: FrameStageResult, clouds: LargeClouds) -> FrameStageResult:
    """A frame whose cloud, if it has one, is where there is room for it."""
    return result if result.cloud is None else replace(result, cloud=clouds.kept(result.cloud))


class FrameWorker:
    """Decodes and calibrates frames one after the other, up to the last step of the job."""

    def __init__(self, job: FrameJob) -> None:
        self._job = job
        self._store = DecodedStore(job.work, job.decoder.key)
        self._stages = StageStore(job.work)
        # what is decoded from several images of a frame is exact to begin with
        self._grid = job.decoder if isinstance(job.decoder, NetworkDecoder) else None
        self._matcher = None if self._grid is None else LineMatcher(self._grid.layout)

    def __call__(self, frame: CapturedFrame) -> FrameStageResult:
        """Process a frame; what an earlier run did is loaded. A frame that fails is left out, with its reason."""
        result = FrameStageResult(frame)
        try:
            key = self._store.key(frame)
            decoded = self._store.load(frame, key)
            resumed = decoded is not None
            if decoded is None:
                decoded = self._decode(frame, key)
            result = replace(result, key=key, resumed=resumed, notes=decoded.notes)
            result = result.showing(self._selected(frame.name, decoded))
        except FileError as error:
            return result.failed("reading", str(error))
        except DecodingError as error:
            return result.failed("decoding", self._with_file(frame, error))
        return result if self._job.last_step == "decode" else self._calibrated(result, decoded)

    def _decode(self, frame: CapturedFrame, key: str) -> Decoded:
        """Decode a frame, and store it; a single photograph with it, so that nothing needs to read that again."""
        images = [frame.read(place) for place in range(len(frame.images))]
        decoded = self._job.decoder.decode(images, [path.name for path in frame.images])
        return self._store.save(frame, key, decoded, None if self._job.decoder.sequence else images[0])

    def calibrate(self, result: FrameStageResult) -> FrameStageResult:
        """The frame with its relative pose and cloud from all decoded coordinates, or left out with the reason."""
        return self._calibrated(result, self._stored(result, result.key))

    def load(self, result: FrameStageResult) -> Decoded:
        """The maps of a frame, matched if it was, whichever worker stored them. Raises UserError if there are none."""
        return self.load_with_seen(result)[0]

    def load_mask(self, result: FrameStageResult) -> Bool[ndarray, "h w"]:
        """The mask of a frame like that of `load`, without its other maps."""
        mask = self._store.load_one(result.frame, result.matched or result.key, "mask")
        if mask is None:
            raise self._missing(result)
        return mask if self._job.masks is None else mask & self._job.masks.of(result.name)

    def image(self, result: FrameStageResult, place: int) -> Pixels:
        """One of the photographs at the size that is decoded. Raises FileError."""
        stored = self._store.load_one(result.frame, result.key, "image") if result.key and place == 0 else None
        return result.frame.read(place) if stored is None else stored

    def load_with_seen(self, result: FrameStageResult) -> tuple[Decoded, Bool[ndarray, "h w"]]:
        """Load the maps of a frame, and where the camera saw the pattern, whatever the user's mask selects."""
        stored = self._stored(result, result.matched or result.key)
        return self._selected(result.name, stored), stored.mask

    def _calibrated(self, result: FrameStageResult, decoded: Decoded) -> FrameStageResult:
        result, devices = replace(result, matched=""), (self._job.camera_of(result.frame), self._job.projector)
        try:
            selected = self._selected(result.name, decoded)
            pose = self._pose(result, selected)
            matched = self._match(result, decoded, pose) if self._job.last_step == "match" else None
            if matched is not None:
                key, decoded = matched
                selected = self._selected(result.name, decoded)
                result = replace(result.showing(selected), matched=key)
                pose = self._pose(result, selected, near=pose)
            seen = decoded.mask  # also where the user's mask selects nothing
            cloud = frame_cloud(result.name, selected.coords, *devices, pose, light=selected.light, seen=seen)
        except FileError as error:
            return result.failed("reading", str(error))
        except DecodingError as error:  # nothing that was matched is inside the user's mask
            return result.failed("decoding", self._with_file(result.frame, error))
        except RelativePoseError as error:
            noted = "".join(f"\n    note:   {note}" for note in result.notes)
            return result.failed("calibrating", self._with_file(result.frame, error) + noted)
        return replace(result, cloud=cloud)

    def _pose(self, result: FrameStageResult, decoded: Decoded, near: RelativePose | None = None) -> RelativePose:
        """The relative pose from all coordinates, as an earlier run found it if it did.

        With `near`, the pose that the coordinates were matched with, no other one is looked for.
        """
        coords, given = decoded.coords, (self._job.camera_of(result.frame), self._job.projector, self._job.seed)
        start = () if near is None else (near.T_camera_projector,)

        def compute() -> RelativePose:
            seen = correspondences_of(coords)
            return relative_pose_near(*start, *seen, *given) if start else estimate_relative_pose(*seen, *given)

        return self._stages.kept("calibration", (coords, *given, *start), compute, result.name)

    def _match(self, result: FrameStageResult, decoded: Decoded, pose: RelativePose) -> tuple[str, Decoded] | None:
        """Key and maps of a frame matched along the epipolar lines of `pose`; None where it is left as it is.

        So are frames that several poses explain: coordinates must not be changed for one of them. Raises FileError if
        the image cannot be read.
        """
        if self._grid is None or self._matcher is None or pose.alternatives:
            return None
        frame, devices = result.frame, (self._job.camera_of(result.frame), self._job.projector)
        key = stage_key("matching", (result.key, *devices, pose.T_camera_projector))[:KEY_LENGTH]
        kept = self._store.load(frame, key)
        if kept is not None:
            return key, kept
        grey = as_grey(self.image(result, 0))
        coords = self._matcher.match(
            DecodedImage(grey, decoded.coords, decoded.mask), *devices, pose.T_camera_projector
        )
        size = pixels_a_period(decoded.coords, self._grid.layout.period)
        if coords is decoded.coords or size is None:
            return None
        return key, self._store.save(frame, key, self._grid.images.decoded(grey, coords, decoded.mask, size))

    def _stored(self, result: FrameStageResult, key: str) -> Decoded:
        decoded = self._store.load(result.frame, key)
        if decoded is None:
            raise self._missing(result)
        return decoded

    def _missing(self, result: FrameStageResult) -> UserError:
        return UserError(
            f"{self._job.work}: the decoded frame {result.name} is missing\n"
            "    cause:  files were removed while sl-process was running\n    remedy: start again"
        )

    def _selected(self, name: str, decoded: Decoded) -> Decoded:
        """What the user's mask of a frame selects; without masks, everything."""
        return decoded if self._job.masks is None else self._job.masks.applied(name, decoded)

    def _with_file(self, frame: CapturedFrame, error: UserError) -> str:
        """The error with the file it is about: the image, or the folder of a sequence."""
        path = frame.images[0].parent if self._job.decoder.sequence else frame.images[0]
        return f"{path}: {error}"


# Worker processes that end with their parent, whatever ends it, and leave control-C to it.

_PROCESS, _PIXEL = 1.4e9, 200  # bytes that decoding a photograph takes: of any size, and for each pixel that is decoded
_READ = 15  # bytes for each pixel of a photograph while it is read
_MAIN_PROCESS = 1.0e9  # bytes of the process that collects the results, without the clouds that it may keep
_FOR_PROCESSES = 0.85  # share of the memory that is left to the processes


def default_processes(pixels: int, memory: int, shrink: int = 1) -> int:
    """One for each core, but not more than `memory` (bytes) is enough for; `pixels` of the largest photograph."""
    room = _FOR_PROCESSES * memory - _MAIN_PROCESS
    return max(1, min(cores(), int(room / (_PROCESS + max(_READ, _PIXEL / shrink**2) * pixels))))


@contextmanager
def worker_pool(workers: int, initialise: Callable[..., None], *arguments: object) -> Iterator[ProcessPoolExecutor]:
    """A pool of new processes, each of which calls `initialise` first; work must be submitted under `no_interrupts`.

    An exception in the block, control-C among them, ends the workers at once, whatever they are doing.
    """
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _start, (initialise, *arguments))
    try:
        yield pool
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _start(initialise: Callable[..., None], *arguments: object) -> None:
    end_with_parent()
    initialise(*arguments)


def run_frame_stage(config: ProcessConfig, job: FrameJob, captures: Captures) -> list[FrameStageResult]:
    """Results of all frames, in the order of the captures; the manifest in the work folder is kept up to date."""
    found: dict[str, FrameStageResult] = {
        frame.name: FrameStageResult(frame).failed("reading", str(captures.faults[frame.name]))
        for frame in captures.frames
        if frame.name in captures.faults
    }
    todo = [frame for frame in captures.frames if frame.name not in found]
    settings = {
        "decoder": job.decoder.name,
        "decoder_version": job.decoder.version,
        "pattern": str(config.pattern),
        "images": str(config.images),
    }
    if job.masks is not None:
        settings |= {"masks": str(job.masks.folder), "masks_digest": job.masks.digest}
    manifest = Manifest(job.work, settings)
    largest = max((w * h for w, h in captures.sizes.values()), default=0)
    jobs, clouds = config.jobs or default_processes(largest, memory_of_process(), job.shrink), LargeClouds()
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
    """Run the frame stage with another job, on frames that this run has decoded."""
    resumed = {result.name: result.resumed for result in before}
    return [replace(r, resumed=resumed[r.name]) for r in run_frame_stage(config, job, captures)]


def capture_sentences(noted: Sequence[tuple[str, Sequence[str]]]) -> list[str]:
    """What the decoder noted on frames, by their names: each note once with the frames that it is about."""
    found: dict[str, list[str]] = {}
    for name, notes in noted:
        for note in notes:
            found.setdefault(note, []).append(name)
    return [f"{'all' if len(names) == len(noted) else listed(names)}: {note}" for note, names in found.items()]


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
    except (BrokenProcessPool, EOFError, ConnectionError) as error:  # a worker; the process that has the networks
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
