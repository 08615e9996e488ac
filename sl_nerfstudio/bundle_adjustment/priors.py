"""What is known about poses and intrinsics before any residual is computed."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.loops.poses import departures
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.devices import UNCHANGED, IntrinsicsChange
from sl_nerfstudio.geometry.se3 import hat

INTRINSICS_SIGMA = 0.005  # share of the focal length, if the uncertainty of the intrinsics is not stated


@dataclass(frozen=True)
class PosePrior:
    """How well starting poses and intrinsics are known: 1 sigma; lengths in the scene's unit, angles in radian."""

    frame_translation: Float[Tensor, "frames"]
    frame_rotation: Float[Tensor, "frames"]
    relative_translation: Float[Tensor, "frames"]
    relative_rotation: Float[Tensor, "frames"]
    intrinsics: float = INTRINSICS_SIGMA  # focal lengths and principal points, as a share of the focal length
    intrinsics_change: IntrinsicsChange = UNCHANGED  # of the devices, relative to the stated intrinsics
    projector_intrinsics: tuple[float, float, float] | None = None  # focal length, x, y, if known otherwise

    @property
    def intrinsics_sigma(self) -> Float[Tensor, "6"]:
        """1 sigma of the intrinsics, in the order of `IntrinsicsChange.values`."""
        camera = (self.intrinsics,) * 3
        return torch.tensor([*camera, *(self.projector_intrinsics or camera)], dtype=torch.float64)

    @property
    def sigma(self) -> Float[Tensor, "frames 12"]:
        """1 sigma of every frame's delta and rho: translation xyz, rotation xyz each."""
        parts = (self.frame_translation, self.frame_rotation, self.relative_translation, self.relative_rotation)
        return torch.stack(parts, 1).repeat_interleave(3, 1)


@dataclass(frozen=True)
class PriorTerm:
    """The prior's part of the objective: squared differences from the starting poses in units of their sigma.

    `weight` converts it to the unit of the data's part (px^2).
    """

    prior: PosePrior
    start: Rig
    weight: float

    def energy(self, rig: Rig) -> float:
        """The term itself; half its gradient is that of `equations`."""
        return self.weight * float((_departure(self.start, rig) / self.prior.sigma).square().sum())

    def equations(self, rig: Rig) -> tuple[Float[Tensor, "frames 12 12"], Float[Tensor, "frames 12"]]:
        """Information matrix and gradient by the increments (delta, rho) of each frame."""
        H, g = prior_equations(self.prior, self.start, rig)
        return self.weight * H, self.weight * g


def prior_equations(
    prior: PosePrior, start: Rig, rig: Rig
) -> tuple[Float[Tensor, "frames 12 12"], Float[Tensor, "frames 12"]]:
    """Information matrix and gradient of the difference from the starting poses, by (delta, rho) of each frame."""
    n = rig.frames
    weight = 1 / prior.sigma**2
    w_frame, w_relative = weight[:, :6], weight[:, 6:]
    t = rig.T_camera_projector[:, :3, 3]
    eye = torch.eye(3, dtype=torch.float64).expand(n, 3, 3)
    J = torch.cat([torch.cat([eye, -hat(t)], -1), torch.cat([torch.zeros_like(eye), eye], -1)], -2)
    JtW = J.transpose(1, 2) * w_relative[:, None, :]
    H = torch.zeros(n, 12, 12, dtype=torch.float64)
    H[:, :6, :6] = torch.diag_embed(w_frame)
    H[:, 6:, 6:] = JtW @ J
    departure = _departure(start, rig)
    g_relative = (JtW @ departure[:, 6:, None]).squeeze(-1)
    return H, torch.cat([w_frame * departure[:, :6], g_relative], 1)


def _departure(start: Rig, rig: Rig) -> Float[Tensor, "frames 12"]:
    """From the starting poses to the current ones.

    Increment of each frame as a whole, change of its projector's position in camera axes, and its rotation vector.
    """
    pairs = (start.T_world_camera, rig.T_world_camera, start.T_camera_projector, rig.T_camera_projector)
    out = np.empty((rig.frames, 12))
    departures(rig.frames, *(np.ascontiguousarray(T.numpy()) for T in pairs), out)
    return torch.from_numpy(out)


def rough_weight(noise: float, residuals_per_frame: float, independent: float) -> float:
    """Weight of the prior while residuals come from wrong poses rather than from noise.

    The residuals of a frame are then correlated: they count as `independent` measurements, however many there are.
    """
    return noise**2 * max(residuals_per_frame / independent, 1.0)
