"""Correspondences of all frames in one array, and their residuals for one projector and all relative poses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.pattern_blocks import blocks_of
from sl_nerfstudio.relative_pose.ray_pairs import RayPairs, directions, directions_by_uv
from sl_nerfstudio.relative_pose.sampson import sampson_of_frames
from sl_nerfstudio.relative_pose.settings import PatternBlocks

UnitPose = tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]  # R and unit t, projector to camera


@dataclass(frozen=True)
class FrameMatches:
    """Correspondences of one frame, and its camera."""

    name: str
    uv_camera: Float64[ndarray, "n 2"]
    uv_projector: Float64[ndarray, "n 2"]
    camera: Device


@dataclass(frozen=True)
class Matches:
    """Correspondences of all frames, frame after frame."""

    d_camera: Float64[ndarray, "n 3"]
    uv_projector: Float64[ndarray, "n 2"]
    frame: Int64[ndarray, "n"]
    block: Int64[ndarray, "n"]  # frame and square of the pattern; errors within one may depend on each other
    frames: int

    @staticmethod
    def of(
        frames: Sequence[FrameMatches], projector: Device, blocks: PatternBlocks, most: int, rng: np.random.Generator
    ) -> "Matches":
        """At most `most` correspondences of each frame, by chance."""
        d_camera, uv_projector, number, block = [], [], [], []
        for k, frame in enumerate(frames):
            d = directions(frame.camera, frame.uv_camera)
            usable = np.flatnonzero(np.isfinite(d).all(-1) & np.isfinite(frame.uv_projector).all(-1))
            if len(usable) > most:
                usable = np.sort(rng.choice(usable, most, replace=False))
            uv = frame.uv_projector[usable]
            d_camera.append(d[usable])
            uv_projector.append(uv)
            number.append(np.full(len(usable), k))
            block.append(k * 1_000_000 + blocks_of(uv, projector, blocks))
        rays, uv, number, block = (np.concatenate(part) for part in (d_camera, uv_projector, number, block))
        return Matches(rays, uv, number, block, len(frames))

    def chosen(self, keep: Bool[ndarray, "n"]) -> "Matches":
        """Some of the correspondences, of the same frames."""
        parts = (self.d_camera[keep], self.uv_projector[keep], self.frame[keep], self.block[keep])
        return Matches(*parts, self.frames)

    def of_frame(self, k: int) -> slice:
        """Where a frame's correspondences are."""
        return slice(*np.searchsorted(self.frame, [k, k + 1]).tolist())

    def rays(self, projector: Device) -> RayPairs:
        """The rays with a projector; those that have none are NaN."""
        return RayPairs(self.d_camera, *directions_by_uv(projector, self.uv_projector), self.block)

    def residuals(self, poses: "Poses", rays: RayPairs) -> Float64[ndarray, "n"]:
        """Distances of the coordinates from their epipolar curves, in projector pixels, as in `sampson`."""
        return sampson_of_frames(poses.R, poses.t, rays, self.frame)


@dataclass(frozen=True)
class Poses:
    """Relative poses of all frames, baseline one."""

    R: Float64[ndarray, "frames 3 3"]  # projector to camera
    t: Float64[ndarray, "frames 3"]

    @staticmethod
    def of(poses: Sequence[UnitPose]) -> "Poses":
        """From single poses."""
        return Poses(np.stack([R for R, _ in poses]), np.stack([t for _, t in poses]))

    def chosen(self, keep: Sequence[int] | Int64[ndarray, "m"]) -> "Poses":
        """Of some frames."""
        return replace(self, R=self.R[keep], t=self.t[keep])
