"""The seven degrees of freedom no measurement fixes: where the world is, and how long a unit is.

After an adjustment the whole scene is moved by one similarity, which changes no residual: the scale
goes back to what is known (one frame's baseline) or to the geometric mean of all baselines, position
and orientation to the least-squares agreement with the starting poses.
"""

import re

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.calibration.linearisation import Rig
from sl_nerfstudio.geometry.se3 import pose, rotate
from sl_nerfstudio.geometry.similarity import fit_similarity


def baselines(rig: Rig) -> Float[Tensor, "frames"]:
    """Distance between camera and projector of every frame."""
    return rig.T_camera_projector[:, :3, 3].norm(dim=-1)


def known_baseline(source: str, frames: int) -> int | None:
    """The frame whose baseline a scan's `scale.source` names ("baseline of frame 0"), or None."""
    match = re.search(r"baseline of frame (\d+)", source)
    return int(match[1]) if match and int(match[1]) < frames else None


def restore(start: Rig, rig: Rig, known_frame: int | None) -> Rig:
    """The adjusted rig in the gauge of the start; `known_frame`'s baseline (else the geometric mean) is kept."""
    log_ratio = torch.log(baselines(start) / baselines(rig))
    scale = torch.exp(log_ratio.mean() if known_frame is None else log_ratio[known_frame])
    scaled = _scaled(rig, scale)
    ahead = start.T_world_camera[:, :3, 3].norm(dim=-1, keepdim=True)
    S = fit_similarity(_axes_points(scaled, ahead).numpy(), _axes_points(start, ahead).numpy(), with_scale=False)
    T = pose(torch.from_numpy(S.R), torch.from_numpy(S.t))
    return Rig(rig.camera, rig.projector, T @ scaled.T_world_camera, scaled.T_camera_projector)


def _scaled(rig: Rig, scale: Tensor) -> Rig:
    camera, relative = rig.T_world_camera.clone(), rig.T_camera_projector.clone()
    camera[:, :3, 3] *= scale
    relative[:, :3, 3] *= scale
    return Rig(rig.camera, rig.projector, camera, relative)


def _axes_points(rig: Rig, distance: Float[Tensor, "frames 1"]) -> Float[Tensor, "n 3"]:
    """Camera centres, and for each the point `distance` ahead of it, about where it sees the scene's centre.

    Points near the scene count as much as the far-away cameras: turning one camera moves its point, too.
    """
    T = rig.T_world_camera
    centre = T[:, :3, 3]
    axis = rotate(T, torch.tensor([0.0, 0.0, -1.0], dtype=T.dtype).expand(len(T), 3))
    return torch.cat([centre, centre + distance * axis])
