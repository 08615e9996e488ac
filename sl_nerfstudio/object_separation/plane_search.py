"""The dominant planes in the points of all frames, by random sampling and refinement."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.object_separation.frame_points import FramePoints
from sl_nerfstudio.object_separation.plane import Plane, fit_plane
from sl_nerfstudio.object_separation.plane_growth import FEWEST, grown_planes
from sl_nerfstudio.object_separation.settings import SeparationSettings

_SCORED = 6000  # points on which hypotheses are compared


@dataclass(frozen=True)
class PointPool:
    """Points of all frames together, thinned, with normals."""

    points: FramePoints
    normal: Float64[ndarray, "n 3"]
    frame: Int64[ndarray, "n"]

    @staticmethod
    def of(frames: Sequence[FramePoints], normals: Sequence[Float[ndarray, "_n 3"]]) -> "PointPool":
        """The points of several frames that have a normal."""
        joined = FramePoints(*(np.concatenate([vars(f)[key] for f in frames]) for key in vars(frames[0])))
        frame = np.repeat(np.arange(len(frames)), [len(f) for f in frames])
        pool = PointPool(joined, np.concatenate(list(normals)), frame)
        return pool.chosen(np.isfinite(pool.normal).all(-1))

    def chosen(self, index: Int64[ndarray, "m"] | Bool[ndarray, "n"]) -> "PointPool":
        """Some of the points."""
        return PointPool(self.points.chosen(index), self.normal[index], self.frame[index])

    def __len__(self) -> int:
        """Number of points."""
        return len(self.frame)

    def on(self, plane: Plane, settings: SeparationSettings) -> Bool[ndarray, "n"]:
        """The points that are part of a plane: by their place and by their normal."""
        near = np.abs(plane.heights(self.points.p_world)) < settings.search_sigmas * self.points.sigma_along(
            plane.normal
        )
        return near & (np.abs(self.normal @ plane.normal) > settings.normal_cosine)


def find_planes(
    pool: PointPool, radius: float, rng: np.random.Generator, settings: SeparationSettings
) -> list[tuple[Plane, float]]:
    """Planes with the share of all points that they hold, the largest first; none that holds too few or one frame's.

    `radius` is that of the viewed region.
    """
    found: list[tuple[Plane, float]] = []
    rest = pool
    for _ in range(settings.planes):
        plane = _largest(rest, radius, rng, settings)
        if plane is None:
            break
        on = rest.on(plane, settings)
        if on.sum() < settings.least_support * len(pool) or len(np.unique(rest.frame[on])) < 2:
            break
        found.append((plane, float(on.sum() / len(pool))))
        clear = np.abs(plane.heights(rest.points.p_world)) > settings.clear_sigmas * rest.points.sigma_along(
            plane.normal
        )
        rest = rest.chosen(clear)
    return found


def _largest(pool: PointPool, radius: float, rng: np.random.Generator, settings: SeparationSettings) -> Plane | None:
    """The plane that holds the most points, of planes grown from random points; None if there are too few points."""
    if len(pool) < settings.neighbours:
        return None
    some = pool.chosen(rng.choice(len(pool), min(_SCORED, len(pool)), replace=False))
    seeds = rng.integers(0, len(some), settings.hypotheses)
    planes, counts = grown_planes(
        some.points, some.normal, seeds, radius, settings.search_sigmas, settings.normal_cosine
    )
    most = int(counts.argmax())
    if counts[most] == 0:
        return None
    best = Plane(planes[most, :3], float(planes[most, 3]))
    for _ in range(3):
        best = _refitted(pool, pool.on(best, settings), best)
    return best


def _refitted(pool: PointPool, on: Bool[ndarray, "n"], plane: Plane) -> Plane:
    """The plane fitted to some points; unchanged if they are too few."""
    if on.sum() < FEWEST:
        return plane
    points = pool.points.chosen(on)
    found = fit_plane(points.p_world, 1 / points.sigma_along(plane.normal) ** 2)
    return found if found.normal @ plane.normal > 0 else found.flipped()
