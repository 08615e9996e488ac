"""One frame by itself: decoding, the relative pose of the projector, matching along its lines, triangulation."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from jaxtyping import Bool
from numpy import ndarray

from sl_nerfstudio.calibration.stated_sigma import StatedSigma
from sl_nerfstudio.decoding.decoded import Decoded, DecodingError
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.captures import CapturedFrame
from sl_nerfstudio.processing.kept.large_clouds import LargeClouds
from sl_nerfstudio.processing.kept.matched_frames import FrameMatcher
from sl_nerfstudio.processing.kept.stages import StageStore
from sl_nerfstudio.processing.kept.store import DecodedStore
from sl_nerfstudio.processing.selection.user_masks import UserMasks
from sl_nerfstudio.registration.frame_cloud import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.estimation import (
    RelativePose,
    RelativePoseError,
    estimate_relative_pose,
    relative_pose_near,
)
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of
from sl_nerfstudio.scan.file_error import FileError


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
    projector_known: bool = True  # False: frames are only decoded, until the projector has been found
    camera_known: bool = True  # False: nothing is matched along epipolar lines, until the camera has been found

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

    @property
    def name(self) -> str:
        """The frame's name."""
        return self.frame.name


def clouds_of(results: Sequence[FrameStageResult]) -> list[FrameCloud]:
    """The clouds of all frames that are not left out."""
    return [result.cloud for result in results if result.cloud is not None]


def with_clouds(results: Sequence[FrameStageResult], clouds: Sequence[FrameCloud]) -> list[FrameStageResult]:
    """The results with other clouds of the same frames, in the order of `clouds_of`."""
    found = iter(clouds)
    return [result if result.cloud is None else replace(result, cloud=next(found)) for result in results]


def with_kept_cloud(result: FrameStageResult, clouds: LargeClouds) -> FrameStageResult:
    """A frame whose cloud, if it has one, is where there is room for it."""
    return result if result.cloud is None else replace(result, cloud=clouds.kept(result.cloud))


class FrameWorker:
    """Decodes and calibrates frames one after the other."""

    def __init__(self, job: FrameJob) -> None:
        self._job = job
        self._store = DecodedStore(job.work, job.decoder.key)
        self._stages = StageStore(job.work)
        self._matcher = FrameMatcher(job.decoder, self._store)

    def __call__(self, frame: CapturedFrame) -> FrameStageResult:
        """Decode (or load) and calibrate a frame. A frame that fails is left out, with its reason."""
        try:
            key = self._store.key(frame)
            decoded = self._store.load(frame, key)
            resumed = decoded is not None
            if decoded is None:
                decoded = self._store.save(frame, key, self._job.decoder.decode(frame.images))
            selected = self._selected(frame.name, decoded)
        except FileError as error:
            return FrameStageResult(frame, stage="reading", reason=str(error))
        except DecodingError as error:
            return FrameStageResult(frame, stage="decoding", reason=self._with_file(frame, error))
        share = float(selected.mask.mean())
        result = FrameStageResult(frame, key, resumed, selected.rate, share)
        return self._calibrated(result, decoded) if self._job.projector_known else result

    def calibrate(self, result: FrameStageResult) -> FrameStageResult:
        """The frame with its relative pose and cloud from all decoded coordinates, or left out with the reason."""
        return self._calibrated(result, self._stored(result, result.key))

    def load(self, result: FrameStageResult) -> Decoded:
        """The maps of a frame, matched if it was, whichever worker stored them. Raises UserError if there are none."""
        return self.load_with_seen(result)[0]

    def load_with_seen(self, result: FrameStageResult) -> tuple[Decoded, Bool[ndarray, "h w"]]:
        """The same, and where the camera saw the pattern, whatever the user's mask selects."""
        stored = self._stored(result, result.matched or result.key)
        return self._selected(result.name, stored), stored.mask

    def _calibrated(self, result: FrameStageResult, decoded: Decoded) -> FrameStageResult:
        job, camera = self._job, self._job.camera_of(result.frame)
        selected = self._selected(result.name, decoded)
        seen = decoded.mask  # also where the user's mask selects nothing
        try:
            pose = self._pose(result, selected)
            devices = camera, job.projector
            found = (
                self._matcher.matched(result.frame, result.key, decoded, devices, pose) if job.camera_known else None
            )
            result = replace(result, matched="")
            if found is not None:
                selected, seen = self._selected(result.name, found[1]), found[1].mask
                share = float(selected.mask.mean())
                result = replace(result, matched=found[0], decode_rate=selected.rate, mask_share=share)
                pose = self._pose_near(pose, result, selected)
            cloud = frame_cloud(result.name, selected.coords, *devices, pose, light=selected.light, seen=seen)
        except FileError as error:
            return replace(result, cloud=None, stage="reading", reason=str(error))
        except DecodingError as error:  # nothing that was matched is inside the user's mask
            return replace(result, cloud=None, stage="decoding", reason=self._with_file(result.frame, error))
        except RelativePoseError as error:
            return replace(result, cloud=None, stage="calibrating", reason=self._with_file(result.frame, error))
        return replace(result, cloud=cloud)

    def _pose(self, result: FrameStageResult, decoded: Decoded) -> RelativePose:
        """From all coordinates, or as an earlier run found it."""
        job, coords, camera = self._job, decoded.coords, self._job.camera_of(result.frame)
        return self._stages.kept(
            f"calibration {result.name}",
            (coords, camera, job.projector, job.seed),
            lambda: estimate_relative_pose(*correspondences_of(coords), camera, job.projector, job.seed),
        )

    def _pose_near(self, start: RelativePose, result: FrameStageResult, decoded: Decoded) -> RelativePose:
        """From the coordinates that were matched with the pose `start`, beside which there is no other."""
        job, coords, camera = self._job, decoded.coords, self._job.camera_of(result.frame)
        T = start.T_camera_projector
        return self._stages.kept(
            f"calibration {result.name}",
            (coords, camera, job.projector, job.seed, T),
            lambda: relative_pose_near(T, *correspondences_of(coords), camera, job.projector, job.seed),
        )

    def _stored(self, result: FrameStageResult, key: str) -> Decoded:
        decoded = self._store.load(result.frame, key)
        if decoded is None:
            raise UserError(
                f"{self._job.work}: the decoded frame {result.name} is missing\n"
                "    cause:  files were removed while sl-process was running\n    remedy: start again"
            )
        return decoded

    def _selected(self, name: str, decoded: Decoded) -> Decoded:
        """What the user's mask of a frame selects; without masks, everything."""
        return decoded if self._job.masks is None else self._job.masks.applied(name, decoded)

    def _with_file(self, frame: CapturedFrame, error: UserError) -> str:
        """The error with the file it is about: the image, or the folder of a sequence."""
        path = frame.images[0].parent if self._job.decoder.sequence else frame.images[0]
        return f"{path}: {error}"
