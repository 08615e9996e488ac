"""First solutions for the relative pose from the plane that holds most of the correspondences.

Two views of a plane are related by a homography, which has two reconstructions in front of both devices (Longuet-
Higgins, Proc. R. Soc. B 1986). Only what lies off the plane tells the true one from its twin, and where a table or a
wall fills the view, few random samples of five hold enough of that. Both are therefore always among the first
solutions; `candidates` decides by everything else that was decoded.
"""

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.relative_pose.ray_pairs import RayPairs
from sl_nerfstudio.relative_pose.settings import RELATIVE_POSE_DEFAULTS, PlaneSettings


def plane_starts(
    rays: RayPairs, settings: PlaneSettings = RELATIVE_POSE_DEFAULTS.plane
) -> list[tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]]:
    """Poses (R, t), projector to camera, |t| = 1, that the dominant plane allows; both signs of t; may be empty."""
    usable = (rays.d_camera[:, 2] < -settings.least_cosine) & (rays.d_projector[:, 2] < -settings.least_cosine)
    if usable.sum() < settings.fewest:
        return []
    # Image points of a device that looks along +z: rays divided by their last component.
    camera, projector = (d[usable, :2] / d[usable, 2:] for d in (rays.d_camera, rays.d_projector))
    radian_per_px = float(np.median(np.linalg.norm(rays.d_projector_by_uv[usable], axis=(1, 2)))) / np.sqrt(2)
    H, _ = cv2.findHomography(projector, camera, cv2.RANSAC, settings.outlier_px * radian_per_px)
    if H is None or not np.isfinite(H).all():
        return []
    count, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    out = []
    for k in range(count):
        length = float(np.linalg.norm(translations[k]))
        if length > settings.least_translation:
            out += [(rotations[k], sign * translations[k][:, 0] / length) for sign in (1.0, -1.0)]
    return out
