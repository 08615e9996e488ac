"""Which parameters are free while poses are refined."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.se3 import adjoint, inverse, pose

RefinePoses = Literal["free", "rigid-rig", "known-rig", "static-projector", "off"]


def free_parameters(refine: RefinePoses, rig: Rig) -> Float[Tensor, "unknowns k"]:
    """A basis (in columns) of the increments (delta, rho) of all frames that a choice leaves free at a rig."""
    n, eye = rig.frames, torch.eye(6 * rig.frames, dtype=torch.float64)
    zero = torch.zeros_like(eye)
    delta = torch.cat([eye, zero])
    if refine == "free":
        return torch.cat([delta, torch.cat([zero, eye])], 1)
    if refine == "rigid-rig":
        shared = torch.eye(6, dtype=torch.float64).repeat(n, 1)
        return torch.cat([delta, torch.cat([torch.zeros_like(shared), shared])], 1)
    if refine == "known-rig":
        return delta
    if refine == "static-projector":
        # T_world_camera exp(rho) = exp(-delta) T_world_camera: the projector stays, the camera moves
        counter = -torch.block_diag(*adjoint(inverse(rig.T_world_camera)))
        return torch.cat([eye, counter])
    return delta[:, :0]


def constrained(refine: RefinePoses, rig: Rig) -> Rig:
    """A starting rig that satisfies a choice: a pose that all frames share is replaced by its mean over the frames."""
    if refine == "rigid-rig":
        mean = mean_pose(rig.T_camera_projector)
        return Rig(rig.camera, rig.projector, rig.T_world_camera, mean.expand_as(rig.T_camera_projector).clone())
    if refine == "static-projector":
        # relative poses come from each frame's own coordinates: they are better known than the frames' world poses
        camera = mean_pose(rig.T_world_projector) @ inverse(rig.T_camera_projector)
        return Rig(rig.camera, rig.projector, camera, rig.T_camera_projector)
    return rig


def mean_pose(T: Float[Tensor, "n 4 4"]) -> Float[Tensor, "4 4"]:
    """The chordal mean of rotations with the mean of translations."""
    U, _, Vt = torch.linalg.svd(T[:, :3, :3].mean(0))
    sign = torch.tensor([1.0, 1.0, float(torch.det(U @ Vt).sign())], dtype=T.dtype)
    return pose((U * sign) @ Vt, T[:, :3, 3].mean(0))
