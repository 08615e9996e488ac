"""Residuals of the bundle adjustment and their derivatives.

Unknowns are the poses and, for every *anchor* (a decoded pixel of one frame), its depth along its
camera ray. An anchor makes two kinds of residuals:

    own    its decoded coordinate against its own projector's view of it,
    cross  wherever another camera sees it: the coordinate decoded *there* against the view of it
           from that frame's projector.

All residuals are projector pixels, so shrinking the scene does not lower them: the collapse of
free-scale ICP cannot happen.

Increments: `T_world_camera <- exp(delta) T_world_camera` moves a frame as a whole (rotating about
the origin, which is the centre of the scene), `T_camera_projector <- exp(rho) T_camera_projector`
moves its projector against its camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps, WindowMemory
from sl_nerfstudio.geometry.devices import MODELS, Device, Intrinsics, view_of
from sl_nerfstudio.geometry.lie import (
    DevicePoses,
    Similarity,
    inverse,
    inverse_poses,
    moved,
    moved_poses,
    rotated,
    row_times_rotation,
)
from sl_nerfstudio.parallel import compiled, compiled_range


@dataclass(frozen=True)
class Rig:
    """All devices of a scan; poses in the scene frame, whose origin is the centre of the object."""

    camera: Intrinsics  # batch (frames,)
    projector: Intrinsics  # batch ()
    T_world_camera: Float[Tensor, "frames 4 4"]
    T_camera_projector: Float[Tensor, "frames 4 4"]

    @staticmethod
    def of(cameras: Sequence[Device], projector: Device, poses: DevicePoses, S_scene_world: Similarity) -> "Rig":
        """Put devices with the given poses in a world into the scene, which is the rig's "world"."""
        scene = poses.mapped(S_scene_world)
        camera = torch.from_numpy(scene.T_world_camera)
        return Rig(
            Intrinsics.of(list(cameras), torch.float64),
            Intrinsics.of(projector, torch.float64),
            camera,
            inverse(camera) @ torch.from_numpy(scene.T_world_projector),
        )

    def poses(self, S_world_scene: Similarity) -> DevicePoses:
        """Poses of all devices in a world."""
        return DevicePoses(self.T_world_camera.numpy(), self.T_world_projector.numpy()).mapped(S_world_scene)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.T_world_camera)

    @cached_property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray, ndarray, int, ndarray, int]:
        """Arrays for compiled loops: poses first, then parameters and model codes of cameras and projector.

        The poses are those of the cameras, their inverses, and those of the cameras in the axes of their projectors.
        """
        camera, projector = self.camera, self.projector
        T_world_camera, T_camera_projector, cameras, light = (
            np.ascontiguousarray(part.numpy())
            for part in (self.T_world_camera, self.T_camera_projector, camera.params, projector.params)
        )
        T_camera_world, T_projector_camera = np.empty_like(T_world_camera), np.empty_like(T_world_camera)
        inverse_poses(self.frames, T_world_camera, T_camera_world)
        inverse_poses(self.frames, T_camera_projector, T_projector_camera)
        codes = MODELS[camera.model].code, MODELS[projector.model].code
        return T_world_camera, T_camera_world, T_projector_camera, cameras, codes[0], light, codes[1]

    @property
    def T_world_projector(self) -> Float[Tensor, "frames 4 4"]:
        """Projector poses in the scene frame."""
        return self.T_world_camera @ self.T_camera_projector

    @property
    def baseline(self) -> Float[Tensor, "frames"]:
        """Distance between camera and projector of every frame."""
        return self.T_camera_projector[:, :3, 3].norm(dim=-1)

    def moved(self, delta: Float[Tensor, "frames 6"], rho: Float[Tensor, "frames 6"]) -> "Rig":
        """The rig after an increment of every frame as a whole, and of its projector relative to its camera."""
        return replace(
            self,
            T_world_camera=_after(delta, self.T_world_camera),
            T_camera_projector=_after(rho, self.T_camera_projector),
        )

    def scaled(self, scale: float) -> "Rig":
        """The rig with all lengths multiplied."""
        camera, relative = self.T_world_camera.clone(), self.T_camera_projector.clone()
        camera[:, :3, 3] *= scale
        relative[:, :3, 3] *= scale
        return replace(self, T_world_camera=camera, T_camera_projector=relative)


def _after(twist: Float[Tensor, "n 6"], T: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
    """exp(twist) T."""
    out = np.empty((len(T), 4, 4))
    moved_poses(len(T), np.ascontiguousarray(T.numpy()), np.ascontiguousarray(twist.numpy()), out)
    return torch.from_numpy(out)


OWN_PLACE_PX = 4.0  # residual up to which a look-up is taken to see the anchor's own place: about a window
GRAZING = 0.05  # least cosine between the surface's normal and a ray for derivatives

# Compiled residuals and derivatives. `devices` are `Rig.arrays`. Arrays for derivatives may be empty: then none are
# computed.


@compiled
def _by_increment(out, first, sign, a, b, c, x, y, z):
    """out[first : first + 6] = sign * [b, -b x p]: a derivative by a point p, as one by an increment of its pose."""
    out[first], out[first + 1], out[first + 2] = sign * a, sign * b, sign * c
    out[first + 3] = -sign * (b * z - c * y)
    out[first + 4] = -sign * (c * x - a * z)
    out[first + 5] = -sign * (a * y - b * x)


@compiled
def _world_point(devices, frame, depth, ray):
    """A point along a camera ray."""
    return moved(devices[0][frame], depth * ray[0], depth * ray[1], depth * ray[2])


@compiled_range
def own_residuals(first, last, devices, frame, rays, depths, decoded, residual, by_pose, by_depth):
    """Own residuals of the anchors: their projector's view of them less the decoded coordinates."""
    _, _, T_projector_camera, _, _, projector, code = devices
    derivatives = len(by_depth) > 0
    for k in range(first, last):
        T, ray = T_projector_camera[frame[k]], rays[k]
        x, y, z = depths[k] * ray[0], depths[k] * ray[1], depths[k] * ray[2]
        u, v, _, ux, uy, uz, vx, vy, vz = view_of(code, *moved(T, x, y, z), projector)
        residual[k, 0], residual[k, 1] = u - decoded[k, 0], v - decoded[k, 1]
        if derivatives:
            for c, row in ((0, (ux, uy, uz)), (1, (vx, vy, vz))):
                a, b, d = row_times_rotation(row[0], row[1], row[2], T)
                _by_increment(by_pose[k, c], np.int64(0), -1.0, a, b, d, x, y, z)
                by_depth[k, c] = a * ray[0] + b * ray[1] + d * ray[2]


@compiled_range
def positions(first, last, devices, frame, rays, depths, anchor, viewer, uv, in_front):
    """Pixels at which other cameras see the anchors."""
    _, T_camera_world, _, cameras, code, _, _ = devices
    for k in range(first, last):
        a, j = anchor[k], viewer[k]
        x, y, z = _world_point(devices, frame[a], depths[a], rays[a])
        x, y, z = moved(T_camera_world[j], x, y, z)
        uv[k, 0], uv[k, 1], in_front[k] = view_of(code, x, y, z, cameras[j])[:3]


@compiled_range
def cross_residuals(
    first, last, devices, frame, rays, depths, normals, anchor, viewer, seen, seen_by_pixel, own_place, residual,
    by_pose, by_depth,
):  # fmt: skip
    """Cross residuals: the views of their projectors less what other frames decoded (`seen`, `seen_by_pixel`).

    A point that moves along the surface changes nothing: what its projector shows there and what was decoded there move
    alike. So the derivative by the point is that by its distance from the surface, along the camera's ray. That holds
    for look-ups that see the anchor's own place, whose residual is below `own_place`. The others see another part of
    the surface, which has another slope: that of the coordinates which are looked up.
    """
    T_world_camera, T_camera_world, T_projector_camera, cameras, camera_code, projector, projector_code = devices
    derivatives = len(by_depth) > 0
    for k in range(first, last):
        n, j = anchor[k], viewer[k]
        i, ray = frame[n], rays[n]
        x, y, z = _world_point(devices, i, depths[n], ray)
        xj, yj, zj = moved(T_camera_world[j], x, y, z)
        T = T_projector_camera[j]
        u, v, _, ux, uy, uz, vx, vy, vz = view_of(projector_code, *moved(T, xj, yj, zj), projector)
        residual[k, 0], residual[k, 1] = u - seen[k, 0], v - seen[k, 1]
        if derivatives:
            by_normal = residual[k, 0] ** 2 + residual[k, 1] ** 2 < own_place**2
            R, C, normal = T_world_camera[i], T_world_camera[j], normals[n]
            dx, dy, dz = rotated(R, ray[0], ray[1], ray[2])
            nx, ny, nz = rotated(R, normal[0], normal[1], normal[2])
            facing = nx * (C[0, 3] - x) + ny * (C[1, 3] - y) + nz * (C[2, 3] - z)
            along = -max(facing, GRAZING * np.sqrt(xj * xj + yj * yj + zj * zj))  # the normal times the camera's ray
            _, _, _, cux, cuy, cuz, cvx, cvy, cvz = view_of(camera_code, xj, yj, zj, cameras[j])
            for c, row in ((0, (ux, uy, uz)), (1, (vx, vy, vz))):
                a, b, d = row_times_rotation(row[0], row[1], row[2], T)
                _by_increment(by_pose[k, c], np.int64(12), -1.0, a, b, d, xj, yj, zj)
                if by_normal:
                    by_distance = (a * xj + b * yj + d * zj) / along
                    a, b, d = by_distance * nx, by_distance * ny, by_distance * nz
                else:
                    du, dv = seen_by_pixel[k, c, 0], seen_by_pixel[k, c, 1]
                    a, b, d = a - du * cux - dv * cvx, b - du * cuy - dv * cvy, d - du * cuz - dv * cvz
                    a, b, d = row_times_rotation(a, b, d, T_camera_world[j])
                _by_increment(by_pose[k, c], np.int64(0), 1.0, a, b, d, x, y, z)
                _by_increment(by_pose[k, c], np.int64(6), -1.0, a, b, d, x, y, z)
                by_depth[k, c] = a * dx + b * dy + d * dz


@dataclass(frozen=True)
class Anchors:
    """Decoded pixels whose depth is an unknown."""

    frame: Int[Tensor, "anchors"]
    d_camera: Float[Tensor, "anchors 3"]  # unit ray direction in camera axes
    uv_projector: Float[Tensor, "anchors 2"]  # decoded there
    depth: Float[Tensor, "anchors"]  # along the ray
    normal: Float[Tensor, "anchors 3"]  # of the surface there, in camera axes, towards the camera
    roughness: Float[Tensor, "anchors"]  # of the coordinates around it, see `MapSample`

    def at(self, depth: Float[Tensor, "anchors"]) -> "Anchors":
        """The same anchors at other depths."""
        return replace(self, depth=depth)

    def chosen(self, index: Tensor) -> "Anchors":
        """Choose anchors by mask or by index."""
        return Anchors(*(getattr(self, f.name)[index] for f in fields(self)))

    def replaced(self, where: Bool[Tensor, "anchors"], by: "Anchors") -> "Anchors":
        """Put others in the place of some."""
        parts = {f.name: getattr(self, f.name).clone() for f in fields(self)}
        for name, part in parts.items():
            part[where] = getattr(by, name)
        return Anchors(**parts)


@dataclass(frozen=True)
class Observations:
    """Which anchor is looked up in which other frame."""

    anchor: Int[Tensor, "rows"]
    frame: Int[Tensor, "rows"]

    def pairs(self, anchors: Anchors) -> Int[Tensor, "2 rows"]:
        """Frame of the anchor, frame that looks it up."""
        return torch.stack([anchors.frame[self.anchor], self.frame])

    @cached_property
    def memory(self) -> WindowMemory:
        """Last fits of the look-ups of these rows: anchors move little from one step to the next."""
        return WindowMemory.empty(array(self.frame))


@dataclass(frozen=True)
class Residuals:
    """Values of all residuals, in projector pixels."""

    own: Float[Tensor, "anchors 2"]
    cross: Float[Tensor, "rows 2"]
    cross_valid: Bool[Tensor, "rows"]
    roughness: Float[Tensor, "rows"]  # of what was looked up, see `MapSample`


@dataclass(frozen=True)
class Linearisation:
    """Residuals with their derivatives, before weighting.

    The unknowns, without the depths, are delta of all frames, then rho of all frames, then those common to all frames.
    """

    residuals: Residuals
    own: Float[Tensor, "anchors 2 a"]  # with respect to rho of the anchor's frame; common unknowns
    own_depth: Float[Tensor, "anchors 2"]
    own_frame: Int[Tensor, "anchors"]
    cross: Float[Tensor, "rows 2 b"]  # delta of the anchor's frame; delta, rho of the seeing frame; common unknowns
    cross_depth: Float[Tensor, "rows 2"]
    cross_frames: Int[Tensor, "2 rows"]  # frame of the anchor, seeing frame
    frames: int

    @property
    def common(self) -> int:
        """Number of unknowns that all frames share."""
        return self.own.shape[-1] - 6

    @property
    def unknowns(self) -> int:
        """Number of unknowns without the depths."""
        return 12 * self.frames + self.common


def linearise(
    rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps, own_place_px: float = 0.0
) -> Linearisation:
    """Residuals and first derivatives at the current state.

    Residuals below `own_place_px` have derivatives by the anchors' normals; the others those of single look-ups, which
    are exact, but noisy.
    """
    m, n = len(anchors.frame), len(observations.anchor)
    derivatives = tuple(torch.empty(*size, dtype=torch.float64) for size in ((m, 2, 6), (m, 2), (n, 2, 18), (n, 2)))
    residuals = _residuals(rig, anchors, observations, maps, derivatives, own_place_px)
    own, own_depth, cross, cross_depth = derivatives
    pairs = observations.pairs(anchors)
    return Linearisation(residuals, own, own_depth, anchors.frame, cross, cross_depth, pairs, rig.frames)


def residuals_of(rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps) -> Residuals:
    """Residuals without derivatives."""
    none = (torch.empty(0, 2, 6), torch.empty(0, 2), torch.empty(0, 2, 18), torch.empty(0, 2))
    return _residuals(rig, anchors, observations, maps, tuple(part.double() for part in none))


def pixels_of_rows(
    rig: Rig, anchors: Anchors, observations: Observations
) -> tuple[Float[Tensor, "rows 2"], Bool[Tensor, "rows"]]:
    """Pixels of the anchors in the cameras that see them, and whether they are in front."""
    n = len(observations.anchor)
    uv, in_front = np.empty((n, 2)), np.empty(n, dtype=np.bool_)
    rows = (array(observations.anchor), array(observations.frame))
    positions(n, rig.arrays, *_anchor_arrays(anchors), *rows, uv, in_front)
    return torch.from_numpy(uv), torch.from_numpy(in_front)


def _residuals(
    rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps, derivatives: tuple[Tensor, ...],
    own_place_px: float = 0.0,
) -> Residuals:  # fmt: skip
    """Residuals; their derivatives are written to arrays that are not empty."""
    own_by_pose, own_by_depth, by_pose, by_depth = (part.numpy() for part in derivatives)
    devices, points = rig.arrays, _anchor_arrays(anchors)
    own = np.empty((len(anchors.frame), 2))
    own_residuals(len(own), devices, *points, array(anchors.uv_projector), own, own_by_pose, own_by_depth)
    uv, in_front = pixels_of_rows(rig, anchors, observations)
    seen = maps.look_up(observations.frame, uv, observations.memory)
    cross = np.empty((len(uv), 2))
    cross_residuals(
        len(cross), devices, *points, array(anchors.normal), array(observations.anchor), array(observations.frame),
        array(seen.uv_projector), array(seen.jacobian), own_place_px, cross, by_pose, by_depth,
    )  # fmt: skip
    return Residuals(torch.from_numpy(own), torch.from_numpy(cross), seen.valid & in_front, seen.roughness)


def array(tensor: Tensor) -> ndarray:
    """The numbers of a tensor one after the other, as compiled loops expect them."""
    return np.ascontiguousarray(tensor.numpy())


def _anchor_arrays(anchors: Anchors) -> tuple[ndarray, ndarray, ndarray]:
    return array(anchors.frame), array(anchors.d_camera), array(anchors.depth)
