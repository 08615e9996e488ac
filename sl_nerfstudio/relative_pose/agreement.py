"""Which coordinates of a frame agree with its relative pose, also between the pixels that the pose was found from."""

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.estimation import RelativePose
from sl_nerfstudio.relative_pose.five_point import in_front
from sl_nerfstudio.relative_pose.pattern_blocks import blocks_of
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
    agrees = np.isfinite(coords).all(-1)
    uv_camera, uv_projector = correspondences_of(coords)
    if lattice_step(*coords.shape[:2]) > 1 and not pose.inliers.all():
        block = blocks_of(uv_projector, projector, settings.blocks)
        noise_px = np.full((5 * settings.blocks.along_longer_side) ** 2, pose.residual_px)
        known = np.isfinite(pose.noise_px)
        noise_px[block[known]] = pose.noise_px[known]
        for first in range(0, len(coords), settings.lattice.rows):
            rows = slice(first, first + settings.lattice.rows)
            agrees[rows] = _agree(coords[rows], first, camera, projector, pose, noise_px, settings)
    column, row = np.floor(uv_camera).astype(np.int64).T
    agrees[row, column] = pose.inliers
    return np.where(agrees[..., None], coords, np.float32(np.nan))


def _agree(
    coords: Float32[ndarray, "h w 2"],
    first_row: int,
    camera: Device,
    projector: Device,
    pose: RelativePose,
    noise_px: ndarray,
    settings: RelativePoseSettings,
) -> Bool[ndarray, "h w"]:
    """As in the estimation of the pose, for some rows of an image; `noise_px` is that of each square of the pattern."""
    row, column = np.nonzero(np.isfinite(coords).all(-1))
    uv_camera = np.stack([column, row + first_row], -1) + 0.5
    rays, usable = ray_pairs(uv_camera, coords[row, column].astype(np.float64), camera, projector, settings.blocks)
    R, t = pose.T_camera_projector[:3, :3], pose.T_camera_projector[:3, 3]
    good = (np.abs(sampson(R, t, rays)) < settings.inlier_sigmas * noise_px[rays.block]) & in_front(R, t, rays)
    out = np.zeros(coords.shape[:2], dtype=bool)
    out[row[usable[good]], column[usable[good]]] = True
    return out
