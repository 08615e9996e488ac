"""Which parameters are free while poses are refined."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.se3 import adjoint, inverse, pose

RefinePoses = Literal["free", "rigid-rig", "known-rig", "static-projector", "off"]


@dataclass(frozen=True)
class FreeParameters:
    """A basis of the increments (delta, rho) that are free: of each frame its own, and some that all frames share.

    Parameters are ordered frame by frame, the shared ones last.
    """

    of: int  # number of all frames
    frames: Int[Tensor, "m"]  # those that move
    own: Float[Tensor, "m 12 k"]  # each one's increments by its own parameters; with k = 12, the identity
    shared: Float[Tensor, "m 12 s"]

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.own.shape[0] * self.own.shape[2] + self.shared.shape[2]

    def step(self, x: Float[Tensor, "count"]) -> Float[Tensor, "of 12"]:
        """Increments of all frames."""
        return self.steps(x[:, None])[..., 0]

    def steps(self, x: Float[Tensor, "count c"]) -> Float[Tensor, "of 12 c"]:
        """Increments of all frames, for several sets of parameters at once."""
        m, _, k = self.own.shape
        out = torch.zeros(self.of, 12, x.shape[1], dtype=x.dtype)
        mine = x[: m * k].reshape(m, k, x.shape[1])
        if k != 12:
            mine = self.own @ mine
        if self.shared.shape[2]:
            mine = mine + self.shared @ x[m * k :]
        out[self.frames] = mine
        return out

    def vector(self, g: Float[Tensor, "m 12 *c"]) -> Float[Tensor, "count *c"]:
        """A gradient by the increments of the frames that move, as one by the parameters."""
        columns = g.reshape(*g.shape[:2], -1)
        mine = columns if self.own.shape[2] == 12 else self.own.transpose(1, 2) @ columns
        shared = (self.shared.transpose(1, 2) @ columns).sum(0)
        return torch.cat([mine.flatten(0, 1), shared]).reshape(self.count, *g.shape[2:])

    def matrix(self, H: Float[Tensor, "unknowns unknowns"]) -> Float[Tensor, "parameters parameters"]:
        """The same for both sides of a normal matrix; unknowns after those of the frames stay. It may be `H` itself."""
        if self.own.shape[2] == 12 and not self.shared.shape[2]:
            return H
        return self._rows(self._rows(H).T)

    def _rows(self, H: Float[Tensor, "unknowns c"]) -> Float[Tensor, "parameters c"]:
        m = len(self.own)
        return torch.cat([self.vector(H[: 12 * m].reshape(m, 12, -1)), H[12 * m :]])


def free_parameters(refine: RefinePoses, rig: Rig) -> FreeParameters:
    """What a choice leaves free at a rig."""
    n = rig.frames
    eye = torch.eye(12, dtype=torch.float64).expand(n, 12, 12)
    own, shared = eye[..., :6], eye[..., :0]
    if refine == "free":
        own = eye
    elif refine == "rigid-rig":
        shared = eye[..., 6:]
    elif refine == "static-projector":
        # T_world_camera exp(rho) = exp(-delta) T_world_camera: the projector stays, the camera moves
        own = torch.cat([eye[:, :6, :6], -adjoint(inverse(rig.T_world_camera))], 1)
    elif refine == "off":
        own = eye[..., :0]
    return FreeParameters(n, torch.arange(n), own, shared)


def of_one_frame(frame: int, frames: int, with_projector: bool) -> FreeParameters:
    """One of all frames as a whole, and on request its projector against its camera."""
    own = torch.eye(12, dtype=torch.float64)[None, :, : 12 if with_projector else 6]
    return FreeParameters(frames, torch.tensor([frame]), own, own[..., :0])


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
