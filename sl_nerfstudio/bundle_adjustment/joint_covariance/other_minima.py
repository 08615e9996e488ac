"""Other poses that agree with the captures as well: where nothing holds a frame, the objective has many minima.

On a surface that slides along itself (a vase about its axis, parallel planes) errors of the look-ups make small
minima wherever a frame may be, and the curvature of one of them says little about how far the others are. Whether a
result is one of many shows when it is shaken: steps lead it back, or they do not. If they do not, searches from other
starting poses, drawn within their stated uncertainty, show how far the minima spread. (Randomised maximum likelihood:
Chen and Oliver, Mathematical Geosciences, 2012; the data stay as they are.)
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.gauge import baseline_scale, gauge_directions, restore
from sl_nerfstudio.bundle_adjustment.priors import PosePrior
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.self_calibration import UNKNOWNS
from sl_nerfstudio.geometry.se3 import exp_se3, exp_so3, inverse, log_se3


def shake(factor: Float[Tensor, "joint k"], sigmas: float, generator: torch.Generator) -> Float[Tensor, "unknowns"]:
    """A random increment (delta, rho) of some sigmas of the poses, the intrinsics staying as they are."""
    variance, axes = torch.linalg.eigh(_given_intrinsics(factor))
    draw = torch.randn(len(variance), generator=generator, dtype=torch.float64)
    return axes @ (sigmas * variance.clamp_min(0).sqrt() * draw)


def farthest_frame(factor: Float[Tensor, "joint k"], departure: Float[Tensor, "unknowns"]) -> float:
    """Increment of the frame that departs most, in sigma of the poses given the intrinsics (RMS over its six)."""
    sigma = _given_intrinsics(factor).diagonal().clamp_min(0).sqrt()
    ratio = torch.where(sigma > 0, departure / sigma, torch.zeros_like(sigma))
    return float(ratio[: len(ratio) // 2].reshape(-1, 6).pow(2).mean(1).max().sqrt())


def departure_of(other: Rig, rig: Rig) -> Float[Tensor, "unknowns"]:
    """Increments (delta, rho) from `rig` to `other`, without motion and growth of the scene as a whole."""
    there = restore(rig, other, baseline_scale(rig, other, None))
    pairs = (
        (there.T_world_camera, rig.T_world_camera),
        (there.T_camera_projector, rig.T_camera_projector),
    )
    step = torch.cat([log_se3(theirs @ inverse(mine)).reshape(-1) for theirs, mine in pairs])
    G = gauge_directions(rig)
    return step - G @ torch.linalg.solve(G.T @ G, G.T @ step)


def with_frames_of(rig: Rig, other: Rig, frames: Sequence[int]) -> Rig:
    """The rig with some frames where another has them."""
    chosen = list(frames)
    camera, relative = rig.T_world_camera.clone(), rig.T_camera_projector.clone()
    camera[chosen], relative[chosen] = other.T_world_camera[chosen], other.T_camera_projector[chosen]
    return replace(rig, T_world_camera=camera, T_camera_projector=relative)


def drawn_start(rig: Rig, prior: PosePrior, with_projectors: bool, generator: torch.Generator) -> Rig:
    """Starting poses as uncertain as the stated ones, about `rig`; projectors stay in their frames, or move as well."""
    draw = torch.randn(rig.frames, 12, generator=generator, dtype=torch.float64) * prior.sigma
    frames = replace(rig, T_world_camera=exp_se3(draw[:, :6]) @ rig.T_world_camera)
    if not with_projectors:
        return frames
    T = rig.T_camera_projector.clone()
    T[:, :3, :3] = exp_so3(draw[:, 9:]) @ T[:, :3, :3]
    T[:, :3, 3] += draw[:, 6:9]
    return replace(frames, T_camera_projector=T)


def widened(
    factor: Float[Tensor, "joint k"], departures: Sequence[Float[Tensor, "unknowns"]]
) -> Float[Tensor, "joint more"]:
    """The covariance with the mean square of what other searches found, none of them better than the others."""
    columns = [torch.nn.functional.pad(d / len(departures) ** 0.5, (0, UNKNOWNS)) for d in departures]
    return torch.cat([factor, *(column[:, None] for column in columns)], 1)


def _given_intrinsics(factor: Float[Tensor, "joint k"]) -> Float[Tensor, "unknowns unknowns"]:
    """Covariance of the poses if the intrinsics are right."""
    poses, common = factor[:-UNKNOWNS], factor[-UNKNOWNS:]
    scale = common.norm(dim=1).clamp_min(1e-15)
    common = common / scale[:, None]
    inner = torch.linalg.pinv(common @ common.T, hermitian=True)
    border = poses @ common.T
    return poses @ poses.T - border @ inner @ border.T
