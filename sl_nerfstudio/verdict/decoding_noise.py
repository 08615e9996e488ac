"""The decoding noise of every frame, measured so that an error of its pose does not count as noise."""

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA, geman_mcclure_weight

_ROUNDS = 4  # of reweighted least squares
_FEWEST = 20  # points from which a noise can be measured: three for each of the six unknowns


def frame_noise(linear: Linearisation, anchors: Anchors, frames: int) -> Float[Tensor, "frames"]:
    """Robust 1 sigma of each frame's epipolar residuals after the best small change of its relative pose.

    Pattern pixels, NaN for frames with few points. A wrong relative pose makes residuals that change smoothly over the
    image, and a first-order change of the pose explains these. What is left is the noise of look-ups.
    """
    along = torch.nn.functional.normalize(linear.own_depth, dim=-1)
    across = torch.stack([-along[:, 1], along[:, 0]], -1)
    residual = (across * linear.residuals.own).sum(-1)
    columns = (across[:, :, None] * linear.own).sum(1)
    out = torch.full((frames,), float("nan"), dtype=torch.float64)
    for k in range(frames):
        mine = anchors.frame == k
        if int(mine.sum()) >= _FEWEST:
            out[k] = _remaining_sigma(residual[mine], columns[mine])
    return out


def _remaining_sigma(r: Float[Tensor, "n"], J: Float[Tensor, "n 6"]) -> float:
    """Robust sigma of `r` less the combination of columns that fits it best."""
    J = J / J.norm(dim=0).clamp_min(1e-300)  # translations and rotations have different units
    left, sigma = r, _sigma(r)
    for _ in range(_ROUNDS):
        if sigma == 0:
            break
        w = geman_mcclure_weight((left / (3 * sigma)) ** 2).sqrt()
        # The length of the baseline changes no epipolar line, so one direction is free: the shortest solution.
        x = torch.linalg.lstsq(w[:, None] * J, (w * r)[:, None], rcond=1e-8, driver="gelsd").solution[:, 0]
        left = r - J @ x
        sigma = _sigma(left)
    return sigma


def _sigma(values: Float[Tensor, "n"]) -> float:
    return MAD_TO_SIGMA * float(values.abs().median())
