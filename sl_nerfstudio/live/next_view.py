"""Where to go next: the view from which the surface would become known best, by its covariance.

Candidates lie around the object at the usual distance, near enough to a kept view to share surface with it, and not
lower or much higher than the user has been. A view's gain is the information (nats) that its points would add to those
cells that it would see (Connolly, 1985; by covariance: Whaite and Ferrie, PAMI 1997).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.geometry.triangulation import upright
from sl_nerfstudio.live.surfels import Surfels
from sl_nerfstudio.live.tracker import Model

CANDIDATES = 150  # directions around the object, about 16 degrees apart
FARTHEST_DEG = 40.0  # from the nearest kept view: beyond it too little surface is shared
LOWER, HIGHER = 0.1, 0.5  # than all kept views, as sines of the elevation
CELLS = 4000  # of the surface that are looked at
DEPTH_IMAGE = 40  # places along each side of the image in which cells hide each other
HIDDEN = 4.0  # cells behind the nearest one, from which a cell is hidden
LEAST_COSINE = 0.3  # between a normal and the ray
LEAST_GAIN = 0.05  # nats a cell, below which no view is worth a walk


@dataclass(frozen=True)
class NextView:
    """A view that would add most."""

    T_world_camera: Float64[ndarray, "4 4"]
    gain: float  # nats, of all cells together
    centre: Float64[ndarray, "3"]  # of the object
    up: Float64[ndarray, "3"]

    def way_from(self, here: Similarity) -> tuple[float, float]:
        """How far to go to the right and upwards from a camera (`S_world_camera`): degrees about the object.

        As the user sees it, who looks at the object.
        """
        reach = np.stack([here.t - self.centre, self.T_world_camera[:3, 3] - self.centre])
        height = reach @ self.up
        flat = reach - height[:, None] * self.up
        turn = np.degrees(np.arctan2(self.up @ np.cross(flat[0], flat[1]), flat[0] @ flat[1]))
        elevation = np.degrees(np.arcsin(np.clip(height / np.linalg.norm(reach, axis=1), -1, 1)))
        return float(turn), float(elevation[1] - elevation[0])


def next_view(model: Model) -> NextView | None:
    """The best of all candidates; None where no view adds much."""
    surface = model.surfels
    if not len(surface):
        return None
    step = -(-len(surface) // CELLS)
    position, normal, sigma = (x[::step] for x in (surface.position, surface.normal, surface.sigma))
    usual = float(np.median((surface.sigma * np.sqrt(surface.views))[::step]))  # of one more view
    cameras = model.poses.T_world_camera
    centre = np.median(position, axis=0)
    reach = cameras[:, :3, 3] - centre
    distance = float(np.median(np.linalg.norm(reach, axis=1)))
    kept = reach / np.linalg.norm(reach, axis=1, keepdims=True)
    R_up_world = upright(cameras)
    directions = _around() @ R_up_world
    height, heights = directions @ R_up_world[2], kept @ R_up_world[2]
    near = (directions @ kept.T).max(1) > np.cos(np.radians(FARTHEST_DEG))
    allowed = near & (height > heights.min() - LOWER) & (height < heights.max() + HIGHER)
    best: tuple[float, Float64[ndarray, 3]] | None = None
    for direction in directions[allowed]:
        eye = centre + distance * direction
        cosine, seen = _seen(position, normal, eye, centre, surface)
        gain = float(0.5 * np.log1p((cosine[seen] * sigma[seen] / usual) ** 2).sum())
        if best is None or gain > best[0]:
            best = gain, eye
    if best is None or best[0] < LEAST_GAIN * len(position):
        return None
    up = R_up_world[2]
    T = np.eye(4)
    T[:3, 2] = (best[1] - centre) / distance
    T[:3, 0] = np.cross(up, T[:3, 2])
    T[:3, 0] /= max(np.linalg.norm(T[:3, 0]), 1e-9)
    T[:3, 1], T[:3, 3] = np.cross(T[:3, 2], T[:3, 0]), best[1]
    return NextView(T, step * best[0], centre, up)


def _around() -> Float64[ndarray, "k 3"]:
    """Directions spread evenly (Vogel's spiral)."""
    k = np.arange(CANDIDATES) + 0.5
    height, turn = 1 - 2 * k / CANDIDATES, np.pi * (1 + 5**0.5) * k
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], -1)


def _seen(
    position: Float64[ndarray, "n 3"], normal: Float64[ndarray, "n 3"], eye: Float64[ndarray, "3"],
    centre: Float64[ndarray, "3"], surface: Surfels,
) -> tuple[Float64[ndarray, "n"], Bool[ndarray, "n"]]:  # fmt: skip
    """Cosine between each normal and its ray, and which cells are seen: facing, and not behind others."""
    ray = eye - position
    far = np.linalg.norm(ray, axis=1)
    cosine = (ray * normal).sum(1) / far
    axis = (centre - eye) / np.linalg.norm(centre - eye)
    u = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    u /= np.linalg.norm(u)
    offset = position - centre
    plane = offset @ np.stack([u, np.cross(axis, u)], 1)
    extent = float(np.abs(plane).max()) + surface.size
    column, row = np.floor((plane / extent + 1) / 2 * DEPTH_IMAGE).astype(np.int64).T
    place = row * DEPTH_IMAGE + column
    nearest = np.full(DEPTH_IMAGE**2, np.inf)
    np.minimum.at(nearest, place, offset @ axis)
    return cosine, (cosine > LEAST_COSINE) & (offset @ axis < nearest[place] + HIDDEN * surface.size)
