"""From the scan's world to the scene of the field: the object is at the origin, inside the unit sphere.

The map depends only on the triangulated points and on the cameras' orientations. If the world of a scan is
rotated, shifted or scaled, the normalised scene stays the same except for rounding.
"""

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.dataparser.samples import PixelSamples
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.geometry.spacing import evenly_spaced
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan import Scan

OBJECT_RADIUS = 0.8  # of the scene's unit sphere; the rest allows for poses that are still wrong
_POINTS_PER_FRAME = 1000
_FEWEST_POINTS = 16
_NEIGHBOURS = 8
_LONELY = 4.0  # times the median distance to the neighbours: beyond it a decoding counts as wrong
_COMMON_UP = 0.3  # smallest length of the cameras' mean up direction with which it counts as a common one
_INSIDE = 0.99  # share of the points inside the object's sphere


def normalisation(scan: Scan, samples: PixelSamples) -> Similarity:
    """`S_scene_world`, with scene axes that `upright` derives from the cameras.

    Raises UserError if hardly any pixel can be triangulated.
    """
    points, tried = triangulated_points(scan, samples)
    if len(points) < _FEWEST_POINTS:
        raise UserError(
            f"{scan.root / 'transforms.json'}: only {len(points)} of {tried} pixels have a camera ray and a projector "
            "ray that meet in front of both devices. The poses are probably world-to-device instead of "
            "device-to-world, or in OpenCV axes (multiply them by diag(1, -1, -1, 1) from the right), or coords/ has "
            "x and y swapped. Run sl-check on the folder."
        )
    centre, radius = enclosing_sphere(without_lonely(points))
    scale = OBJECT_RADIUS / radius
    R = upright(scan.poses.T_world_camera)
    return Similarity(scale, R, -scale * R @ centre)


def upright(T_world_camera: Float[ndarray, "n 4 4"]) -> Float[ndarray, "3 3"]:
    """Rotation from world to scene axes: z is the cameras' mean up, x as close as possible to the first camera's right.

    If the cameras roll so much that they have no common up, z is the first camera's up.
    """
    up = T_world_camera[:, :3, 1].mean(0)
    if np.linalg.norm(up) < _COMMON_UP:
        up = T_world_camera[0, :3, 1]
    z = up / np.linalg.norm(up)
    # right and back of the first camera are perpendicular: they cannot both be parallel to z
    across = [axis - (axis @ z) * z for axis in T_world_camera[0, :3, [0, 2]]]
    right, back = (np.linalg.norm(axis) for axis in across)
    x = across[0] / right if right > 0.1 else np.cross(z, across[1] / back)
    return np.stack([x, np.cross(z, x), z])


def triangulated_points(scan: Scan, samples: PixelSamples) -> tuple[Float[ndarray, "n 3"], int]:
    """World points of up to 1000 decoded pixels of each frame, and how many pixels were tried."""
    points, tried = [], 0
    for number, frame in enumerate(scan.frames):
        first, last = int(samples.first[number]), int(samples.first[number + 1])
        count = min(_POINTS_PER_FRAME, last - first)
        pixels = samples.at(first + torch.from_numpy(evenly_spaced(last - first, count)))
        decoded = pixels.decoded
        count = int(decoded.sum())
        tried += count
        found = triangulate(
            Intrinsics.of(frame.camera, torch.float64),
            torch.from_numpy(frame.T_world_camera).expand(count, 4, 4),
            pixels.uv[decoded].double(),
            Intrinsics.of(scan.projector, torch.float64),
            torch.from_numpy(frame.T_world_projector).expand(count, 4, 4),
            pixels.coords[decoded].double(),
        )
        good = found.p_world.isfinite().all(-1) & (found.depth_camera > 0) & (found.depth_projector > 0)
        points.append(found.p_world[good].numpy())
    return np.concatenate(points), tried


def without_lonely(points: Float[ndarray, "n 3"]) -> Float[ndarray, "m 3"]:
    """Points whose neighbours are about as close as those of most points: wrong decodings scatter along their rays."""
    distance, _ = KDTree(points).query(points, k=_NEIGHBOURS + 1)
    distance = distance[:, -1]
    return points[distance <= _LONELY * np.median(distance)]


def enclosing_sphere(points: Float[ndarray, "n 3"], rounds: int = 300) -> tuple[Float[ndarray, "3"], float]:
    """Centre and radius of a nearly smallest sphere around 99 % of the points.

    Badoiu and Clarkson's iteration (SODA 2003) with the farthest point replaced by the one at the 99 % quantile.
    The result does not depend on the axes.
    """
    centre = points.mean(0)
    last = int(_INSIDE * (len(points) - 1))
    for i in range(rounds):
        distance = np.linalg.norm(points - centre, axis=1)
        far = np.argpartition(distance, last)[last]
        centre = centre + (points[far] - centre) / (i + 2)
    return centre, float(np.quantile(np.linalg.norm(points - centre, axis=1), _INSIDE))
