"""The seven degrees of freedom that no measurement fixes: position and orientation of the world, and its scale.

After an adjustment the whole scene is moved by one similarity, which changes no residual. The scale is set to its known
value (from a baseline, or from all lengths of the starting poses), else to the geometric mean of the baselines.
Position and orientation are set to the best agreement with the starting poses, in least squares.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.priors import PosePrior, prior_equations
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.unknowns import by_frame
from sl_nerfstudio.geometry.se3 import hat, pose, rotate
from sl_nerfstudio.geometry.similarity import Similarity, fit_similarity

_MOST_STEPS, _CONVERGED = 50, 1e-12  # of the logarithm of the scale


def baseline_scale(start: Rig, rig: Rig, frame: int | None) -> float:
    """The factor that gives `rig` the baseline that `frame` has in `start`; for None, the geometric mean of all."""
    log_ratio = torch.log(start.baseline / rig.baseline)
    return float(torch.exp(log_ratio.mean() if frame is None else log_ratio[frame]))


def agreeing_scale(start: Rig, rig: Rig, prior: PosePrior) -> float:
    """The factor for which all lengths of `rig`, between frames and within them, agree best with the starting poses.

    It maximises the prior over similarities. A small rotation of the projectors against their cameras looks like a
    longer baseline (by distance^2 / baseline: at 270 mm and 26 mm, 0.1 degree is 2 %). If the positions of the frames
    are known, too, they determine the scale better.
    """
    scale = baseline_scale(start, rig, None)
    for _ in range(_MOST_STEPS):
        now = restore(start, rig, scale)
        H, g = prior_equations(prior, start, now)
        G = by_frame(gauge_directions(now))
        information, gradient = (G.transpose(1, 2) @ H @ G).sum(0), (G.transpose(1, 2) @ g[..., None]).sum(0)[:, 0]
        step = float(torch.linalg.solve(information, -gradient)[6])
        scale *= math.exp(step)
        if abs(step) < _CONVERGED:
            break
    return scale


def restore(start: Rig, rig: Rig, scale: float) -> Rig:
    """The adjusted rig, `scale` times as large, aligned with the position and orientation of the start."""
    S, scaled = alignment(start, rig, scale), rig.scaled(scale)
    T = pose(torch.from_numpy(S.R), torch.from_numpy(S.t))
    return Rig(rig.camera, rig.projector, T @ scaled.T_world_camera, scaled.T_camera_projector)


def alignment(start: Rig, rig: Rig, scale: float) -> Similarity:
    """The motion that aligns the rig, after it is made `scale` times as large, with the cameras of the start."""
    ahead = start.T_world_camera[:, :3, 3].norm(dim=-1, keepdim=True)
    points = _axes_points(rig.scaled(scale), ahead).numpy(), _axes_points(start, ahead).numpy()
    return fit_similarity(*points, with_scale=False)


def gauge_directions(rig: Rig) -> Float[Tensor, "unknowns 7"]:
    """Increments (delta, rho) that move the whole scene by a similarity and change no residual."""
    n = rig.frames
    out = torch.zeros(2, n, 6, 7, dtype=torch.float64)
    out[0, :, :, :6] = torch.eye(6, dtype=torch.float64)
    out[0, :, :3, 6] = rig.T_world_camera[:, :3, 3]
    out[1, :, :3, 6] = rig.T_camera_projector[:, :3, 3]
    return out.reshape(12 * n, 7)


def of_baselines(rig: Rig, frame: int | None) -> Float[Tensor, "unknowns"]:
    """Derivative of the logarithm of one frame's baseline; for None, of the geometric mean of all."""
    n, t = rig.frames, rig.T_camera_projector[:, :3, 3]
    each = t / (t * t).sum(-1, keepdim=True)
    out = torch.zeros(2, n, 6, dtype=torch.float64)
    if frame is None:
        out[1, :, :3] = each / n
    else:
        out[1, frame, :3] = each[frame]
    return out.reshape(12 * n)


def gauge_projection(rig: Rig, frame: int | None = None) -> Float[Tensor, "unknowns unknowns"]:
    """Projection of increments (delta, rho) onto those that `restore` leaves: no motion and no growth as a whole.

    The length that is known is the baseline of `frame`, or for None the geometric mean of all baselines. (An
    S-transformation: Baarda 1973.)
    """
    n, G = rig.frames, gauge_directions(rig)
    fixed = torch.zeros(7, 12 * n, dtype=torch.float64)
    ahead = rig.T_world_camera[:, :3, 3].norm(dim=-1, keepdim=True)
    points = _axes_points(rig, ahead).reshape(2, n, 3)
    J = torch.cat([torch.eye(3, dtype=torch.float64).expand(2, n, 3, 3), -hat(points)], -1)
    fixed[:6, : 6 * n] = (J.transpose(-1, -2) @ J).sum(0).transpose(0, 1).reshape(6, 6 * n)
    fixed[6] = of_baselines(rig, frame)
    return torch.eye(12 * n, dtype=torch.float64) - G @ torch.linalg.solve(fixed @ G, fixed)


def _axes_points(rig: Rig, distance: Float[Tensor, "frames 1"]) -> Float[Tensor, "n 3"]:
    """Camera centres, and for each the point `distance` in front of it, near the scene's centre.

    Points near the scene count as much as the distant cameras, so rotating one camera has an effect, too.
    """
    T = rig.T_world_camera
    centre = T[:, :3, 3]
    axis = rotate(T, torch.tensor([0.0, 0.0, -1.0], dtype=T.dtype).expand(len(T), 3))
    return torch.cat([centre, centre + distance * axis])
