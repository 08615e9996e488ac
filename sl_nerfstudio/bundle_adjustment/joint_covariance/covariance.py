"""The covariance of all poses and of the intrinsics together, in any axes and unit.

Increments are those of `residuals`: `T_world_camera <- exp(delta) T_world_camera`,
`T_camera_projector <- exp(rho) T_camera_projector`, translation before rotation. Intrinsics are shares of the focal
length, in the order of `IntrinsicsChange.values`.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.joint_covariance.draws import unit_columns
from sl_nerfstudio.bundle_adjustment.priors import PosePrior, prior_equations
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.self_calibration import UNKNOWNS
from sl_nerfstudio.bundle_adjustment.unknowns import by_kind
from sl_nerfstudio.geometry.similarity import Similarity


@dataclass(frozen=True)
class JointCovariance:
    """Second moments of the errors of delta of all frames, then rho of all frames, then the intrinsics.

    They are `factor @ factor.T`. Of scans with more than 106 frames the columns are random draws (`draws`).
    """

    factor: Float64[ndarray, "joint k"]

    @property
    def matrix(self) -> Float64[ndarray, "joint joint"]:
        """The covariance itself, which takes much memory for many frames."""
        return self.factor @ self.factor.T

    @property
    def frames(self) -> int:
        """Number of frames."""
        return (len(self.factor) - UNKNOWNS) // 12

    def mapped(self, S_target_world: Similarity) -> "JointCovariance":
        """For the same devices in other axes and another unit.

        A motion (v, w) in the world is, in the target, the rotation R w and the translation s R v - (R w) x t; in the
        axes of a camera only the unit changes.
        """
        s, R, t = S_target_world.scale, S_target_world.R, S_target_world.t
        cross = np.cross(np.eye(3), t).T  # cross @ w = w x t
        frame = np.block([[s * R, -cross @ R], [np.zeros((3, 3)), R]])
        relative = np.diag([s] * 3 + [1.0] * 3)
        half, out = 6 * self.frames, self.factor.copy()
        for first, J in ((0, frame), (half, relative)):
            part = self.factor[first : first + half]
            out[first : first + half] = (J @ part.reshape(-1, 6, part.shape[1])).reshape(half, -1)
        return JointCovariance(out)


def joint_of_prior(prior: PosePrior, start: Rig) -> Float[Tensor, "joint k"]:
    """A factor of the covariance before any residual is computed."""
    H, _ = prior_equations(prior, start, start)
    rows = 12 * start.frames + UNKNOWNS
    unit = unit_columns(rows, rows)
    upper = torch.linalg.cholesky(H).mT
    frames = torch.linalg.solve_triangular(upper, unit[:-UNKNOWNS].reshape(start.frames, 12, -1), upper=True)
    return torch.cat([by_kind(frames), prior.intrinsics_sigma[:, None] * unit[-UNKNOWNS:]])
