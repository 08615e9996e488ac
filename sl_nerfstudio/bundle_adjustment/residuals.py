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
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.loops.residuals import cross_residuals, own_residuals, positions
from sl_nerfstudio.bundle_adjustment.loops.windows import WindowMemory
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.se3 import rotate, transform


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

    @cached_property
    def memory(self) -> WindowMemory:
        """Of the look-ups of these rows: anchors move little from one step to the next."""
        return WindowMemory.empty(array(self.frame))


@dataclass(frozen=True)
class Residuals:
    """Values of all residuals, in projector pixels."""

    own: Float[Tensor, "anchors 2"]
    cross: Float[Tensor, "rows 2"]
    cross_valid: Bool[Tensor, "rows"]


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


def linearise(rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps) -> Linearisation:
    """Residuals and first derivatives at the current state."""
    m, n = len(anchors.frame), len(observations.anchor)
    derivatives = tuple(torch.empty(*size, dtype=torch.float64) for size in ((m, 2, 6), (m, 2), (n, 2, 18), (n, 2)))
    residuals = _residuals(rig, anchors, observations, maps, derivatives)
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
    """Where the seeing cameras have the anchors, and whether in front of them."""
    n = len(observations.anchor)
    uv, in_front = np.empty((n, 2)), np.empty(n, dtype=np.bool_)
    rows = (array(observations.anchor), array(observations.frame))
    positions(n, rig.arrays, *_anchor_arrays(anchors), *rows, uv, in_front)
    return torch.from_numpy(uv), torch.from_numpy(in_front)


def viewing_cosines(rig: Rig, anchors: Anchors, observations: Observations) -> Float[Tensor, "rows"]:
    """Cosine between the surface's normal and the line of sight of the camera that looks an anchor up."""
    T, i = rig.T_world_camera, anchors.frame
    p_world = transform(T[i], anchors.depth[:, None] * anchors.d_camera)[observations.anchor]
    normal = rotate(T[i], anchors.normal)[observations.anchor]
    return torch.nn.functional.cosine_similarity(normal, T[observations.frame, :3, 3] - p_world, dim=-1)


def _residuals(
    rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps, derivatives: tuple[Tensor, ...]
) -> Residuals:
    """Residuals; their derivatives are written to arrays that are not empty."""
    own_by_pose, own_by_depth, by_pose, by_depth = (part.numpy() for part in derivatives)
    devices, points = rig.arrays, _anchor_arrays(anchors)
    own = np.empty((len(anchors.frame), 2))
    own_residuals(len(own), devices, *points, array(anchors.uv_projector), own, own_by_pose, own_by_depth)
    uv, in_front = pixels_of_rows(rig, anchors, observations)
    seen = maps.look_up(observations.frame, uv, observations.memory)
    cross = np.empty((len(uv), 2))
    cross_residuals(
        len(cross), devices, *points, array(observations.anchor), array(observations.frame),
        array(seen.uv_projector), array(seen.jacobian), cross, by_pose, by_depth,
    )  # fmt: skip
    return Residuals(torch.from_numpy(own), torch.from_numpy(cross), seen.valid & in_front)


def array(tensor: Tensor) -> ndarray:
    """The numbers of a tensor one after the other, as compiled loops expect them."""
    return np.ascontiguousarray(tensor.numpy())


def _anchor_arrays(anchors: Anchors) -> tuple[ndarray, ndarray, ndarray]:
    return array(anchors.frame), array(anchors.d_camera), array(anchors.depth)
