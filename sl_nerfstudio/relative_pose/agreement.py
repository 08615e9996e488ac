"""Which coordinates of a frame agree with its relative pose, also between the pixels that the pose was found from."""

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.estimation import RelativePose, agree
from sl_nerfstudio.relative_pose.pattern_blocks import block_numbers, blocks_of
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of, lattice_step, ray_pairs
from sl_nerfstudio.relative_pose.sampson import sampson
from sl_nerfstudio.relative_pose.settings import RELATIVE_POSE_DEFAULTS, RelativePoseSettings


def agreeing_coords(
    coords: Float32[ndarray, "h w 2"],
    camera: Device,
    projector: Device,
    pose: RelativePose,
    settings: RelativePoseSettings = RELATIVE_POSE_DEFAULTS,
) -> Float32[ndarray, "h w 2"]:
    """The coordinates without those that contradict the pose, which become NaN.

    `pose.inliers` are those of `correspondences_of(coords)`. Pixels between them are judged by the same rule, with the
    noise in their square of the pattern; if all of `pose.inliers` agree, these do.
    """
    known, step = np.isfinite(coords).all(-1), lattice_step(*coords.shape[:2])
    agrees = known.copy()
    if step > 1 and not pose.inliers.all():
        noise_px = _noise_by_block(coords, projector, pose, settings)
        for first in range(0, len(coords), settings.lattice.rows):
            rows = slice(first, first + settings.lattice.rows)
            agrees[rows] = _agree(coords[rows], first, camera, projector, pose, noise_px, settings)
    agrees[::step, ::step][known[::step, ::step]] = pose.inliers
    return np.where(agrees[..., None], coords, np.float32(np.nan))


def _noise_by_block(
    coords: Float32[ndarray, "h w 2"], projector: Device, pose: RelativePose, settings: RelativePoseSettings
) -> Float64[ndarray, "blocks"]:
    """Noise in each square of the pattern; that of the whole frame where the pose was found from nothing there."""
    block = blocks_of(correspondences_of(coords)[1], projector, settings.blocks)
    measured = np.isfinite(pose.noise_px)
    noise_px = np.full(block_numbers(settings.blocks), pose.residual_px)
    noise_px[block[measured]] = pose.noise_px[measured]
    return noise_px


def _agree(
    coords: Float32[ndarray, "h w 2"],
    first_row: int,
    camera: Device,
    projector: Device,
    pose: RelativePose,
    noise_px: Float64[ndarray, "blocks"],
    settings: RelativePoseSettings,
) -> Bool[ndarray, "h w"]:
    """Which pixels of some rows of an image agree."""
    row, column = np.nonzero(np.isfinite(coords).all(-1))
    uv_camera = np.stack([column, row + first_row], -1) + 0.5
    rays, usable = ray_pairs(uv_camera, coords[row, column].astype(np.float64), camera, projector, settings.blocks)
    R, t = pose.T_camera_projector[:3, :3], pose.T_camera_projector[:3, 3]
    good = usable[agree(R, t, rays, sampson(R, t, rays), noise_px[rays.block], settings)]
    out = np.zeros(coords.shape[:2], dtype=bool)
    out[row[good], column[good]] = True
    return out
