"""From the table of pixels to adjusted poses: the link between a training run and the bundle adjustment."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.adjust import (
    HELD_OUT_PER_FRAME,
    Adjustment,
    CrossValidation,
    HeldOutPixels,
    adjust,
    cross_validate,
)
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import (
    JointCovariance,
    frame_sigmas,
    joint_of_prior,
    of_all_lengths,
    with_known_length,
)
from sl_nerfstudio.bundle_adjustment.modes import Mode
from sl_nerfstudio.bundle_adjustment.parameters import (
    INTRINSICS_SIGMA,
    UNKNOWNS,
    USUAL_FRAME_ROTATION_DEG,
    PosePrior,
    RefinePoses,
    SelfCalibration,
    agreeing_scale,
    baseline_scale,
    constrained,
    of_baselines,
    restore,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.dataparser.dataparser import BLOCK, PixelBatch, PixelSamples
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, inverse, log_se3
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.scan import Scan, measured_length

_STEP = 1e-5  # scene units and radian, of central differences
# 1 sigma of starting poses, besides USUAL_FRAME_ROTATION_DEG, if the scan does not state it in `sl_pose_sigma`.
FRAME_TRANSLATION = 0.1  # position of a frame's part of the surface, as a share of the object's radius
RELATIVE_ROTATION_DEG = 0.3  # orientation of the projector relative to the camera
RELATIVE_TRANSLATION = 0.05  # position of the projector relative to the camera, as a share of the baseline
_LEAST_SIGMA = 1e-9  # scene units and radian: for poses that are known exactly; keeps the equations solvable


@dataclass
class PriorConfig:
    """How well the intrinsics are known."""

    intrinsics: float = INTRINSICS_SIGMA
    """1 sigma of focal lengths and principal points of both devices, as a share of the focal length; it increases the
    stated uncertainty of the poses."""


@dataclass(frozen=True)
class ScanAdjustment:
    """Adjusted poses in the scene frame and the scan's gauge, or the starting ones if adjusting did not help."""

    rig: Rig  # "world" is the scene
    sigma: Float[Tensor, "frames 12"]
    factor: Float[Tensor, "joint k"]  # of the covariance of all poses and the intrinsics, see JointCovariance
    noise_px: float
    intrinsics: SelfCalibration | None  # None where nothing was adjusted
    unplaced: tuple[int, ...]  # frames that do not agree with the others
    cross_validation: CrossValidation | None = None  # None before it was done
    modes: tuple[Mode, ...] = ()  # other poses that remain possible, the most probable first; axes are the scene's

    @property
    def adjusted(self) -> bool:
        """Whether `rig` is the adjusted one."""
        return self.cross_validation is None or self.cross_validation.better


def scene_rig(scan: Scan, S_scene_world: Similarity) -> Rig:
    """The scan's devices at their starting poses, in the scene frame."""
    return Rig.of([frame.camera for frame in scan.frames], scan.projector, scan.poses, S_scene_world)


def pose_prior(scan: Scan, S_scene_world: Similarity, config: PriorConfig) -> PosePrior:
    """Uncertainty of each frame's starting pose, as stated or else by default; in scene units and radian."""
    scale, rows = S_scene_world.scale, []
    for frame, length in zip(scan.frames, scan.poses.baseline * scale, strict=True):
        stated = frame.pose_sigma
        if stated is None:
            frame_sigma, relative_sigma = FRAME_TRANSLATION, RELATIVE_TRANSLATION * length
            angles = USUAL_FRAME_ROTATION_DEG, RELATIVE_ROTATION_DEG
        else:
            frame_sigma, relative_sigma = stated.camera_translation * scale, stated.relative_translation * scale
            angles = stated.camera_rotation_deg, stated.relative_rotation_deg
        rows.append((frame_sigma, np.radians(angles[0]), relative_sigma, np.radians(angles[1])))
    sigma = torch.tensor(np.maximum(np.array(rows), _LEAST_SIGMA), dtype=torch.float64)
    a, b, c, d = sigma.unbind(1)
    return PosePrior(a, b, c, d, config.intrinsics, scan.intrinsics_change)


def adjust_scan(
    scan: Scan,
    S_scene_world: Similarity,
    samples: PixelSamples,
    refine: RefinePoses,
    prior: PriorConfig,
    settings: AdjustmentSettings,
) -> ScanAdjustment:
    """Adjust all poses together, fix the gauge, and keep the result only if held-out pixels agree better with it."""
    start = scene_rig(scan, S_scene_world)
    maps, held_out = maps_and_held_out(scan, samples)
    found = adjusted(scan, S_scene_world, maps, refine, prior, settings)
    decision = cross_validate(start, found.rig, held_out, maps, found.noise_px)
    if decision.better:
        return replace(found, cross_validation=decision)
    stated = pose_prior(scan, S_scene_world, prior)
    nothing_learnt = decision.worse or refine == "off"
    sigma, factor = (stated.sigma, joint_of_prior(stated, start)) if nothing_learnt else _known_by_both(start, found)
    return replace(found, rig=start, sigma=sigma, factor=factor, cross_validation=decision, modes=())


def _known_by_both(start: Rig, found: ScanAdjustment) -> tuple[Float[Tensor, "frames 12"], Float[Tensor, "joint k"]]:
    """Uncertainty of starting poses with which the captures agree as well as with the adjusted ones.

    They may be wrong by as much as the adjusted ones, and by as much as the two differ.
    """
    pairs = (start.T_world_camera, found.rig.T_world_camera), (start.T_camera_projector, found.rig.T_camera_projector)
    apart = torch.stack([log_se3(a @ inverse(b)) for a, b in pairs])
    column = torch.nn.functional.pad(apart.flatten(), (0, UNKNOWNS))
    sigma = (found.sigma**2 + apart.transpose(0, 1).flatten(1) ** 2).sqrt()
    return sigma, torch.cat([found.factor, column[:, None]], 1)


def adjusted(
    scan: Scan,
    S_scene_world: Similarity,
    maps: CoordinateMaps,
    refine: RefinePoses,
    config: PriorConfig,
    settings: AdjustmentSettings,
) -> ScanAdjustment:
    """Adjust the scan's poses, and restore the scan's lengths; not cross-validated."""
    start, prior = scene_rig(scan, S_scene_world), pose_prior(scan, S_scene_world, config)
    begin = constrained(refine, start)
    found: Adjustment = adjust(begin, maps, prior, refine, settings)
    # a frame whose starting pose proved to be wrong must not turn or stretch the scene
    wrong = (found.start.T_world_camera != begin.T_world_camera).flatten(1).any(1)
    cameras = torch.where(wrong[:, None, None], found.start.T_world_camera, start.T_world_camera)
    start = replace(start, T_world_camera=cameras)
    rig = restore(start, found.rig, _scale(scan, S_scene_world, refine, start, found.rig, prior))
    motion = _motion(found.rig, rig)
    factor = torch.from_numpy(JointCovariance(found.factor.numpy()).mapped(motion).factor)
    known = known_length(scan, S_scene_world, refine, rig, prior)
    return ScanAdjustment(
        rig, found.sigma, with_known_length(factor, rig, known), found.noise_px, found.intrinsics, found.unplaced,
        modes=tuple(mode.turned(motion.R) for mode in found.modes),
    )  # fmt: skip


def _motion(before: Rig, after: Rig) -> Similarity:
    """The similarity that `restore` moved a rig by."""
    scale = float(after.baseline[0] / before.baseline[0])
    T = after.T_world_camera[0] @ inverse(before.scaled(scale).T_world_camera[0])
    return Similarity(scale, T[:3, :3].numpy(), T[:3, 3].numpy())


def _scale(scan: Scan, S_scene_world: Similarity, refine: RefinePoses, start: Rig, rig: Rig, prior: PosePrior) -> float:
    """The factor that restores the scan's lengths in the adjusted rig; a known rig keeps its baselines."""
    known = scan.scale
    if known.baseline_of is not None:
        return baseline_scale(start, rig, scan.index_of(known.baseline_of))
    if not known.known or refine == "known-rig":
        return baseline_scale(start, rig, None)
    if known.bar is not None:
        poses = DevicePoses(rig.T_world_camera.numpy(), rig.T_world_projector.numpy())
        return known.bar.length * S_scene_world.scale / measured_length(scan, known.bar, poses)
    return agreeing_scale(start, rig, prior)


def at_known_length(
    scan: Scan,
    S_scene_world: Similarity,
    refine: RefinePoses,
    config: PriorConfig,
    rig: Rig,
    factor: Float[Tensor, "joint k"],
) -> tuple[float, Float[Tensor, "joint k"]]:
    """The factor that restores the scan's lengths in a rig that was adjusted before they were known.

    And a factor of the covariance under which the known length does not err, instead of the one known before.
    """
    prior = pose_prior(scan, S_scene_world, config)
    growth = _scale(scan, S_scene_world, refine, scene_rig(scan, S_scene_world), rig, prior)
    return growth, with_known_length(factor, rig, known_length(scan, S_scene_world, refine, rig, prior))


def known_length(
    scan: Scan, S_scene_world: Similarity, refine: RefinePoses, rig: Rig, prior: PosePrior
) -> Float[Tensor, "unknowns"]:
    """Derivative, by (delta, rho), of the logarithm of the length at which the scan's scale is held."""
    known = scan.scale
    if known.baseline_of is not None:
        return of_baselines(rig, scan.index_of(known.baseline_of))
    if not known.known or refine == "known-rig":
        return of_baselines(rig, None)
    if known.bar is None:
        return of_all_lengths(rig, prior)
    bar, columns = known.bar, torch.eye(12 * rig.frames, dtype=torch.float64)

    def log_length(step: Float[Tensor, "unknowns"]) -> float:
        poses = rig.moved(*step.reshape(2, rig.frames, 6)).poses(S_scene_world.inverse())
        return float(np.log(measured_length(scan, bar, poses)))

    out = torch.zeros(12 * rig.frames, dtype=torch.float64)
    for frame in {scan.index_of(pixel.frame) for pixel in bar.ends}:
        for first in (6 * frame, 6 * (rig.frames + frame)):
            for k in range(first, first + 6):
                out[k] = (log_length(_STEP * columns[k]) - log_length(-_STEP * columns[k])) / (2 * _STEP)
    return out


@one_library_thread()
def maps_and_held_out(scan: Scan, samples: PixelSamples) -> tuple[CoordinateMaps, HeldOutPixels]:
    """Coordinate images without the held-out pixels, and a selection of the held-out pixels."""
    frames, uv_camera, uv_projector, blocks = [], [], [], []
    for number, frame in enumerate(scan.frames):
        test = samples.held_out_of(number, HELD_OUT_PER_FRAME)
        decoded = test.decoded
        frames.append(test.frame[decoded])
        uv_camera.append(test.uv[decoded].double())
        uv_projector.append(test.coords[decoded].double())
        per_row = frame.camera.w // BLOCK + 1
        blocks.append((test.row // BLOCK * per_row + test.column // BLOCK)[decoded])
    most = max(frame.camera.w * frame.camera.h for frame in scan.frames)
    frame_of = torch.cat(frames)
    held_out = HeldOutPixels(
        frame_of, torch.cat(uv_camera), torch.cat(uv_projector), frame_of * most + torch.cat(blocks)
    )
    images = (_training_coords(frame.camera, own) for frame, own in zip(scan.frames, samples.in_order(), strict=True))
    return CoordinateMaps.of(images), held_out


def _training_coords(camera: Device, pixels: PixelBatch) -> Float[Tensor, "h w 2"]:
    """The coordinate image of a frame without its held-out pixels."""
    image, used = torch.full((camera.h, camera.w, 2), float("nan")), ~pixels.held_out
    image[pixels.row[used], pixels.column[used]] = pixels.coords[used]
    return image


def sigmas_in_scan_units(sigma: Float[Tensor, "frames 12"], S_scene_world: Similarity) -> Float[ndarray, "frames 4"]:
    """RMS per axis: frame translation (scan units), frame rotation (degrees), the same for the relative pose."""
    return frame_sigmas(sigma, 1 / S_scene_world.scale)
