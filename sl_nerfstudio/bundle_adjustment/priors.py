"""What is known of the poses before any residual is looked at."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.geometry.devices import UNCHANGED, IntrinsicsChange
from sl_nerfstudio.geometry.se3 import hat, inverse, log_se3, log_so3

INTRINSICS_SIGMA = 0.005  # where nobody says how well the intrinsics are known
_INDEPENDENT_ROWS = 50  # of a frame, while residuals come from wrong poses rather than from noise


@dataclass(frozen=True)
class PosePrior:
    """How well starting poses and intrinsics are known: 1 sigma; lengths in the scene's unit, angles in radian."""

    frame_translation: Float[Tensor, "frames"]
    frame_rotation: Float[Tensor, "frames"]
    relative_translation: Float[Tensor, "frames"]
    relative_rotation: Float[Tensor, "frames"]
    intrinsics: float = INTRINSICS_SIGMA  # focal lengths and principal points, as a share of the focal length
    intrinsics_change: IntrinsicsChange = UNCHANGED  # how far the devices are from what was stated of them


def prior_equations(
    prior: PosePrior, start: Rig, rig: Rig
) -> tuple[Float[Tensor, "unknowns unknowns"], Float[Tensor, "unknowns"]]:
    """Information matrix and gradient of the departure from the starting poses."""
    n = rig.frames
    delta = log_se3(rig.T_world_camera @ inverse(start.T_world_camera))
    weight = torch.cat([(1 / s**2)[:, None].expand(n, 3) for s in (prior.frame_translation, prior.frame_rotation)], 1)
    # relative: position and rotation of the projector in camera axes
    t = rig.T_camera_projector[:, :3, 3]
    e = torch.cat(
        [
            t - start.T_camera_projector[:, :3, 3],
            log_so3(rig.T_camera_projector[:, :3, :3] @ start.T_camera_projector[:, :3, :3].transpose(1, 2)),
        ],
        1,
    )
    eye = torch.eye(3, dtype=torch.float64).expand(n, 3, 3)
    J = torch.cat([torch.cat([eye, -hat(t)], -1), torch.cat([torch.zeros_like(eye), eye], -1)], -2)
    w_relative = torch.cat(
        [(1 / s**2)[:, None].expand(n, 3) for s in (prior.relative_translation, prior.relative_rotation)], 1
    )
    JtW = J.transpose(1, 2) * w_relative[:, None, :]
    H = torch.zeros(12 * n, 12 * n, dtype=torch.float64)
    H[: 6 * n, : 6 * n] = torch.diag(weight.reshape(-1))
    H[6 * n :, 6 * n :] = torch.block_diag(*(JtW @ J))
    return H, torch.cat([(weight * delta).reshape(-1), (JtW @ e[..., None]).reshape(-1)])


def rough_trust(noise: float, rows: float) -> float:
    """Weight of the prior beside `rows` residuals of a frame while those are made by wrong poses, and err together."""
    return noise**2 * max(rows / _INDEPENDENT_ROWS, 1.0)
