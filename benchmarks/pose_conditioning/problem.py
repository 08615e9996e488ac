"""Where the projector lights the true surface, against what was decoded there, and the derivatives by both poses."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.dataparser.dataparser import LoadedScan
from sl_nerfstudio.geometry.devices import (
    Intrinsics,
    project,
    project_jacobian,
    unproject,
)
from sl_nerfstudio.geometry.lie import (
    adjoint,
    exp_se3,
    inverse,
    rotate,
    transform,
)
from sl_nerfstudio.meshing.mesh import Mesh


@dataclass(frozen=True)
class Poses:
    """Poses of all devices in the scene."""

    camera: Float[Tensor, "frames 4 4"]
    projector: Float[Tensor, "frames 4 4"]

    def moved(self, camera: Float[Tensor, "frames 6"], projector: Float[Tensor, "frames 6"]) -> "Poses":
        """After a twist of each device in the scene."""
        return Poses(exp_se3(camera) @ self.camera, exp_se3(projector) @ self.projector)


@dataclass(frozen=True)
class Residuals:
    """Predicted minus decoded coordinates, pattern pixels, of the rays that hit the surface."""

    frame: Int[Tensor, "n"]
    value: Float[Tensor, "n 2"]
    by_camera: Float[Tensor, "n 2 6"]  # by a twist of the camera in the scene (translation, rotation)
    by_projector: Float[Tensor, "n 2 6"]


@dataclass(frozen=True)
class _Hits:
    """Where rays meet the surface."""

    frame: Int[Tensor, "n"]
    ray: Float[Tensor, "n 3"]
    normal: Float[Tensor, "n 3"]
    across: Float[Tensor, "n 1"]  # cosine between both
    p: Float[Tensor, "n 3"]
    T_projector_world: Float[Tensor, "n 4 4"]
    by_projector_point: Float[Tensor, "n 2 3"]  # derivative of the coordinate by the point in the projector's axes
    value: Float[Tensor, "n 2"]


class Problem:
    """Decoded pixels of a scan and its true surface, in the scene frame in which the methods train."""

    def __init__(self, loaded: LoadedScan, truth: Mesh) -> None:
        """`truth` in the scan's world; the pixels are those for training."""
        import open3d as o3d

        S, scan = loaded.S_scene_world, loaded.scan
        corners = S.points(truth.vertices)
        self._tensor = o3d.core.Tensor
        self._tree = o3d.t.geometry.RaycastingScene(nthreads=torch.get_num_threads())
        self._tree.add_triangles(
            o3d.core.Tensor(corners.astype(np.float32)), o3d.core.Tensor(truth.faces.astype(np.uint32))
        )
        a, b, c = (torch.from_numpy(corners[truth.faces[:, k]]) for k in range(3))
        self._corner, self._normal = a, torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
        self._projector = Intrinsics.of(scan.projector, torch.float64)
        samples = loaded.samples
        pixels = samples.at((samples.coords[:, 0].isfinite() & ~samples.held_out).nonzero()[:, 0])
        self.frame, self.coords = pixels.frame, pixels.coords.double()
        cameras = [Intrinsics.of(frame.camera, torch.float64) for frame in scan.frames]
        self._ray = torch.cat([unproject(c, pixels.uv[pixels.frame == k].double()) for k, c in enumerate(cameras)])
        self.frames = len(cameras)

    def residuals(self, poses: Poses, index: Int[Tensor, "rays"]) -> Residuals:
        """Of the pixels `index`, where the surface is locally a plane. Rays that miss it say nothing."""
        h = self._hits(poses, index)
        by_point = h.by_projector_point @ h.T_projector_world[:, :3, :3]
        # a camera that moves takes its ray along; where the ray meets the surface slides along the surface
        slope = (by_point @ h.ray[..., None]) / h.across[..., None]
        carried = by_point - slope * h.normal[:, None]
        return Residuals(h.frame, h.value, _by_twist(carried, h.p), _by_twist(-by_point, h.p))

    def gradient(
        self, poses: Poses, index: Int[Tensor, "rays"]
    ) -> tuple[Float[Tensor, "frames 6"], Float[Tensor, "frames 6"]]:
        """Of the summed L1 norms of the same residuals, by a twist of each camera and of each projector."""
        h = self._hits(poses, index)
        sign, R = h.value.sign(), h.T_projector_world[:, :3, :3]
        in_projector = sign[:, :1] * h.by_projector_point[:, 0] + sign[:, 1:] * h.by_projector_point[:, 1]
        by_point = (in_projector[:, :, None] * R).sum(1)
        carried = by_point - (by_point * h.ray).sum(-1, keepdim=True) / h.across * h.normal
        twists = torch.cat([carried, torch.linalg.cross(h.p, carried), by_point, torch.linalg.cross(h.p, by_point)], 1)
        camera, projector = per_frame(h.frame, twists, self.frames).split(6, 1)
        return camera, -projector

    def _hits(self, poses: Poses, index: Int[Tensor, "rays"]) -> _Hits:
        frame = self.frame[index]
        T = poses.camera[frame]
        origin, ray = T[:, :3, 3], rotate(T, self._ray[index])
        answer = self._tree.cast_rays(self._tensor(torch.cat([origin, ray], 1).float().numpy()))
        hit = torch.from_numpy(np.isfinite(answer["t_hit"].numpy())).nonzero()[:, 0]
        face = torch.from_numpy(answer["primitive_ids"].numpy().astype(np.int64))[hit]
        frame, origin, ray, normal = frame[hit], origin[hit], ray[hit], self._normal[face]
        across = (ray * normal).sum(-1, keepdim=True)
        p = origin + ((self._corner[face] - origin) * normal).sum(-1, keepdim=True) / across * ray
        T = inverse(poses.projector)[frame]
        p_projector = transform(T, p)
        value = project(self._projector, p_projector)[0] - self.coords[index[hit]]
        return _Hits(frame, ray, normal, across, p, T, project_jacobian(self._projector, p_projector), value)


def _by_twist(by_point: Float[Tensor, "n 2 3"], p: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2 6"]:
    """Derivatives by the twist that carries points along."""
    return torch.cat([by_point, torch.linalg.cross(p[:, None].expand_as(by_point), by_point)], -1)


def of_devices(poses: Poses, independent: bool) -> tuple[Float[Tensor, "frames 6 12"], Float[Tensor, "frames 6 12"]]:
    """Twists of camera and projector in the scene by the 12 increments of a frame.

    Independent ones turn each device about itself (`T <- T exp(xi)`). Those of a rig move the frame as a whole about
    the object (delta), and its projector relative to its camera (rho): `T_camera <- exp(delta) T_camera` and
    `T_camera_projector <- exp(rho) T_camera_projector`.
    """
    camera = adjoint(poses.camera)
    zero, one = torch.zeros_like(camera), torch.eye(6, dtype=camera.dtype).expand_as(camera)
    if independent:
        return torch.cat([camera, zero], -1), torch.cat([zero, adjoint(poses.projector)], -1)
    return torch.cat([one, zero], -1), torch.cat([one, camera], -1)


def per_frame(
    frame: Int[Tensor, "n"], values: Float[Tensor, "n *shape"], frames: int
) -> Float[Tensor, "frames *shape"]:
    """Sums over the rows of each frame."""
    return values.new_zeros(frames, *values.shape[1:]).index_add_(0, frame, values)
