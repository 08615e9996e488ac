"""What an uncertain camera adds to the uncertainty of the projector that is found with it."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import DeviceChange
from sl_nerfstudio.relative_pose.unknown_projector.joint_fit import JointFit, JointProblem, Prior
from sl_nerfstudio.relative_pose.unknown_projector.matches import FrameMatches, Matches
from sl_nerfstudio.relative_pose.unknown_projector.settings import JointFitSettings


def covariance_by_camera(
    frames: Sequence[FrameMatches],
    camera_sigma: tuple[float, float, float],
    found: JointFit,
    matches_of: Callable[[Sequence[FrameMatches]], Matches],
    prior: Prior,
    settings: JointFitSettings,
) -> Float64[ndarray, "free free"]:
    """Of the free intrinsics: by how far they follow each value of the cameras that is moved by 1 sigma.

    `camera_sigma` is of focal length and principal point x, y, in shares of the focal length. A Gauss-Newton step shows
    how far; what is left of it with the cameras as they are does not count.
    """

    def step(change: DeviceChange) -> Float64[ndarray, "free"]:
        moved = [replace(frame, camera=change.applied(frame.camera)) for frame in frames]
        problem = JointProblem(matches_of(moved), found.projector, found.free, prior, settings)
        return problem.gauss_newton_step(found.poses)

    usual = step(DeviceChange(0.0, 0.0, 0.0))
    total = np.zeros((len(found.free), len(found.free)))
    for k, sigma in enumerate(camera_sigma):
        if sigma > 0:
            change = [0.0, 0.0, 0.0]
            change[k] = sigma
            effect = step(DeviceChange(*change)) - usual
            total += np.outer(effect, effect)
    return total
