"""Whether the epipolar geometry of all frames contradicts the stated intrinsics, and whose.

Focal length and principal point of the projector become free, with all relative poses; then those of the camera
instead. A frame's own pose absorbs part of a wrong value; what several frames demand together, it cannot.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.unknown_projector.joint_fit import JointProblem, Prior
from sl_nerfstudio.relative_pose.unknown_projector.matches import FrameMatches, Matches, Poses, UnitPose
from sl_nerfstudio.relative_pose.unknown_projector.parameters import prior_sigma, values_of
from sl_nerfstudio.relative_pose.unknown_projector.settings import UNKNOWN_PROJECTOR_DEFAULTS, UnknownProjectorSettings
from sl_nerfstudio.relative_pose.unknown_projector.starts import FOCAL_AND_CENTRE
from sl_nerfstudio.threads import one_library_thread

Role = Literal["projector", "camera"]
Part = Literal["focal length", "principal point", "focal length and principal point"]
_PARTS: dict[Part, tuple[int, ...]] = {"focal length": (0,), "principal point": (1, 2)}


@dataclass(frozen=True)
class DeviceEvidence:
    """What the frames say of one device, if the other one is right. Shares are of its focal length."""

    device: Device  # as stated
    change: Float64[ndarray, "3"]  # of focal length and principal point x, y, shares; for which frames agree best
    covariance: Float64[ndarray, "3 3"]
    noise_px: tuple[float, float]  # of the epipolar errors: with the stated values, and with those that agree best

    @property
    def chi_square(self) -> float:
        """Squared length of the change in units of its uncertainty: about three if the stated values are right."""
        return float(self.change @ np.linalg.solve(self.covariance, self.change))


@dataclass(frozen=True)
class Explanation:
    """Values of one device that are wrong, and the change with which the frames agree; the other values are right."""

    role: Role
    part: Part
    device: Device  # as stated
    change: Float64[ndarray, "3"]  # shares of the focal length
    sigma: Float64[ndarray, "3"]
    left: float  # chi square that it leaves


@dataclass(frozen=True)
class IntrinsicsEvidence:
    """What the frames say of both devices, each alone."""

    projector: DeviceEvidence
    camera: DeviceEvidence

    def allowing(self, doubt: Float64[ndarray, "3 3"]) -> "IntrinsicsEvidence":
        """With stated values that are themselves uncertain; covariance of shares of the focal length."""
        return IntrinsicsEvidence(
            *(replace(one, covariance=one.covariance + doubt) for one in (self.projector, self.camera))
        )

    def contradicts(self, settings: UnknownProjectorSettings = UNKNOWN_PROJECTOR_DEFAULTS) -> bool:
        """Whether the stated intrinsics cannot be right."""
        return all(
            one.chi_square > settings.contradiction and bool((np.abs(one.change) > settings.least_change).any())
            for one in (self.projector, self.camera)
        )

    def explanations(self, settings: UnknownProjectorSettings = UNKNOWN_PROJECTOR_DEFAULTS) -> list[Explanation]:
        """What would explain the contradiction: a single part of one device, if one does; else either device.

        A wrong projector and a wrong camera look alike. But a focal length of the one is focal length and principal
        point of the other, so that few wrong values tell whose they are.
        """
        both: tuple[tuple[Role, DeviceEvidence], ...] = (("projector", self.projector), ("camera", self.camera))
        found = [_alone(role, one, part) for role, one in both for part in _PARTS]
        enough = [e for e in found if e.left < settings.explained]
        if enough:
            return enough
        whole: Part = "focal length and principal point"
        return [Explanation(r, whole, e.device, e.change, np.sqrt(np.diag(e.covariance)), 0.0) for r, e in both]


def _alone(role: Role, evidence: DeviceEvidence, part: Part) -> Explanation:
    """The change if only one part is wrong (conditional normal distribution), and what this leaves unexplained."""
    kept = list(_PARTS[part])
    held = [k for k in range(3) if k not in kept]
    C, x = evidence.covariance, evidence.change
    gain = np.linalg.solve(C[np.ix_(held, held)], C[np.ix_(held, kept)]).T
    change, sigma = np.zeros(3), np.zeros(3)
    change[kept] = x[kept] - gain @ x[held]
    sigma[kept] = np.sqrt(np.diag(C[np.ix_(kept, kept)] - gain @ C[np.ix_(held, kept)]))
    left = float(x[held] @ np.linalg.solve(C[np.ix_(held, held)], x[held]))
    return Explanation(role, part, evidence.device, change, sigma, left)


@one_library_thread()
def check_intrinsics(
    frames: Sequence[FrameMatches],
    poses: Sequence[UnitPose],
    projector: Device,
    seed: int = 0,
    settings: UnknownProjectorSettings = UNKNOWN_PROJECTOR_DEFAULTS,
) -> IntrinsicsEvidence:
    """Test of the stated values. `poses` are those found with them; cameras must all have the same intrinsics."""
    swapped = [FrameMatches(f.name, f.uv_projector, f.uv_camera, projector) for f in frames]
    turned = [(R.T, -R.T @ t) for R, t in poses]
    return IntrinsicsEvidence(
        _evidence(frames, poses, projector, seed, settings),
        _evidence(swapped, turned, frames[0].camera, seed, settings),
    )


def _evidence(
    frames: Sequence[FrameMatches],
    poses: Sequence[UnitPose],
    device: Device,
    seed: int,
    settings: UnknownProjectorSettings,
) -> DeviceEvidence:
    most = max(min(settings.fit.most_per_frame, settings.check_most // len(frames)), 1)
    matches = Matches.of(frames, device, settings.blocks, most, np.random.default_rng(seed))
    prior = Prior(values_of(device), prior_sigma(settings.prior))
    held = JointProblem(matches, device, (), prior, settings.fit).fit(Poses.of(poses))
    free = JointProblem(matches, device, FOCAL_AND_CENTRE, prior, settings.fit).fit(held.poses)
    index, focal = list(FOCAL_AND_CENTRE), device.fl_x
    step = (values_of(free.projector) - values_of(device))[index]
    unit = np.array([1.0, device.w / focal, device.w / focal])
    return DeviceEvidence(device, step * unit, free.covariance * np.outer(unit, unit), (held.noise_px, free.noise_px))
