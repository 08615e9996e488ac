"""The covariance of all poses and of the intrinsics together, in any axes and unit.

Increments are those of `residuals`: `T_world_camera <- exp(delta) T_world_camera`,
`T_camera_projector <- exp(rho) T_camera_projector`, translation before rotation. Intrinsics are shares of the focal
length, in the order of `IntrinsicsChange.values`.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.priors import PosePrior, prior_covariance
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.self_calibration import UNKNOWNS
from sl_nerfstudio.geometry.similarity import Similarity


@dataclass(frozen=True)
class JointCovariance:
    """Second moments of the errors of delta of all frames, then rho of all frames, then the intrinsics."""

    matrix: Float64[ndarray, "joint joint"]

    @property
    def frames(self) -> int:
        """Number of frames."""
        return (len(self.matrix) - UNKNOWNS) // 12

    def mapped(self, S_target_world: Similarity) -> "JointCovariance":
        """For the same devices in other axes and another unit.

        A motion (v, w) in the world is, in the target, the rotation R w and the translation s R v - (R w) x t; in the
        axes of a camera only the unit changes.
        """
        s, R, t = S_target_world.scale, S_target_world.R, S_target_world.t
        cross = np.cross(np.eye(3), t).T  # cross @ w = w x t
        frame = np.block([[s * R, -cross @ R], [np.zeros((3, 3)), R]])
        relative = np.diag([s] * 3 + [1.0] * 3)
        once = _rows_mapped(self.matrix, frame, relative)
        return JointCovariance(_rows_mapped(once.T, frame, relative))


def _rows_mapped(
    matrix: Float64[ndarray, "joint k"], frame: Float64[ndarray, "6 6"], relative: Float64[ndarray, "6 6"]
) -> Float64[ndarray, "joint k"]:
    """Every frame's rows under one linear map of its delta and one of its rho."""
    half = (len(matrix) - UNKNOWNS) // 2
    out = matrix.copy()
    for first, J in ((0, frame), (half, relative)):
        part = slice(first, first + half)
        out[part] = (J @ matrix[part].reshape(-1, 6, matrix.shape[1])).reshape(half, -1)
    return out


def joint_of_prior(prior: PosePrior, start: Rig) -> Float[Tensor, "joint joint"]:
    """The covariance before any residual is computed."""
    return torch.block_diag(prior_covariance(prior, start), (prior.intrinsics_sigma**2).diag())


def packed(joint: Float[Tensor, "joint joint"]) -> Float[Tensor, "entries"]:
    """The lower triangle, row by row: half of the memory."""
    return joint[_lower(len(joint))]


def unpacked(entries: Float[Tensor, "entries"]) -> Float[Tensor, "joint joint"]:
    """The matrix of which `packed` gave the lower triangle."""
    size = round(((8 * len(entries) + 1) ** 0.5 - 1) / 2)
    out = entries.new_zeros(size, size)
    out[_lower(size)] = entries
    return out + out.tril(-1).T


def _lower(size: int) -> Bool[Tensor, "joint joint"]:
    return torch.ones(size, size, dtype=torch.bool).tril()
