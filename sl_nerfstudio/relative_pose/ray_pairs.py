"""Correspondences of one frame as pairs of rays, with what is needed to measure errors in projector pixels."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.devices.compiled_view import ray_of, view_of
from sl_nerfstudio.geometry.devices.models import for_loops
from sl_nerfstudio.relative_pose.pattern_blocks import blocks_of
from sl_nerfstudio.relative_pose.settings import RELATIVE_POSE_DEFAULTS, PatternBlocks


@dataclass(frozen=True)
class RayPairs:
    """Unit rays in each device's own axes."""

    d_camera: Float64[ndarray, "n 3"]
    d_projector: Float64[ndarray, "n 3"]
    d_projector_by_uv: Float64[ndarray, "n 3 2"]  # derivative by the projector's pixel
    block: Int64[ndarray, "n"]  # square of the pattern; errors within one may depend on each other

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.d_camera)

    def chosen(self, index: Int64[ndarray, "m"] | Bool[ndarray, "n"] | slice) -> "RayPairs":
        """Some of the pairs."""
        return RayPairs(self.d_camera[index], self.d_projector[index], self.d_projector_by_uv[index], self.block[index])

    def block_sums(self, values: Float64[ndarray, "n *k"]) -> Float64[ndarray, "blocks *k"]:
        """Sums of values over the pairs of each square of the pattern that holds any."""
        found, group = np.unique(self.block, return_inverse=True)
        sums = np.zeros((len(found), *values.shape[1:]))
        np.add.at(sums, group, values)
        return sums


def lattice_step(h: int, w: int) -> int:
    """Of large images every second, third, .. row and column is enough: neighbouring coordinates err together."""
    return max(1, math.ceil(math.sqrt(h * w / RELATIVE_POSE_DEFAULTS.lattice.most_pixels)))


def correspondences_of(
    coords: Float32[ndarray, "h w 2"],
) -> tuple[Float64[ndarray, "n 2"], Float64[ndarray, "n 2"]]:
    """Camera pixel centres and pattern coordinates of the decoded pixels; of large images, of those on a lattice."""
    step = lattice_step(*coords.shape[:2])
    some = coords[::step, ::step]
    row, column = np.nonzero(np.isfinite(some).all(-1))
    return np.stack([column, row], -1) * step + 0.5, some[row, column].astype(np.float64)


def ray_pairs(
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    camera: Device,
    projector: Device,
    blocks: PatternBlocks = RELATIVE_POSE_DEFAULTS.blocks,
) -> tuple[RayPairs, Int64[ndarray, "m"]]:
    """Rays of correspondences, and the indices of those that have a ray in both devices.

    A DOE has no ray beyond 90 degrees; coordinates that are not finite have none at all.
    """
    d_camera, (d_projector, by_uv) = directions(camera, uv_camera), directions_by_uv(projector, uv_projector)
    usable = np.flatnonzero(np.isfinite(d_camera).all(-1) & np.isfinite(d_projector).all(-1))
    block = blocks_of(uv_projector[usable], projector, blocks)
    return RayPairs(d_camera[usable], d_projector[usable], by_uv[usable], block), usable


def directions(device: Device, uv: Float[ndarray, "n 2"]) -> Float64[ndarray, "n 3"]:
    """Unit directions of pixels in the device's axes; NaN where there is none."""
    d = np.empty((len(uv), 3))
    _directions(*for_loops(device), np.ascontiguousarray(uv, dtype=np.float64), d)
    return d


def directions_by_uv(
    device: Device, uv: Float[ndarray, "n 2"]
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3 2"]]:
    """Unit directions of pixels, and their derivatives by the pixels; NaN where there is none."""
    d, by_uv = directions(device, uv), np.empty((len(uv), 3, 2))
    _by_uv(*for_loops(device), d, by_uv)
    return d, by_uv


def subsample(index: Int64[ndarray, "n"], most: int, rng: np.random.Generator) -> Int64[ndarray, "m"]:
    """All of the indices, or a random choice of `most` of them."""
    return index if len(index) <= most else rng.choice(index, most, replace=False)


@compiled
def _directions(code, parameters, uv, d):
    for i in range(len(uv)):
        d[i, 0], d[i, 1], d[i, 2] = ray_of(code, uv[i, 0], uv[i, 1], parameters)


@compiled
def _by_uv(code, parameters, d, by_uv):
    """Pseudo-inverse of the derivative J of the projection.

    Projection does not depend on the length of a ray: J d = 0, and the columns of J's inverse are perpendicular to d.
    """
    for i in range(len(d)):
        _, _, _, ux, uy, uz, vx, vy, vz = view_of(code, d[i, 0], d[i, 1], d[i, 2], parameters)
        uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
        inverse = 1 / (uu * vv - uv * uv)
        a, b, c = vv * inverse, -uv * inverse, uu * inverse
        by_uv[i, 0, 0], by_uv[i, 1, 0], by_uv[i, 2, 0] = a * ux + b * vx, a * uy + b * vy, a * uz + b * vz
        by_uv[i, 0, 1], by_uv[i, 1, 1], by_uv[i, 2, 1] = b * ux + c * vx, b * uy + c * vy, b * uz + c * vz
