"""The planes of the surroundings as each frame sees them, and which of a frame's points are part of them.

The pose of a frame may be wrong by more than its points are noisy. A plane fitted again in each frame, with the common
plane as prior, takes that error out of the heights above it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA, geman_mcclure_weight
from sl_nerfstudio.object_separation.frame_points import FramePoints
from sl_nerfstudio.object_separation.plane import Plane
from sl_nerfstudio.object_separation.settings import SeparationSettings

_FEWEST = 100  # points on a plane from which a frame's own plane is found
_STEPS = 6
_PRESENT = 0.1  # share of the points of a cell with which something is there


@dataclass(frozen=True)
class FramePlane:
    """A plane in one frame, and how noisy its points are relative to their stated sigma."""

    plane: Plane
    noise: float

    def in_sigmas(self, points: FramePoints) -> Float64[ndarray, "n"]:
        """Heights of points in standard deviations."""
        return self.plane.heights(points.p_world) / (self.noise * points.sigma_along(self.plane.normal))


def plane_in_frame(
    plane: Plane, points: FramePoints, pose_noise: float, region_radius: float, settings: SeparationSettings
) -> FramePlane:
    """The plane fitted to the points of one frame that are near it.

    `points` have the noise of their coordinates; that of poses makes heights `pose_noise` times as uncertain.
    """
    found, noise = plane, 1.0
    width = settings.clear_sigmas * pose_noise
    for _ in range(_STEPS):
        sigma = points.sigma_along(found.normal)
        z = found.heights(points.p_world) / sigma
        near = np.abs(z) < width
        if near.sum() < _FEWEST:
            return FramePlane(plane, pose_noise)
        found = _corrected(found, plane, points.chosen(near), z[near], pose_noise, region_radius)
        z = found.heights(points.p_world) / sigma
        noise = max(1.0, MAD_TO_SIGMA * float(np.median(np.abs(z[np.abs(z) < width]))))
        width = max(settings.search_sigmas * noise, width / 2)
    return FramePlane(found, noise)


def _corrected(
    found: Plane,
    prior: Plane,
    points: FramePoints,
    z: Float[ndarray, "n"],
    pose_noise: float,
    radius: float,
) -> Plane:
    """One step of robust least squares for height and slopes, with the common plane as prior."""
    axes = prior.axes()
    centre = points.p_world.mean(0)
    centre = centre - prior.heights(centre[None])[0] * prior.normal
    flat = (points.p_world - centre) @ axes.T / radius
    sigma = points.sigma_along(found.normal)
    weight = geman_mcclure_weight((z / 3) ** 2) / sigma**2
    A = np.concatenate([np.ones((len(z), 1)), flat], 1)
    b = prior.heights(points.p_world)
    spread = max(pose_noise, 2.0) * float(np.median(sigma))  # how far this frame's plane may be from the common one
    H = (weight[:, None] * A).T @ A + np.eye(3) / spread**2
    height, u, v = np.linalg.solve(H, (weight * b) @ A)
    normal = prior.normal - (u * axes[0] + v * axes[1]) / radius
    normal = normal / np.linalg.norm(normal)
    return Plane(normal, float(normal @ (centre + height * prior.normal)))


@dataclass(frozen=True)
class BarePlaces:
    """The cells of a grid in a plane in which nothing rises from it, and how high its points seem to be; in sigmas."""

    plane: Plane
    size: float  # of a cell
    cells: frozenset[tuple[int, int]]
    near: float  # height up to which a point is part of the plane where something may rise from it
    bare: float  # and where nothing does

    def at(self, p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether the plane is bare below points."""
        cell, place = np.unique(_cells(self.plane, p_world, self.size), axis=0, return_inverse=True)
        bare = np.array([tuple(c) in self.cells for c in cell.tolist()], dtype=bool)
        return bare[place.reshape(-1)]


def find_bare_places(
    plane: Plane, frames: Sequence[tuple[FramePoints, FramePlane]], size: float, settings: SeparationSettings
) -> BarePlaces:
    """Cells where nearly all points near the plane are part of it, in all frames together.

    First with the points' own noise. Where something rises from the plane, what seems to be below it is error, and says
    how high points of the plane may seem to be there; the cells are judged again with that.
    """
    p = np.concatenate([points.p_world for points, _ in frames])
    z = np.concatenate([own.in_sigmas(points) for points, own in frames])
    first = _bare(plane, p, z, size, settings.plane_sigmas, settings)
    near = np.abs(z) < settings.most_sigmas
    errors = -z[near][_beside_what_rises(plane, p[near], z[near], size, settings) & (z[near] < 0) & ~first.at(p[near])]
    measured = float(np.quantile(errors, settings.error_share)) if len(errors) >= _FEWEST else 0.0
    return _bare(plane, p, z, size, max(settings.plane_sigmas, measured), settings)


def _beside_what_rises(
    plane: Plane, p_world: Float[ndarray, "n 3"], z: Float[ndarray, "n"], size: float, settings: SeparationSettings
) -> Bool[ndarray, "n"]:
    """Points in cells that hold parts of the plane, and of what rises from it.

    At the edge of a plate, too, there are points below the plane; but those are surface.
    """
    _, place = np.unique(_cells(plane, p_world, size), axis=0, return_inverse=True)
    place = place.reshape(-1)
    count = np.bincount(place)
    rising = np.bincount(place, (z > settings.plane_sigmas).astype(float)) > _PRESENT * count
    flat = np.bincount(place, (np.abs(z) < settings.plane_sigmas).astype(float)) > _PRESENT * count
    return (rising & flat)[place]


def _bare(
    plane: Plane,
    p_world: Float[ndarray, "n 3"],
    z: Float[ndarray, "n"],
    size: float,
    height: float,
    settings: SeparationSettings,
) -> BarePlaces:
    """The cells in which nearly all points near the plane seem to be no higher than `height` (in sigmas)."""
    bare = max(settings.bare_sigmas, settings.bare_factor * height)
    near = np.abs(z) < 2 * bare
    cell, place = np.unique(_cells(plane, p_world[near], size), axis=0, return_inverse=True)
    place = place.reshape(-1)
    flat = (np.abs(z[near]) < height).astype(float)
    share = np.bincount(place, flat, len(cell)) / np.maximum(np.bincount(place, minlength=len(cell)), 1)
    chosen = cell[share >= settings.bare_share]
    return BarePlaces(plane, size, frozenset((a, b) for a, b in chosen.tolist()), height, bare)


def on_plane(points: FramePoints, own: FramePlane, bare: BarePlaces) -> Bool[ndarray, "n"]:
    """Points that are part of a plane or behind it."""
    z = own.in_sigmas(points)
    low = z < bare.near
    unsure = ~low & (z < bare.bare)
    low[unsure] = bare.at(points.p_world[unsure])
    return low


def _cells(plane: Plane, p_world: Float[ndarray, "n 3"], size: float) -> Int64[ndarray, "n 2"]:
    return np.floor(p_world @ plane.axes().T / size).astype(np.int64)
