"""`--object-only`: which part every pixel of the registered frames shows, after all poses are known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from sl_nerfstudio.object_separation.frame_points import DecodedFrame
from sl_nerfstudio.object_separation.plane_judgement import PlaneFinding
from sl_nerfstudio.object_separation.separate import Part, separate
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, FrameWorker, clouds_of
from sl_nerfstudio.processing.scan_poses import ScanPoses
from sl_nerfstudio.progress import track
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.scan.types import Scale


@dataclass(frozen=True)
class FrameShares:
    """What the decoded pixels of a frame show, as shares of them."""

    name: str
    object: float
    plane: float
    beyond: float


@dataclass(frozen=True)
class ObjectOnly:
    """The object and what was left out; lengths in the unit of the scan, planes in its axes."""

    planes: tuple[PlaneFinding, ...]  # all that were judged
    left_out: tuple[PlaneFinding, ...]  # those that are not in the scan
    frames: tuple[FrameShares, ...]
    parts: dict[str, UInt8[ndarray, "h w"]]  # `Part` of every pixel, by the frame's name

    def keeps(self, frame: str) -> Bool[ndarray, "h w"]:
        """The pixels of a frame that show the object."""
        return self.parts[frame] == Part.OBJECT

    def shares(self) -> FrameShares:
        """Of all frames together; each counts alike."""
        means = np.mean([(f.object, f.plane, f.beyond) for f in self.frames], axis=0).tolist()
        return FrameShares("all", *means)

    def empty_frames(self) -> tuple[str, ...]:
        """Frames in which nothing of the object was decoded."""
        return tuple(frame.name for frame in self.frames if frame.object == 0)

    def usable_scale(self, scale: Scale) -> Scale:
        """The scale without a reference to what was left out: a frame, or a pixel.

        The scan has its unit already; only a later adjustment could have looked at the length again.
        """
        lost = set(self.empty_frames())
        picked = () if scale.bar is None else scale.bar.ends
        gone = lost & set(scale.frames) or any(
            not self.keeps(end.frame)[int(end.pixel[1]), int(end.pixel[0])] for end in picked if end.frame in self.parts
        )
        return Scale(scale.known, scale.source) if gone else scale


def find_object_only(
    job: FrameJob, results: Sequence[FrameStageResult], registration: Registration, poses: ScanPoses
) -> ObjectOnly:
    """Separate the object in all registered frames."""
    worker = FrameWorker(job)
    by_name = {result.name: result for result in results}
    names, frames = [], []
    for k, cloud in enumerate(clouds_of(results)):
        if registration.registered[registration.names.index(cloud.name)]:
            names.append(cloud.name)
            devices = poses.adjusted.poses
            frames.append(DecodedFrame(
                cloud.camera, cloud.projector, devices.T_world_camera[k], devices.T_world_projector[k], cloud.coords,
                worker.load(by_name[cloud.name]).mask,
            ))  # fmt: skip
    found = separate(frames, job.seed)
    parts = {
        name: found.parts(k, frame)
        for k, (name, frame) in enumerate(zip(names, track(frames, "object only"), strict=True))
    }
    shares = tuple(_shares(name, parts[name], frame.coords) for name, frame in zip(names, frames, strict=True))
    return ObjectOnly(found.findings, tuple(s.finding for s in found.surroundings), shares, parts)


def with_usable_scale(poses: ScanPoses, found: ObjectOnly) -> ScanPoses:
    """The poses with a scale that does not refer to what was left out."""
    return replace(poses, scale=found.usable_scale(poses.scale))


def _shares(name: str, part: UInt8[ndarray, "h w"], coords: Float[ndarray, "h w 2"]) -> FrameShares:
    shown = part[np.isfinite(coords).all(-1) & (part != Part.NOTHING)]
    count = max(len(shown), 1)
    return FrameShares(name, *(float((shown == kind).sum() / count) for kind in (Part.OBJECT, Part.PLANE, Part.BEYOND)))
