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

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.devices import project, project_jacobian
from sl_nerfstudio.geometry.se3 import hat, inverse, rotate, transform


@dataclass(frozen=True)
class Anchors:
    """Decoded pixels whose depth is an unknown."""

    frame: Int[Tensor, "anchors"]
    d_camera: Float[Tensor, "anchors 3"]  # unit ray direction in camera axes
    uv_projector: Float[Tensor, "anchors 2"]  # decoded there
    depth: Float[Tensor, "anchors"]  # along the ray
    normal: Float[Tensor, "anchors 3"]  # of the surface there, in camera axes, towards the camera

    def at(self, depth: Float[Tensor, "anchors"]) -> "Anchors":
        """The same anchors at other depths."""
        return replace(self, depth=depth)

    def chosen(self, index: Tensor) -> "Anchors":
        """Some of the anchors, by mask or by index."""
        return Anchors(*(getattr(self, f.name)[index] for f in fields(self)))


@dataclass(frozen=True)
class Observations:
    """Which anchor is looked up in which other frame."""

    anchor: Int[Tensor, "rows"]
    frame: Int[Tensor, "rows"]

    def pairs(self, anchors: Anchors) -> Int[Tensor, "2 rows"]:
        """Frame of the anchor, frame that looks it up."""
        return torch.stack([anchors.frame[self.anchor], self.frame])


@dataclass(frozen=True)
class Residuals:
    """Values of all residuals, in projector pixels."""

    own: Float[Tensor, "anchors 2"]
    cross: Float[Tensor, "rows 2"]
    cross_valid: Bool[Tensor, "rows"]


@dataclass(frozen=True)
class Linearisation:
    """Residuals with their derivatives, before weighting."""

    residuals: Residuals
    own: Float[Tensor, "anchors 2 a"]  # with respect to rho of the anchor's frame
    own_columns: Int[Tensor, "anchors a"]  # which of the unknowns those are
    own_depth: Float[Tensor, "anchors 2"]
    cross: Float[Tensor, "rows 2 b"]  # delta of the anchor's frame; delta, rho of the seeing frame
    cross_columns: Int[Tensor, "rows b"]
    cross_depth: Float[Tensor, "rows 2"]
    unknowns: int  # without the depths: delta of all frames, then rho of all frames


def linearise(rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps) -> Linearisation:
    """Residuals and first derivatives at the current state."""
    i = anchors.frame
    p_camera = anchors.depth[:, None] * anchors.d_camera
    own, own_rho, own_point = _projector_view(rig, i, p_camera)
    own_depth = (own_point * anchors.d_camera[:, None, :]).sum(-1)

    j, a = observations.frame, observations.anchor
    p_world = transform(rig.T_world_camera[i], p_camera)[a]
    d_world = rotate(rig.T_world_camera[i], anchors.d_camera)[a]
    T_camera_world = inverse(rig.T_world_camera)[j]
    p_j = transform(T_camera_world, p_world)
    uv_camera, in_front = project(rig.camera[j], p_j)
    seen = maps.look_up(j, uv_camera)
    uv_projector, cross_rho, by_point = _projector_view(rig, j, p_j)
    by_point = by_point - seen.jacobian @ project_jacobian(rig.camera[j], p_j)
    by_world = by_point @ T_camera_world[:, :3, :3]
    by_delta = torch.cat([by_world, -by_world @ hat(p_world)], -1)
    own_columns, cross_columns = _pose_columns(anchors, observations, rig.frames)
    return Linearisation(
        residuals=Residuals(own - anchors.uv_projector, uv_projector - seen.uv_projector, seen.valid & in_front),
        own=own_rho,
        own_columns=own_columns,
        own_depth=own_depth,
        cross=torch.cat([by_delta, -by_delta, cross_rho], -1),
        cross_columns=cross_columns,
        cross_depth=(by_world * d_world[:, None, :]).sum(-1),
        unknowns=12 * rig.frames,
    )


def residuals_of(rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps) -> Residuals:
    """Residuals without derivatives."""
    i, j, a = anchors.frame, observations.frame, observations.anchor
    p_camera = anchors.depth[:, None] * anchors.d_camera
    own = project(rig.projector, transform(inverse(rig.T_camera_projector)[i], p_camera))[0]
    p_j = transform(inverse(rig.T_world_camera)[j], transform(rig.T_world_camera[i], p_camera)[a])
    uv_camera, in_front = project(rig.camera[j], p_j)
    seen = maps.look_up(j, uv_camera)
    uv_projector = project(rig.projector, transform(inverse(rig.T_camera_projector)[j], p_j))[0]
    return Residuals(own - anchors.uv_projector, uv_projector - seen.uv_projector, seen.valid & in_front)


def _projector_view(
    rig: Rig, frame: Int[Tensor, "n"], p_camera: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 6"], Float[Tensor, "n 2 3"]]:
    """Projector pixel of points in camera axes, and its derivatives by rho and by the point."""
    T_projector_camera = inverse(rig.T_camera_projector)[frame]
    p_projector = transform(T_projector_camera, p_camera)
    uv, _ = project(rig.projector, p_projector)
    by_point = project_jacobian(rig.projector, p_projector) @ T_projector_camera[:, :3, :3]
    return uv, torch.cat([-by_point, by_point @ hat(p_camera)], -1), by_point


def _pose_columns(
    anchors: Anchors, observations: Observations, frames: int
) -> tuple[Int[Tensor, "anchors 6"], Int[Tensor, "rows 18"]]:
    """The unknowns (delta of all frames, then rho of all frames) that own and cross residuals depend on."""
    n, columns = frames, torch.arange(6)
    i, j = observations.pairs(anchors)[..., None]
    own = 6 * n + 6 * anchors.frame[:, None] + columns
    return own, torch.cat([6 * i + columns, 6 * j + columns, 6 * (n + j) + columns], -1)
