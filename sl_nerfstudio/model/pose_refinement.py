"""From the table of pixels to refined poses: what stands between a training run and the joint adjustment."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.adjust import (
    AdjustmentSettings,
    adjust,
)
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import frame_sigmas
from sl_nerfstudio.bundle_adjustment.cross_validation import CrossValidation, HeldOutPixels, cross_validate
from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses, constrained
from sl_nerfstudio.bundle_adjustment.gauge import agreeing_scale, baseline_scale, restore
from sl_nerfstudio.bundle_adjustment.priors import INTRINSICS_SIGMA, PosePrior
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.self_calibration import SelfCalibration
from sl_nerfstudio.dataparser.samples import PixelSamples
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.se3 import inverse
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.scan import Scan, measured_length

_HELD_OUT_PER_FRAME = 300
# times the decoding noise: beyond it a residual is a wrong decoding, or something else hides the place
_GUARD_WIDTH = 4.0
_GUARD_FLOOR_PX = 0.25  # where decoding is perfect, looking up between pixels is not


@dataclass
class PriorConfig:
    """How well the starting poses are known where the scan does not say (`sl_pose_sigma`), and intrinsics; 1 sigma."""

    frame_rotation_deg: float = 2.0
    """Orientation of a frame in the world, in degrees."""
    frame_translation: float = 0.1
    """Position of a frame's part of the surface, as a share of the object's radius."""
    relative_rotation_deg: float = 0.3
    """Orientation of the projector against the camera, in degrees."""
    relative_translation: float = 0.05
    """Position of the projector against the camera, as a share of the baseline."""
    intrinsics: float = INTRINSICS_SIGMA
    """Focal lengths and principal points of both devices, as a share of the focal length; unless `refine_intrinsics`
    is on they stay as they are, but poses are stated to be as uncertain as this makes them."""


@dataclass(frozen=True)
class ScanAdjustment:
    """Refined poses in the scene frame, or the starting ones where refinement did not help."""

    rig: Rig  # "world" is the scene
    sigma: Float[Tensor, "frames 12"]
    verdict: CrossValidation
    noise_px: float
    intrinsics: SelfCalibration | None = None  # None where nothing was refined

    @property
    def T_scene_camera(self) -> Float[Tensor, "frames 4 4"]:
        """Poses of the cameras."""
        return self.rig.T_world_camera

    @property
    def T_scene_projector(self) -> Float[Tensor, "frames 4 4"]:
        """Poses of the projectors."""
        return self.rig.T_world_projector

    def message(self) -> str:
        """One line for the person who waits."""
        change = f"held-out pixels agree to {self.verdict.after_px:.3g} px, before {self.verdict.before_px:.3g} px"
        if self.verdict.better:
            return f"Poses adjusted: {change}."
        return f"Poses NOT changed, because adjusting them did not help: {change}. The starting poses are kept."


def scene_rig(scan: Scan, S_scene_world: Similarity) -> Rig:
    """The scan's devices at their starting poses, in the scene frame."""
    poses = scan.poses.mapped(S_scene_world)
    camera, projector = torch.from_numpy(poses.T_world_camera), torch.from_numpy(poses.T_world_projector)
    return Rig(
        camera=Intrinsics.of([frame.camera for frame in scan.frames], torch.float64),
        projector=Intrinsics.of(scan.projector, torch.float64),
        T_world_camera=camera,
        T_camera_projector=inverse(camera) @ projector,
    )


def pose_prior(scan: Scan, S_scene_world: Similarity, config: PriorConfig) -> PosePrior:
    """Stated uncertainty of each frame's starting pose, else the defaults; in scene units and radian."""
    rows = []
    for frame, length in zip(scan.frames, scan.poses.baseline * S_scene_world.scale, strict=True):
        stated = frame.pose_sigma
        if stated is None:
            rows.append(
                (
                    config.frame_translation,
                    np.radians(config.frame_rotation_deg),
                    config.relative_translation * length,
                    np.radians(config.relative_rotation_deg),
                )
            )
        else:
            rows.append(
                (
                    stated.camera_translation * S_scene_world.scale,
                    np.radians(stated.camera_rotation_deg),
                    stated.relative_translation * S_scene_world.scale,
                    np.radians(stated.relative_rotation_deg),
                )
            )
    # a sigma of zero is a pose known exactly: a very small one keeps the equations solvable
    sigma = torch.tensor(np.maximum(np.array(rows), 1e-9), dtype=torch.float64)
    a, b, c, d = sigma.unbind(1)
    return PosePrior(a, b, c, d, config.intrinsics, scan.intrinsics_change)


def adjust_scan(
    scan: Scan,
    S_scene_world: Similarity,
    samples: PixelSamples,
    mode: RefinePoses,
    prior: PriorConfig,
    settings: AdjustmentSettings,
) -> ScanAdjustment:
    """Adjust all poses jointly, fix the gauge, and keep the result only if held-out pixels agree better with it."""
    start = scene_rig(scan, S_scene_world)
    maps, held_out = maps_and_held_out(scan, samples)
    stated = pose_prior(scan, S_scene_world, prior)
    found = adjust(constrained(mode, start), maps, stated, mode, settings)
    rig = restore(start, found.rig, _scale(scan, S_scene_world, mode, start, found.rig, stated))
    verdict = cross_validate(start, rig, held_out, maps, guard_width(found.noise_px))
    sigma = found.sigma if verdict.better else _prior_sigma(stated)
    return ScanAdjustment(rig if verdict.better else start, sigma, verdict, found.noise_px, found.intrinsics)


def _scale(scan: Scan, S_scene_world: Similarity, mode: RefinePoses, start: Rig, rig: Rig, prior: PosePrior) -> float:
    """The factor by which the adjusted rig gets the scan's lengths; a known rig keeps its baselines."""
    known = scan.scale
    if known.baseline_of is not None:
        return baseline_scale(start, rig, scan.index_of(known.baseline_of))
    if not known.known or mode == "known-rig":
        return baseline_scale(start, rig, None)
    if known.bar is not None:
        poses = DevicePoses(rig.T_world_camera.numpy(), rig.T_world_projector.numpy())
        return known.bar.length * S_scene_world.scale / measured_length(scan, known.bar, poses)
    return agreeing_scale(start, rig, prior)


def _prior_sigma(prior: PosePrior) -> Float[Tensor, "frames 12"]:
    """What is known of poses that were not refined: the uncertainty they came with, per axis."""
    parts = (prior.frame_translation, prior.frame_rotation, prior.relative_translation, prior.relative_rotation)
    return torch.stack(parts, 1).repeat_interleave(3, 1)


def guard_width(noise_px: float) -> float:
    """From where on a held-out residual says nothing more, in projector pixels."""
    return max(_GUARD_WIDTH * noise_px, _GUARD_FLOOR_PX)


def maps_and_held_out(scan: Scan, samples: PixelSamples) -> tuple[CoordinateMaps, HeldOutPixels]:
    """Coordinate images without the held-out pixels, and some of those."""
    images, frames, uv_camera, uv_projector = [], [], [], []
    for number, frame in enumerate(scan.frames):
        rows = slice(int(samples.first[number]), int(samples.first[number + 1]))
        image = torch.full((frame.camera.h, frame.camera.w, 2), float("nan"))
        row, column, held = samples.row[rows].long(), samples.column[rows].long(), samples.held_out[rows]
        image[row[~held], column[~held]] = samples.coords[rows][~held]
        images.append(image)
        test = samples.at(_evenly(samples.held_out_of(number), _HELD_OUT_PER_FRAME))
        decoded = test.decoded
        frames.append(test.frame[decoded])
        uv_camera.append(test.uv[decoded].double())
        uv_projector.append(test.coords[decoded].double())
    return CoordinateMaps.of(images), HeldOutPixels(torch.cat(frames), torch.cat(uv_camera), torch.cat(uv_projector))


def _evenly(index: Tensor, count: int) -> Tensor:
    if len(index) <= count:
        return index
    return index[torch.linspace(0, len(index) - 1, count).round().long()]


def sigmas_in_scan_units(sigma: Float[Tensor, "frames 12"], S_scene_world: Similarity) -> Float[ndarray, "frames 4"]:
    """RMS per axis: frame translation (scan units), frame rotation (degree), the same for the relative pose."""
    return frame_sigmas(sigma, 1 / S_scene_world.scale)
